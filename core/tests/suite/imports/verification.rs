//! Models of verification tools, against what the interface of Storm says of them.

use std::collections::BTreeMap;

use super::{Outcomes, check_optimal, edits, file, imported, millionths, model, outcomes, through, told};
use crate::problems::{example, example_bytes};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Edits, ImportError, ImportFormat, Limits, import};
use serde_json::{Value, json};

/// The outcomes of every state and action, by what Storm says of the states and choices.
fn storms(described: &Value, reward: &str) -> Outcomes {
    let mut expected = Outcomes::new();
    for (from, state) in described["states"].as_array().unwrap().iter().enumerate() {
        let mut n_unlabelled = 0;
        for choice in state["choices"].as_array().unwrap() {
            let name = choice["label"].as_str().map_or_else(|| format!("{n_unlabelled}"), str::to_owned);
            n_unlabelled += u32::from(choice["label"].is_null());
            let earned = choice["rewards"][reward].as_array().unwrap().iter().map(|part| part.as_f64().unwrap()).sum();
            let ways = choice["ways"].as_array().unwrap();
            let ways: BTreeMap<usize, _> = ways
                .iter()
                .map(|way| {
                    let to = way[0].as_u64().unwrap() as usize;
                    let is_paid = ways.len() > 1 || to != from;
                    (to, (millionths(way[1].as_f64().unwrap()), is_paid.then(|| millionths(earned))))
                })
                .collect();
            expected.insert((from, name), ways);
        }
    }
    expected
}

/// The values of every state, by name.
fn values(model: &Value) -> Vec<BTreeMap<String, Value>> {
    let names: Vec<&str> =
        model["attributes"].as_array().unwrap().iter().map(|own| own["name"].as_str().unwrap()).collect();
    let states = model["dynamics"]["states"].as_array().unwrap().iter();
    let named = |state: &Value| names.iter().map(ToString::to_string).zip(state.as_array().unwrap().clone()).collect();
    states.map(named).collect()
}

fn check(model: &Value, described: &Value, reward: &str) {
    let names = described["variables"].as_array().unwrap().iter().map(|name| name.as_str().unwrap().to_owned());
    let names: Vec<String> = names.collect();
    let states = described["states"].as_array().unwrap().iter();
    let expected: Vec<BTreeMap<String, Value>> =
        states.map(|state| names.iter().cloned().zip(state["values"].as_array().unwrap().clone()).collect()).collect();
    assert_eq!(values(model), expected);
    assert_eq!(outcomes(model), storms(described, reward));
    assert_eq!(model["dynamics"]["start"], 0);
}

/// The content of an archive, decompressed.
pub(super) fn umb(name: &str) -> Vec<u8> {
    use std::io::Read;
    let mut content = Vec::new();
    let compressed = example_bytes(&format!("verification/{name}.umb"));
    flate2::read::GzDecoder::new(compressed.as_slice()).read_to_end(&mut content).unwrap();
    content
}

/// PRISM's files of a model, of which `change` may change some.
fn prism(change: impl Fn(&str, String) -> Option<String>) -> Result<Definition, ImportError> {
    let files = ["tra", "sta", "lab", "srew", "trew"].into_iter().filter_map(|part| {
        let name = format!("slippery.{part}");
        let content = String::from_utf8(example_bytes(&format!("verification/{name}"))).unwrap();
        Some(file(&name, change(part, content)?.as_bytes()))
    });
    import(ImportFormat::Prism, files.collect(), &Edits::default(), Limits::NONE, &mut Uninterrupted)
}

fn parsed(definition: &Definition) -> Value {
    serde_json::from_str(&definition.text()).unwrap()
}

#[test]
fn a_model_in_drn_is_what_storm_says_of_it() {
    for (name, reward) in [("corridor", "energy"), ("slippery", "energy"), ("slippery", "time")] {
        let model = model(ImportFormat::Drn, &format!("verification/{name}.drn"), &edits(&[], &[reward]));
        check(&model, &example(&format!("verification/{name}.json")), reward);
    }
}

#[test]
fn a_model_in_umb_is_what_storm_says_of_it() {
    for (name, reward) in [("corridor", "energy"), ("slippery", "energy"), ("slippery", "time")] {
        let definition = imported(ImportFormat::Umb, &umb(name), &edits(&[], &[reward])).unwrap();
        check(&parsed(&definition), &example(&format!("verification/{name}.json")), reward);
    }
}

#[test]
fn the_explicit_files_of_prism_are_what_storm_says_of_the_model() {
    let definition = prism(|_, content| Some(content)).unwrap();
    check(&parsed(&definition), &example("verification/slippery.json"), "energy");
    let archive = archive();
    let definition = imported(ImportFormat::Prism, &archive, &Edits::default()).unwrap();
    check(&parsed(&definition), &example("verification/slippery.json"), "energy");
}

/// PRISM's files of a model in a tar archive.
pub(super) fn archive() -> Vec<u8> {
    let mut archive = Vec::new();
    for part in ["tra", "sta", "lab", "srew", "trew"] {
        let name = format!("slippery.{part}");
        let content = example_bytes(&format!("verification/{name}"));
        let mut header = [0; 512];
        header[..name.len()].copy_from_slice(name.as_bytes());
        header[124..136].copy_from_slice(format!("{:011o} ", content.len()).as_bytes());
        header[148..156].fill(b' ');
        header[156] = b'0';
        let sum: u32 = header.iter().map(|byte| u32::from(*byte)).sum();
        header[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
        archive.extend(header);
        archive.extend(&content);
        archive.resize(archive.len().next_multiple_of(512), 0);
    }
    archive.extend([0; 1024]);
    archive
}

#[test]
fn without_values_the_number_and_the_labels_of_states_are_their_attributes() {
    let drn = String::from_utf8(example_bytes("verification/slippery.drn")).unwrap();
    let plain: String = drn.lines().filter(|line| !line.starts_with("//[")).flat_map(|line| [line, "\n"]).collect();
    let drn = parsed(&imported(ImportFormat::Drn, plain.as_bytes(), &edits(&[], &["energy"])).unwrap());
    let prism = parsed(&prism(|part, content| (part != "sta").then_some(content)).unwrap());
    let described = example("verification/slippery.json");
    let states = described["states"].as_array().unwrap().iter().enumerate();
    let expected: Vec<Value> =
        states.map(|(n, state)| json!([n, state["labels"].as_array().unwrap().contains(&json!("end"))])).collect();
    for model in [drn, prism] {
        assert_eq!(model["dynamics"]["states"], json!(expected));
        assert_eq!(model["attributes"][1]["name"], "end");
        assert_eq!(outcomes(&model), storms(&described, "energy"));
    }
}

#[test]
fn a_mapping_on_a_verification_model_costs_what_the_independent_solver_finds() {
    for without in [&[][..], &["open"], &["up"]] {
        let model = model(ImportFormat::Drn, "verification/corridor.drn", &edits(without, &["energy"]));
        // Through the door in the lower lane.
        let demonstration = through(&model, &[0, 1, 4, 6, 11, 16]);
        check_optimal(&model, &json!({"model": "m", "demonstration": demonstration, "weights": {"open": 4}}));
    }
}

#[test]
fn several_rewards_need_a_choice_and_one_that_is_chosen_must_be_there() {
    let told = |costs: &[&str]| {
        let content = example_bytes("verification/corridor.drn");
        imported(ImportFormat::Drn, &content, &edits(&[], costs))
            .map(|definition| parsed(&definition))
            .map_err(|error| error.to_string())
    };
    let detail = told(&[]).unwrap_err();
    assert!(
        detail.starts_with("line 8: there are several rewards, \"time\", \"energy\", of which none is named by `cost`"),
        "{detail}"
    );
    assert_eq!(told(&["fuel"]).unwrap_err(), "cost: no reward is called \"fuel\"; there are \"time\", \"energy\"");
    let model = told(&["*=2"]).unwrap();
    assert!(model["actions"].as_array().unwrap().iter().all(|action| action["cost"] == 2.0));
    let detail = imported(ImportFormat::Sas, b"", &edits(&[], &["fuel"])).unwrap_err().to_string();
    assert!(detail.contains("sas has no rewards with names"), "{detail}");
}

#[test]
fn a_reward_without_a_name_is_the_cost_where_it_is_the_only_one_and_else_called_default() {
    let content = String::from_utf8(example_bytes("verification/slippery.drn")).unwrap();
    let described = example("verification/slippery.json");
    assert!(content.contains("\ntime energy \n"));
    let both = content.replacen("\ntime energy \n", "\ntime  \n", 1);
    let both = imported(ImportFormat::Drn, both.as_bytes(), &edits(&[], &["default"])).unwrap();
    check(&parsed(&both), &described, "energy");
    let one = content.replacen("\ntime energy \n", "\n \n", 1).replace("[1, ", "[").replace("[0, ", "[");
    check(&parsed(&imported(ImportFormat::Drn, one.as_bytes(), &Edits::default()).unwrap()), &described, "energy");
}

#[test]
fn what_is_wrong_with_a_drn_file_is_told_with_its_line() {
    let right = String::from_utf8(example_bytes("verification/slippery.drn"))
        .unwrap()
        .replace("time energy", "energy")
        .replace("[1, ", "[")
        .replace("[0, ", "[");
    imported(ImportFormat::Drn, right.as_bytes(), &Edits::default()).unwrap();
    for (part, wrong, expected) in [
        ("@type: MDP", "@type: MA", "line 3: a model of the type \"MA\""),
        ("double", "parametric", "line 4: values of the type \"parametric\""),
        ("@parameters\n", "@parameters\np q", "line 6: a model with parameters: \"p q\""),
        ("@nr_states\n20", "@nr_states\n21", "line 172: expected 21 states, found 20"),
        ("@nr_states\n20", "@nr_states\n19", "there is no state 19: there are 19, counted from 0"),
        ("@nr_states\n20", "@nr_states\n0", "line 10: there are no states"),
        ("@nr_choices\n52", "@nr_choices\n5", "line 172: expected 5 choices, found 52"),
        ("state 1 ", "state 2 ", "line 21: expected state 1, found state 2"),
        ("\t\t1 : 0.9", "\t\t1 : 0.8", "line 16: the probabilities of state 0 and action \"right\" sum to 0.9"),
        ("\t\t1 : 0.9", "\t\t99 : 0.9", "line 18: there is no state 99: there are 20, counted from 0"),
        ("\t\t1 : 0.9", "\t\t1 : x", "line 18: expected a state and a probability, `1 : 0.5`, found \"1 : x\""),
        ("\t\t1 : 0.9", "\t\t1 : -0.9", "line 18: -0.9 is no probability, from 0 to 1"),
        ("action right [1]", "action right [1, 2]", "line 16: expected 1 rewards, found 2"),
        ("action right [1]", "action right [x]", "line 16: expected a reward, found \"x\""),
        ("action right [1]", "action right [-1]", ": a reward of "),
        ("@model\n", "@model\n\taction up [1]\n", "line 14: an action before the first state"),
        ("& x=1\t", "& z=1\t", ": expected a value of \"x\", found \"z=1\""),
        ("& x=1\t", "", ": expected 3 values, as of the states before, found 2"),
        ("@nr_choices", "@nr_things", "line 11: \"@nr_things\" is not known here"),
        ("@nr_states\n20\n", "", ": there is no `@nr_states` before this"),
    ] {
        assert!(right.contains(part), "{part}");
        let told = told(ImportFormat::Drn, &right.replacen(part, wrong, 1));
        assert!(told.contains(expected), "{wrong}: {told}");
    }
    // Whichever line the file is cut at, something is missing, until only blank lines are.
    let n_lines = right.trim_end().lines().count();
    for n in 0..n_lines {
        let cut: String = right.lines().take(n).flat_map(|line| [line, "\n"]).collect();
        imported(ImportFormat::Drn, cut.as_bytes(), &Edits::default()).unwrap_err();
    }
}

#[test]
fn what_is_wrong_with_the_files_of_prism_is_told_with_file_and_line() {
    for (part, right, wrong, expected) in [
        ("tra", "20 52 67", "20 52", "line 4 of slippery.tra: 2 is no probability, from 0 to 1"),
        ("tra", "20 52 67", "21 52 67", "line 1 of slippery.tra: 21 states, but 20 have values"),
        ("tra", "20 52 67", "20 51 67", "of slippery.tra: expected 51 choices, found 52"),
        ("tra", "20 52 67", "20 52 66", "of slippery.tra: expected 66 transitions, found 67"),
        ("tra", "20 52 67", "x", "line 1 of slippery.tra: expected a count, found \"x\""),
        (
            "tra",
            "\n0 0 1 0.9 right",
            "\n0 0 1 0.8 right",
            "line 2 of slippery.tra: the probabilities of state 0 and action \"right\" sum to 0.9",
        ),
        (
            "tra",
            "\n0 0 1 0.9 right",
            "\n0 0 20 0.9 right",
            "line 3 of slippery.tra: there is no state 20: there are 20, counted from 0",
        ),
        (
            "tra",
            "\n0 0 1 0.9 right",
            "\n20 0 1 0.9 right",
            "line 3 of slippery.tra: there is no state 20: there are 20, counted from 0",
        ),
        (
            "tra",
            "\n1 0 0 1.0 left",
            "\n0 0 0 1.0 left",
            "line 5 of slippery.tra: states and their choices are not in their order",
        ),
        (
            "sta",
            "(x,lane,open)",
            "x,lane,open",
            "line 1 of slippery.sta: expected names, `(x,y)`, found \"x,lane,open\"",
        ),
        ("sta", "1:(1,0,false)", "2:(1,0,false)", "line 3 of slippery.sta: expected state 1, found state 2"),
        ("sta", "1:(1,0,false)", "1:(1,0)", "line 3 of slippery.sta: expected 3 values, found 2"),
        ("lab", "0=\"init\"", "init", "line 1 of slippery.lab: expected labels, `0=\"init\"`, found"),
        ("lab", "0: 0", "0: 7", "line 2 of slippery.lab: there is no label 7"),
        ("lab", "0: 0", "20: 0", "line 3 of slippery.lab: states are not in their order"),
        ("lab", "\n19: 2", "\n20: 2", "line 6 of slippery.lab: there is no state 20: there are 20, counted from 0"),
        ("srew", "20 10", "20 11", "of slippery.srew: expected 11 rewards, found 10"),
        ("trew", "20 52", "19 52", "line 3 of slippery.trew: 19 states, but the transitions have 20"),
        ("trew", "20 52", "20 51", "line 3 of slippery.trew: 51 choices, but the transitions have 52"),
        ("srew", "20 10", "21 10", "line 3 of slippery.srew: 21 states, but the transitions have 20"),
        ("srew", "\n2 ", "\n20 ", "of slippery.srew: there is no state 20: there are 20, counted from 0"),
        (
            "trew",
            "\n0 0 0 1.0",
            "\n0 0 9 1.0",
            "line 4 of slippery.trew: there is no transition from 0 to 9 by choice 0",
        ),
        ("trew", "\n0 0 0 1.0", "\n0 0 0 x", "line 4 of slippery.trew: expected a number, found \"x\""),
    ] {
        let told = prism(|name, content| {
            if name != part {
                return Some(content);
            }
            assert!(content.contains(right), "{right}");
            Some(content.replacen(right, wrong, 1))
        });
        let told = told.unwrap_err().to_string();
        assert!(told.contains(expected), "{wrong}: {told}");
    }
    let empty = prism(|part, content| Some(if part == "sta" { String::new() } else { content }));
    assert_eq!(empty.unwrap_err().to_string(), "slippery.sta: the file is empty");
    let alone = prism(|part, content| match part {
        "sta" => None,
        "lab" => Some(content.replace("\n19: 2", "\n20: 2")),
        _ => Some(content),
    });
    let expected = "line 6 of slippery.lab: there is no state 20: there are 20, counted from 0";
    assert_eq!(alone.unwrap_err().to_string(), expected);
    let missing = prism(|part, content| (part != "tra").then_some(content)).unwrap_err().to_string();
    assert_eq!(missing, "there is no file of transitions: .tra");
    let archive = archive();
    for n_bytes in [0, 100, 512, 700, archive.len() - 1024] {
        let told = imported(ImportFormat::Prism, &archive[..n_bytes], &Edits::default()).unwrap_err().to_string();
        assert!(told.starts_with(&format!("byte {n_bytes}: the archive ends, ")), "{n_bytes}: {told}");
    }
}

/// An archive with the same files, of which `change` changes one.
fn changed(archive: &[u8], name: &str, change: impl Fn(&mut [u8])) -> Vec<u8> {
    let mut archive = archive.to_vec();
    let mut at = 0;
    while archive[at] != 0 {
        let text = |field: &[u8]| String::from_utf8_lossy(field).trim_matches(['\0', ' ']).to_owned();
        let (own, size) = (text(&archive[at..at + 100]), text(&archive[at + 124..at + 136]));
        let size = usize::from_str_radix(&size, 8).unwrap();
        if own == name {
            change(&mut archive[at + 512..at + 512 + size]);
        }
        at += 512 + size.next_multiple_of(512);
    }
    archive
}

#[test]
fn what_is_wrong_with_an_archive_is_told_with_file_and_byte() {
    let right = umb("slippery");
    let text = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        changed(&right, "index.json", |content| {
            let at = content.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
            content[at..at + to.len()].copy_from_slice(to.as_bytes());
        })
    };
    let word = |name: &str, n: usize, value: u64| {
        changed(&right, name, |content| content[8 * n..8 * n + 8].copy_from_slice(&value.to_le_bytes()))
    };
    for (content, expected) in [
        (text("\"format-version\": 1", "\"format-version\": 2"), "index.json: version 2; version 1 is read here"),
        (text("\"discrete\"", "\"stochas\" "), "index.json: 1 players and stochas time"),
        (
            text("\"#states\": 20", "\"#states\": 21"),
            "valuations/states/valuations.bin: expected 1 bytes for each of 21 states, found 20",
        ),
        (
            text("\"#branches\": 67", "\"#branches\": 68"),
            "branch-to-target.bin: expected 68 numbers of 8 bytes, found 536 bytes",
        ),
        (text("{", "["), "line 2 of index.json: "),
        (word("branch-to-target.bin", 1, 99), "byte 8 of branch-to-target.bin: there is no state 99"),
        (
            word("branch-to-probability.bin", 1, 0.8_f64.to_bits()),
            "byte 0 of choice-to-branches.bin: the probabilities of state 0 and action \"right\" sum to 0.9",
        ),
        (
            word("branch-to-probability.bin", 1, f64::NAN.to_bits()),
            "byte 8 of branch-to-target.bin: NaN is no probability",
        ),
        (
            word("state-to-choices.bin", 1, u64::MAX),
            "byte 0 of state-to-choices.bin: the parts from 0 to 18446744073709551615, of 52",
        ),
        (word("choice-to-branches.bin", 1, 68), "byte 0 of choice-to-branches.bin: the parts from 0 to 68, of 67"),
        (
            changed(&right, "actions/choices/values.bin", |content| content[0] = 9),
            "byte 0 of actions/choices/values.bin: choice 0 has no action, of 5",
        ),
        (
            word("actions/choices/string-mapping.bin", 1, 999),
            "byte 0 of actions/choices/string-mapping.bin: there is no such text",
        ),
    ] {
        let told = imported(ImportFormat::Umb, &content, &edits(&[], &["energy"])).unwrap_err().to_string();
        assert!(told.contains(expected), "{expected}: {told}");
    }
    let compressed = imported(ImportFormat::Umb, &example_bytes("verification/corridor.umb"), &Edits::default());
    assert!(compressed.unwrap_err().to_string().starts_with("byte 0: "), "it is decompressed by who opens it");
    let end = right.iter().rposition(|byte| *byte != 0).unwrap().next_multiple_of(512);
    for n_bytes in (0..end).step_by(97) {
        let told = imported(ImportFormat::Umb, &right[..n_bytes], &Edits::default()).unwrap_err().to_string();
        assert!(told.starts_with(&format!("byte {n_bytes}: the archive ends")), "{told}");
    }
}
