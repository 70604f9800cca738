//! Files of other tools, imported by the program.

use std::io::Write;
use std::path::Path;
use std::process::Stdio;

use crate::commands::{etude, run, text};
use flate2::Compression;
use flate2::write::GzEncoder;

const TAXI: &str = "examples/gymnasium/taxi.json";

/// What `etude model import` writes of what is in `input`, and says beside it.
fn imported(input: &[u8], flags: &[&str]) -> (String, String) {
    let arguments = [&["model", "import", "-"], flags].concat();
    let mut child =
        etude(&arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // It may end before it has read everything.
    let _ = child.stdin.take().unwrap().write_all(input);
    let output = child.wait_with_output().unwrap();
    (text(&output.stdout).to_owned(), text(&output.stderr).to_owned())
}

#[test]
fn a_file_is_imported_from_disk_or_from_a_pipe_compressed_or_not() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("model.json");
    let done = run(&["model", "import", TAXI, "--cost", "dropoff=1", "--out", out.to_str().unwrap()]);
    assert!(done.status.success() && done.stdout.is_empty());
    let told = format!("etude: {}: 500 states of 4 attributes, 2976 transitions\n", out.display());
    assert_eq!(text(&done.stderr), told, "no progress is drawn where nobody sees it");
    let written = std::fs::read_to_string(&out).unwrap();

    let file = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join(TAXI)).unwrap();
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(&file).unwrap();
    let gzip = gzip.finish().unwrap();
    for input in [&file, &gzip, &zstd::bulk::compress(&file, 1).unwrap()] {
        assert_eq!(imported(input, &["--cost", "dropoff=1"]), (written.clone(), String::new()));
    }
    let (_, told) = imported(&gzip[..gzip.len() / 2], &["--cost", "dropoff=1"]);
    let expected = format!("compressed data ends early, at byte {}\n", gzip.len() / 2);
    assert_eq!(told, format!("etude: cannot import -: cannot be decompressed: {expected}"));
    let (_, told) = imported(b"\xfd7zXZ\0..", &[]);
    assert_eq!(told, "etude: -: compressed by xz; decompress it first\n");
}

#[test]
fn a_model_is_mapped_as_its_file_comes_compressed_or_not_and_a_cut_one_is_told_with_its_line() {
    let directory = tempfile::tempdir().unwrap();
    let model = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/taxi/no-west.json")).unwrap();
    let mapped = |content: &[u8]| {
        let path = directory.path().join("no-west.json");
        std::fs::write(&path, content).unwrap();
        let files =
            ["map", "--model", path.to_str().unwrap(), "--demonstration", "examples/taxi/demonstration.json", "--json"];
        let done = run(&files);
        let policy = text(&done.stdout).split("\"elapsed_us\"").next().unwrap().to_owned();
        (policy, text(&done.stderr).replace(path.to_str().unwrap(), "FILE"))
    };
    let (policy, told) = mapped(&model);
    assert!(policy.contains("\"status\":\"optimal\"") && told.is_empty(), "{policy} {told}");
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(&model).unwrap();
    assert_eq!(mapped(&gzip.finish().unwrap()).0, policy);
    assert_eq!(mapped(&zstd::bulk::compress(&model, 1).unwrap()).0, policy);
    let zstd = zstd::bulk::compress(&model, 1).unwrap();
    let (_, told) = mapped(&zstd[..1000]);
    assert_eq!(told, "etude: cannot read FILE: compressed data ends early, at byte 1000\n");
    let (_, told) = mapped(&model[..model.len() / 2]);
    assert!(told.starts_with("etude: FILE: ") && told.contains("line "), "{told}");
}

#[test]
fn a_demonstration_may_be_compressed_too_whatever_its_form() {
    let directory = tempfile::tempdir().unwrap();
    let example = |file: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/way-points").join(file);
    let mapped = |demonstration: &Path| {
        let model = example("model.json");
        let files = ["--model", model.to_str().unwrap(), "--demonstration", demonstration.to_str().unwrap()];
        let done = run(&[&["map", "--column", "x=km*1000"], &files[..]].concat());
        let policy = text(&done.stdout).split("search").next().unwrap().to_owned();
        (policy, text(&done.stderr).replace(directory.path().to_str().unwrap(), "DIR"))
    };
    let plain = mapped(&example("demonstration.csv"));
    assert!(plain.0.contains("optimal"), "{plain:?}");
    let csv = std::fs::read(example("demonstration.csv")).unwrap();
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(&csv).unwrap();
    let gzip = gzip.finish().unwrap();
    for (name, content) in [("d.csv.gz", &gzip), ("d.csv.zst", &zstd::bulk::compress(&csv, 1).unwrap())] {
        std::fs::write(directory.path().join(name), content).unwrap();
        assert_eq!(mapped(&directory.path().join(name)).0, plain.0);
    }
    let cut = directory.path().join("cut.csv.gz");
    std::fs::write(&cut, &gzip[..20]).unwrap();
    let (_, told) = mapped(&cut);
    let expected = "etude: cannot read DIR/cut.csv.gz: compressed data ends early, at byte 20\n";
    assert!(told.ends_with(expected), "{told}");
}

#[test]
fn what_is_wrong_with_a_file_or_a_flag_is_told_in_a_line() {
    for (input, flags, expected) in [
        ("[[[[1, 0, 3, false]]]]", &[][..], "cannot import -: /P/0/0: a reward of 3 is no cost; "),
        ("{\n\"P\": [[[[1, 0,", &[], "cannot import -: line 2, column 14: EOF while parsing a value"),
        ("", &[], "cannot import -: the file is empty"),
        ("hello", &[], "cannot import -: this is of no format that is known here: gymnasium"),
        ("[[[[1, 0, 0, false]]]]", &["--without", "slide *"], "cannot import -: without: no action is called like"),
        ("[[[[1, 0, 0, false]]]]", &["--cost", "0=-1"], "--cost 0=-1: expected ACTION=COST, with a cost from 0"),
        ("[[[[1, 0, 0, false]]]]", &["--rename", "0"], "--rename 0: expected OLD=NEW"),
    ] {
        let (written, told) = imported(input.as_bytes(), flags);
        assert_eq!(written, "");
        assert!(told.starts_with(&format!("etude: {expected}")) && told.lines().count() == 1, "{told}");
    }
    let missing = run(&["model", "import", "no-such-file.json"]);
    assert_eq!(text(&missing.stderr), "etude: cannot read no-such-file.json: No such file or directory\n");
}

#[test]
fn the_files_of_prism_that_lie_beside_each_other_are_one_model() {
    let told = |file: &str| {
        let done = run(&["model", "import", file]);
        assert!(done.status.success(), "{}", text(&done.stderr));
        text(&done.stdout).to_owned()
    };
    let by_transitions = told("examples/verification/slippery.tra");
    assert_eq!(by_transitions, told("examples/verification/slippery.lab"));
    assert!(by_transitions.contains("{\"name\":\"lane\""), "{by_transitions}");
    let failed = run(&["model", "import", "examples/verification/slippery.tra", "--cost", "energy"]);
    let expected = "etude: cannot import examples/verification/slippery.tra: cost: expected ACTION=COST, found \"energy\": \
        prism has no rewards with names\n";
    assert_eq!(text(&failed.stderr), expected);
}
