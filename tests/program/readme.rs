//! The examples of the README that need no service run, and print what it says.

use std::process::{Command, Stdio};

use crate::commands::etude;

/// How the README runs the program.
const RUN: &str = "cargo run --release -- ";

/// What the fenced blocks of the README say, each with its language.
fn blocks(text: &str) -> Vec<(&str, Vec<&str>)> {
    let mut blocks = Vec::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if let Some(language) = line.strip_prefix("```") {
            blocks.push((language, lines.by_ref().take_while(|line| *line != "```").collect()));
        }
    }
    blocks
}

/// The program with the arguments that a shell makes of `command`: some are in single quotes.
fn program_of(command: &str) -> Command {
    let parts = command.split('\'').enumerate();
    let arguments = parts.flat_map(|(n, part)| if n % 2 == 1 { vec![part] } else { part.split_whitespace().collect() });
    etude(&arguments.collect::<Vec<_>>())
}

#[test]
fn examples_of_maps_streams_and_the_demo_print_what_the_readme_says() {
    let root = env!("CARGO_MANIFEST_DIR");
    let text = include_str!("../../README.md");
    let directory = tempfile::tempdir().unwrap();
    std::os::unix::fs::symlink(format!("{root}/examples"), directory.path().join("examples")).unwrap();
    let mut n_examples = 0;
    for pair in blocks(text).windows(2) {
        let [(_, commands), (language, printed)] = pair else { unreachable!() };
        let Some((before, command)) = commands[0].split_once(RUN) else { continue };
        let command = command.split(" #").next().unwrap().trim();
        if !language.is_empty()
            || !["map", "stream", "demo", "model import", "model inspect", "model experience"]
                .iter()
                .any(|name| command.starts_with(name))
        {
            continue;
        }
        n_examples += 1;
        // Of several, the last prints what is shown.
        let (last, earlier) = commands.split_last().unwrap();
        for command in earlier.iter().filter(|_| command.starts_with("model")) {
            let done = program_of(command.strip_prefix(RUN).unwrap()).current_dir(directory.path()).output().unwrap();
            assert!(done.status.success(), "{command}: {}", String::from_utf8_lossy(&done.stderr));
        }
        let command = if command.starts_with("model") { last.strip_prefix(RUN).unwrap() } else { command };
        let mut program = program_of(command);
        program.current_dir(directory.path());
        // What is piped into it is what `jq -c '.[]'` makes of an array, which is read as well.
        if before.starts_with("jq -c '.[]' ") {
            let file = before.split(' ').nth(3).unwrap();
            program.stdin(Stdio::from(std::fs::File::open(format!("{root}/{file}")).unwrap()));
        }
        let output = program.output().unwrap();
        assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
        let output = String::from_utf8(output.stdout).unwrap();
        for line in printed.iter().filter(|line| line.trim() != "..") {
            assert!(
                output.lines().any(|found| found.trim_end() == *line),
                "{command} does not print\n{line}\n{output}"
            );
        }
    }
    assert!(n_examples >= 10, "{n_examples}");
}
