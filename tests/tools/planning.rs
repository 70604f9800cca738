//! The translator of Fast Downward.

use std::path::Path;

use crate::Tools;

#[test]
fn the_tasks_beside_the_script_are_those_that_the_translator_writes() {
    let Some(tools) = Tools::installed("tasks of Fast Downward's translator") else { return };
    tools.run("examples/planning/make.py", &["--out", "."]);
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/planning");
    for name in ["blocksworld-4", "blocksworld-8", "logistics-2", "logistics-6"] {
        for extension in ["sas", "json"] {
            let file = format!("{name}.{extension}");
            let [made, committed] =
                [tools.folder.path(), &examples].map(|folder| std::fs::read_to_string(folder.join(&file)).unwrap());
            assert!(made == committed, "{file}");
        }
    }
}

#[test]
fn a_body_in_a_task_that_was_just_translated_is_mapped_as_the_independent_solver_does() {
    let Some(tools) = Tools::installed("mappings in tasks of Fast Downward's translator") else { return };
    tools.run("examples/planning/make.py", &["--out", "."]);
    for (file, without, n_states) in
        [("blocksworld-4.sas", "stack c *", 125), ("logistics-2.sas", "load * plane1 *", 0)]
    {
        let whole = tools.import(file, &[]);
        let n_found = whole["dynamics"]["states"].as_array().unwrap().len();
        assert!(n_states == 0 || n_found == n_states, "{file}: {n_found}");
        let seen: Vec<usize> = (0..8).map(|n| n * n_found / 9).collect();
        tools.check_mapping(&whole, &seen);
        let body = tools.import(file, &["--without", without]);
        let n_left = body["dynamics"]["states"].as_array().unwrap().len();
        assert!(n_left <= n_found, "{file}");
        let seen: Vec<usize> = (0..8).map(|n| n * n_left / 9).collect();
        tools.check_mapping(&body, &seen);
    }
}
