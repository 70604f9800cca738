//! Packages from `PyPI`, for tests that need what others have made.

use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::harness::waiting::Watchdog;

/// Runs a command to its end, and gives what it has written, as an error if it fails.
pub(crate) fn run(command: &mut Command) -> Result<String, String> {
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let child = child.map_err(|error| format!("{command:?}: {error}"))?;
    let _watched = Watchdog::watch(child.id());
    let ended = child.wait_with_output().unwrap();
    let written = [ended.stdout, ended.stderr].concat();
    let written = String::from_utf8_lossy(&written).into_owned();
    if ended.status.success() { Ok(written) } else { Err(format!("{command:?}: {}\n{written}", ended.status)) }
}

/// The folder of an environment with these packages in it. It is made once, in the folder `name` of the build.
pub(crate) fn install(name: &str, packages: &[&str]) -> Result<PathBuf, String> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let wanted = packages.join("\n");
    // Tests may be processes of their own.
    let lock = File::create(folder.with_extension("lock")).unwrap();
    lock.lock().unwrap();
    let installed = folder.join("installed");
    if std::fs::read_to_string(&installed).is_ok_and(|installed| installed == wanted) {
        return Ok(folder);
    }
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&folder))?;
    run(Command::new(folder.join("bin/pip")).args(["install", "--quiet"]).args(packages))?;
    std::fs::write(installed, wanted).unwrap();
    Ok(folder)
}

/// Says on standard error that something is not tested, and why; not captured, unlike what macros print.
pub(crate) fn say_untested(what: &str, reason: &str) {
    let _ = writeln!(std::io::stderr(), "NOT TESTED: {what}: {reason}");
}
