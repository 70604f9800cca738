//! Demonstrations of every form, read by `map` and by `stream`.

use std::path::PathBuf;

use serde_json::{Value, json};

use crate::commands::{Streaming, etude, run, text};
use crate::harness::process::Process;

/// A corridor of ten cells with a door, in which a body goes to either side.
fn corridor() -> Value {
    let states: Vec<Value> = (0..10).map(|x| json!([x, "east", x < 5])).collect();
    let transitions = (0..9).flat_map(|x| [json!([x, "on", x + 1]), json!([x + 1, "back", x])]);
    json!({
        "attributes": [
            {"name": "x", "kind": "number"},
            {"name": "heading", "kind": "cyclic", "labels": ["east", "west"]},
            {"name": "lit", "kind": "category"},
        ],
        "actions": [{"name": "on", "cost": 0.1}, {"name": "back", "cost": 0.1}],
        "dynamics": {"kind": "table", "states": states, "transitions": transitions.collect::<Vec<_>>(), "start": 0},
    })
}

/// The same demonstration in every form.
const FORMS: [(&str, &str); 6] = [
    ("seen.csv", "x,heading,lit,time\n0,east,True,12:00\n1,,True,12:01\n3,east,NaN,12:02\n"),
    ("seen.tsv", "\u{feff}lit\tx\theading\r\ntrue\t0\teast\r\ntrue\t1\t\r\n\t3\teast\r\n"),
    ("seen.json", r#"[{"x":0,"heading":"east","lit":true},{"x":1,"lit":true},[3,"east",null]]"#),
    ("request.json", "{\n\"demonstration\":[[0,\"east\",true],[1,null,true],[3,\"east\",null]]}"),
    (
        "seen.ndjson",
        "{\"x\":0,\"heading\":\"east\",\"lit\":true}\n{\"x\":1,\"lit\":true}\n{\"x\":3,\"heading\":\"east\",\"lit\":NaN}\n",
    ),
    ("seen.jsonl", "[0,\"east\",true]\n\n[1,null,true]\n[3,\"east\",null]"),
];

struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Self {
        let files = Self(tempfile::tempdir().unwrap());
        files.file("corridor.json", &corridor().to_string());
        files
    }

    fn file(&self, name: &str, content: &str) -> String {
        let path: PathBuf = self.0.path().join(name);
        std::fs::write(&path, content).unwrap();
        path.to_str().unwrap().to_owned()
    }

    fn model(&self) -> String {
        self.0.path().join("corridor.json").to_str().unwrap().to_owned()
    }

    /// What `etude` says of something that it refuses.
    fn told(&self, arguments: &[&str]) -> String {
        let failed = etude(arguments).current_dir(self.0.path()).output().unwrap();
        let told = text(&failed.stderr).to_owned();
        assert_eq!((failed.status.code(), text(&failed.stdout)), (Some(1), ""), "{told}");
        told
    }
}

/// What is piped into `etude`, and what it prints.
fn piped(arguments: &[&str], input: &str) -> String {
    use std::io::Write;
    use std::process::Stdio;
    let mut child = etude(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let ended = child.wait_with_output().unwrap();
    assert!(ended.status.success());
    text(&ended.stdout).to_owned()
}

#[test]
fn every_form_is_read_by_map_and_by_stream() {
    let files = Files::new();
    let model = files.model();
    let actions = |output: &str| {
        let last: Value = serde_json::from_str(output.lines().last().unwrap()).unwrap();
        (last["actions"].clone(), last["cost"]["total"].clone())
    };
    let expected = (json!(["on", "on"]), json!(1.2));
    for (name, content) in FORMS {
        let path = files.file(name, content);
        for command in ["map", "stream"] {
            let read = run(&[command, "--model", &model, "--demonstration", &path, "--json"]);
            assert!(read.status.success(), "{command} {name}: {}", text(&read.stderr));
            assert_eq!(actions(text(&read.stdout)), expected, "{command} {name}");
            // A column that is not an attribute is told of.
            let told =
                format!("etude: {path}: what is in \"time\" is no attribute of the model, and is not looked at\n");
            assert_eq!(text(&read.stderr), if name == "seen.csv" { &told } else { "" }, "{command} {name}");
            let piped = piped(&[command, "--model", &model, "--demonstration", "-", "--json"], content);
            assert_eq!(actions(&piped), expected, "{command} < {name}");
        }
    }
}

#[test]
fn columns_are_renamed_and_scaled() {
    let files = Files::new();
    let path = files.file("km.csv", "km,side,lit\n0,east,true\n0.004,east,true\n");
    let columns = ["--column", "x=km*1000", "--column", "heading=side"];
    for command in ["map", "stream"] {
        let arguments = [command, "--model", &files.model(), "--demonstration", &path, "--json"];
        let read = run(&[&arguments[..], &columns].concat());
        let last: Value = serde_json::from_str(text(&read.stdout).lines().last().unwrap()).unwrap();
        assert_eq!(last["actions"], json!(["on", "on"]), "{}", text(&read.stderr));
    }
}

#[test]
fn rows_are_followed_while_they_are_written() {
    let files = Files::new();
    let service = Process::start(&files.0.path().join("etude.db"));
    let url = format!("http://{}", service.address);
    for server in [&[][..], &["--server", &url]] {
        let model = files.model();
        let mut streaming = Streaming::start(&[&["--model", &model, "--lookahead", "1"][..], server].concat());
        for line in ["lit,x", "true,0"] {
            streaming.write(line);
        }
        assert!(streaming.read().starts_with("step"));
        assert!(streaming.read().contains("start"));
        streaming.write("true,1");
        streaming.write("true,2");
        assert!(streaming.read().contains("on"));
        streaming.write("true,far");
        let (_, code, errors) = streaming.end();
        assert_eq!(code, Some(1));
        assert!(
            errors.contains("row 5 of the input, column \"x\": expected a number, found \"far\""),
            "{server:?}: {errors}"
        );
    }
    // A name alone: what its attributes are is asked of the service.
    let by_name = piped(&["stream", "--model", "corridor", "--server", &url, "--json"], "lit,x\ntrue,0\ntrue,1\n");
    let done: Value = serde_json::from_str(by_name.lines().last().unwrap()).unwrap();
    assert_eq!(done["actions"], json!(["on"]));
}

#[test]
fn what_is_wrong_is_told_of_the_flag_or_the_file_that_says_it() {
    let files = Files::new();
    files.file("seen.csv", "x,lit\n0,true\nfar,true\n");
    files.file("good.csv", "x\n0\n");
    files.file("request.json", r#"{"weights":{"gold":1},"start":{"x":77},"demonstration":[{"x":0}]}"#);
    files.file("learned.json", r#"{"learner":"gold","demonstration":[{"x":0}]}"#);
    files.file("nothing.csv", "x,lit\n");
    for (arguments, expected) in [
        (
            "map --demonstration good.csv --weight gould=3",
            "--weight gould=3: unknown attribute \"gould\"; the model has ",
        ),
        (
            "stream --demonstration good.csv --weight gould=3",
            "--weight gould=3: unknown attribute \"gould\"; the model has ",
        ),
        ("map --demonstration good.csv --start {\"x\":77}", "--start {\"x\":77}: "),
        ("map --demonstration good.csv --weight x=-1", "--weight x=-1: expected a number of at least 0, found -1"),
        ("map --demonstration good.csv --without fly", "--without fly: unknown action \"fly\"; the model has "),
        (
            "map --demonstration good.csv --action-cost fly=1",
            "--action-cost fly=1: unknown action \"fly\"; the model has ",
        ),
        ("map --demonstration good.csv --extra-weight 2", "--extra-weight 2.0: expected a number from 0 to 1, found 2"),
        ("map --demonstration seen.csv", "row 3 of seen.csv, column \"x\": expected a number, found \"far\""),
        ("stream --demonstration request.json", "request.json: /weights/gold: unknown attribute"),
        ("map --demonstration request.json", "request.json: /weights/gold: unknown attribute"),
        ("map --demonstration request.json", "request.json: /start: "),
        ("map --demonstration learned.json", "learned.json: /learner: a learner is known to a service alone"),
        ("map --demonstration nothing.csv", "nothing.csv: nothing was observed"),
        ("stream --demonstration nothing.csv", "nothing was observed"),
    ] {
        let arguments: Vec<&str> = arguments.split(' ').collect();
        let told = files.told(&[&arguments[..], &["--model", "corridor.json"]].concat());
        assert!(told.contains(expected), "{arguments:?}: {told}");
    }
    let twice = files.told(&["map", "--model", "-", "--demonstration", "-"]);
    assert!(twice.contains("--model and --demonstration: only one of them can be standard input"), "{twice}");
    for command in ["map", "stream"] {
        let arguments = [command, "--model", "corridor.json", "--demonstration", "good.csv", "--lookahead", "0"];
        let refused = etude(&arguments).output().unwrap();
        let told = text(&refused.stderr);
        assert!(told.contains("invalid value '0' for '--lookahead"), "{told}");
        assert!(told.contains("expected a number from 1 to 100000, or none"), "{told}");
    }
}

#[test]
fn a_stream_of_a_world_that_is_searched_lazily_needs_a_lookahead() {
    let files = Files::new();
    let gold: Vec<[u16; 2]> = (0..20).map(|n| [n + 5, 7]).collect();
    let cave = json!({
        "dynamics": {"kind": "wumpus", "width": 30, "height": 30, "pits": [], "wumpi": [], "gold": gold},
    });
    files.file("cave.json", &cave.to_string());
    files.file("seen.csv", "x\n0\n");
    let run = |command, lookahead| {
        let arguments = [command, "--model", "cave.json", "--demonstration", "seen.csv", "--lookahead", lookahead];
        etude(&arguments).current_dir(files.0.path()).output().unwrap()
    };
    let refused = run("stream", "none");
    let told = text(&refused.stderr);
    assert!(told.contains("--lookahead null: this world is searched lazily"), "{told}");
    assert!(told.contains("set a number, such as 8"), "{told}");
    for (command, lookahead) in [("stream", "3"), ("map", "3"), ("map", "none")] {
        let done = run(command, lookahead);
        assert!(done.status.success(), "{command} {lookahead}: {}", text(&done.stderr));
    }
}

#[test]
fn a_picture_shows_both_paths_or_the_alignment() {
    let files = Files::new();
    let arguments = |picture: &str| -> Vec<String> {
        let model = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/figure-4/model.json");
        let demonstration = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/figure-4/demonstration.json");
        let arguments = ["map", "--model", model, "--demonstration", demonstration, "--picture", picture];
        arguments.map(str::to_owned).to_vec()
    };
    let drawn = |name: &str, arguments: &[&str]| {
        let drawn = etude(arguments).current_dir(files.0.path()).output().unwrap();
        assert!(drawn.status.success(), "{}", text(&drawn.stderr));
        std::fs::read_to_string(files.0.path().join(name)).unwrap()
    };
    let of_cave = arguments("cave.svg");
    let of_cave: Vec<&str> = of_cave.iter().map(String::as_str).collect();
    let has = |svg: &str, words: &str| svg.contains(&format!("\n{words}\n"));
    let svg = drawn("cave.svg", &of_cave);
    for words in
        ["x", "y", "demonstrator", "imitator", "grab", "climb", "model: cost 48.2 = actions 7.2 + distance 41.0"]
    {
        assert!(has(&svg, words), "{words}");
    }
    let swapped = drawn("cave.svg", &[&of_cave[..], &["--picture-x", "y", "--picture-y", "gold"]].concat());
    assert!(has(&swapped, "y") && has(&swapped, "gold") && !has(&swapped, "x"));

    let seen = files.file("seen.csv", FORMS[0].1);
    let of_corridor = ["map", "--model", "corridor.json", "--demonstration", &seen, "--picture", "corridor.svg"];
    let svg = drawn("corridor.svg", &of_corridor);
    for words in [
        "observed",
        "done",
        "0 x=0 heading=east lit=true",
        "1 x=1",
        "on",
        "start",
        "match: an action, and the next observation",
    ] {
        assert!(has(&svg, words), "{words} is not in\n{svg}");
    }
    let told = files.told(&[&of_corridor[..], &["--picture-x", "lit"]].concat());
    assert!(told.contains("--picture-x lit: \"lit\" is no number attribute; the model has \"x\""), "{told}");
    let told = files.told(&[&of_corridor[..6], &["missing/corridor.svg"]].concat());
    assert!(told.contains("cannot write missing/corridor.svg: No such file"), "{told}");
}
