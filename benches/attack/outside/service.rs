//! The program in a process of its own, in less memory than the machine has if told so.

use std::fs;
use std::io::{self, BufRead, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Mutex, PoisonError};

use super::Failure;

/// A cgroup that a service may be put into; it goes when the service is gone.
pub(crate) struct Group(PathBuf);

impl Group {
    /// One of `max_bytes`, beneath the one that this process is in, so that whatever holds there goes on holding.
    ///
    /// # Errors
    ///
    /// If it cannot be made, as by who is not root.
    pub(crate) fn new(max_bytes: u64) -> Result<Self, Failure> {
        let groups = fs::read_to_string("/proc/self/cgroup")?;
        let own = |controller: &str| {
            let mut lines = groups.lines().filter_map(|line| line.split_once(':')?.1.split_once(':'));
            lines.find(|(names, _)| names.split(',').any(|name| name == controller)).map(|(_, path)| path)
        };
        let (root, path, limit) = match own("memory") {
            Some(path) => ("/sys/fs/cgroup/memory", path, "memory.limit_in_bytes"),
            None => ("/sys/fs/cgroup", own("").ok_or("no cgroups")?, "memory.max"),
        };
        let name = format!("etude-attack-{}", std::process::id());
        let group = Self(Path::new(root).join(path.trim_start_matches('/')).join(name));
        fs::create_dir(&group.0)?;
        // The file comes with the group, where there are any.
        fs::OpenOptions::new()
            .write(true)
            .open(group.0.join(limit))
            .and_then(|mut file| io::Write::write_all(&mut file, max_bytes.to_string().as_bytes()))?;
        Ok(group)
    }

    /// What a shell does to be in it.
    pub(crate) fn enter(&self) -> String {
        format!("echo $$ > '{}'", self.0.join("cgroup.procs").display())
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        drop(fs::remove_dir(&self.0));
    }
}

/// A service with a new database, which goes with it. It is killed in the end.
pub(crate) struct Service {
    child: Mutex<Child>,
    process: u32,
    pub(crate) address: SocketAddr,
    _directory: tempfile::TempDir,
}

impl Service {
    /// Starts it from a shell that does what is `first` and becomes the program.
    pub(crate) fn start(flags: &[&str], first: &str) -> Result<Self, Failure> {
        let directory = tempfile::tempdir()?;
        let mut command = Command::new("sh");
        command.args(["-c", &format!("{first} && exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_etude")]);
        command.args(["serve", "--listen", "127.0.0.1:0", "--log-format", "text"]).args(flags);
        command.arg("--database").arg(directory.path().join("etude.db")).env_remove("ETUDE_LOG");
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn()?;
        let mut log = BufReader::new(child.stderr.take().ok_or("no log")?);
        let address = (&mut log)
            .lines()
            .map_while(Result::ok)
            .find_map(|line| line.split_once("http://")?.1.split(['"', ' ']).next()?.parse().ok());
        let Some(address) = address else {
            drop(child.wait());
            return Err("the service did not start".into());
        };
        std::thread::spawn(move || io::copy(&mut log, &mut io::sink()));
        Ok(Self { process: child.id(), child: Mutex::new(child), address, _directory: directory })
    }

    /// How it ended, if it did.
    pub(crate) fn end(&self) -> Option<ExitStatus> {
        self.child.lock().unwrap_or_else(PoisonError::into_inner).try_wait().ok().flatten()
    }

    /// A figure of its memory in bytes, such as `VmRSS`; `None` where it cannot be read.
    pub(crate) fn memory(&self, figure: &str) -> Option<u64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.process)).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix(figure)?.strip_prefix(':'))?;
        Some(line.trim().strip_suffix(" kB")?.parse::<u64>().ok()? * 1024)
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let child = self.child.get_mut().unwrap_or_else(PoisonError::into_inner);
        // Already gone, if this fails.
        drop(child.kill());
        drop(child.wait());
    }
}
