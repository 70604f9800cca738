//! Models, inspected by the program.

use crate::commands::{etude, run, text};
use crate::harness::client::Client;
use crate::harness::process::Process;
use serde_json::Value;

const MODEL: &str = "examples/figure-4/model.json";
const REQUEST: &str = "examples/figure-4/request.json";

/// What `etude model inspect` prints.
fn inspected(arguments: &[&str]) -> String {
    let done = run(&[&["model", "inspect"], arguments].concat());
    assert!(done.status.success(), "{}", text(&done.stderr));
    text(&done.stdout).to_owned()
}

#[test]
fn a_report_is_told_in_lines_and_tables() {
    let told = inspected(&[MODEL, "--demonstration", REQUEST]);
    for expected in [
        "states      208, all of which the body comes to from 1 start state, with 548 transitions between\n            them\n",
        "parts       10: 2 of 100 states, 8 of 1 state. ",
        "undoing     half of what can be undone is undone by 1 action, all by 5; 12 of 548 transitions can\n",
        "lookahead   6 observations for a stream",
        "x          number       1.0          72  7 from 0 to 6\n",
        "arrows     number       1.0     nothing  1\n",
        "forward      0.3        136  5\n",
        "climb        0.3          8  nothing\n",
        "seen        16 observations, 15 of which no state of the body meets: 1 to 15\n",
        "distance    17.0 at least",
        "arrows           16       15               15.0  0 (closest: 1)\n",
    ] {
        assert!(told.contains(expected), "{expected:?} is not in\n{told}");
    }
    assert!(told.lines().all(|line| line.chars().count() <= 100), "{told}");
    let met = inspected(&["examples/taxi/model.json", "--demonstration", "examples/taxi/demonstration.json"]);
    assert!(met.contains("each of which some state of the body meets\ndistance    0.0 at least"), "{met}");
    let directory = tempfile::tempdir().unwrap();
    let own = directory.path().join("own.csv");
    std::fs::write(&own, "east_m,look\n0.5,u\n4,d\n").unwrap();
    let flags = ["--observe", "x=east_m*2.0", "--observe", "heading=look == 'u' ? 'north' : 'south'"];
    let own = inspected(&[&[MODEL, "--demonstration", own.to_str().unwrap()][..], &flags].concat());
    assert!(own.contains("x                 2        1                4.0  8 (closest: 6)\n"), "{own}");
    let lacking =
        inspected(&["examples/taxi/model.json", "--without", "north", "--without", "west", "--weight", "passenger=0"]);
    assert!(!lacking.contains("north") && lacking.contains("passenger    category     0.0"), "{lacking}");
}

/// A stream of figure 4 with the lookahead that is told gives the optimum, and with one less does not.
#[test]
fn the_lookahead_that_is_told_is_what_a_stream_needs() {
    let report: Value = serde_json::from_str(&inspected(&[MODEL, "--json"])).unwrap();
    let lookahead = report["lookahead"].as_u64().unwrap();
    let cost = |lookahead: &str| {
        let done = run(&["map", "--model", MODEL, "--demonstration", REQUEST, "--json", "--lookahead", lookahead]);
        serde_json::from_slice::<Value>(&done.stdout).unwrap()["cost"]["total"].as_f64().unwrap()
    };
    let optimum = cost("none");
    assert_eq!(cost(&lookahead.to_string()), optimum);
    assert!(cost(&(lookahead - 1).to_string()) > optimum);
}

#[tokio::test]
async fn a_service_reports_what_the_program_does_of_a_file() {
    let directory = tempfile::tempdir().unwrap();
    let service = Process::start(&directory.path().join("etude.db"));
    let model: Value = serde_json::from_str(&std::fs::read_to_string(MODEL).unwrap()).unwrap();
    let url = format!("http://{}/v1/models/model", service.address);
    assert_eq!(Client::new().put(url).json(&model).send().await.unwrap().status(), 201);
    for flags in [
        &[][..],
        &["--json"],
        &["--demonstration", REQUEST],
        &["--demonstration", REQUEST, "--without", "grab", "--json"],
    ] {
        let here = inspected(&[&[MODEL], flags].concat());
        let there = inspected(&[&["model", "--server", &service.address], flags].concat());
        assert_eq!(here, there);
    }
    let unknown = run(&["model", "inspect", "none", "--server", &service.address]);
    assert!(text(&unknown.stderr).contains("answered 404: there is no model \"none\""), "{}", text(&unknown.stderr));
}

#[test]
fn what_is_wrong_with_what_is_inspected_is_told_where_it_stands() {
    let directory = tempfile::tempdir().unwrap();
    let seen = directory.path().join("seen.csv");
    std::fs::write(&seen, "x,heading\n1,east\nfar,east\n").unwrap();
    let seen = seen.to_str().unwrap();
    for (arguments, expected) in [
        (
            &["none"][..],
            "etude: none: there is no such file; if it is the name of a model at a service, say where that is by --server\n",
        ),
        (&[MODEL, "--without", "fly"], "etude: --without fly: unknown action \"fly\"; "),
        (&[MODEL, "--weight", "z=1"], "etude: --weight z=1: unknown attribute \"z\"; "),
        (&[MODEL, "--demonstration", seen], &format!("etude: row 3 of {seen}, column \"x\": ")),
        (
            &[MODEL, "--demonstration", MODEL],
            "etude: examples/figure-4/model.json: the model and the demonstration cannot be the same file",
        ),
    ] {
        let failed = etude(&[&["model", "inspect"], arguments].concat()).output().unwrap();
        assert!(text(&failed.stderr).starts_with(expected), "{arguments:?}: {}", text(&failed.stderr));
    }
}
