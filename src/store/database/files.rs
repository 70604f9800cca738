//! Files, their disk, and who may read them.

use std::fs::{self, Permissions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::process::geteuid;

use crate::store::Unavailable;

/// Nobody but the service's user is to read what others have sent.
pub(super) const MODE: u32 = 0o600;

/// Tells a file from another one that has its path later.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Identity {
    device: u64,
    inode: u64,
}

impl Identity {
    /// Asks for nothing else. Where somebody has looked at a file's times, Linux gives each write after that a time of its own (since 6.13), which
    /// some file systems make durable with every sync: a third thing to be written by each commit.
    #[cfg(target_os = "linux")]
    pub(super) fn of(path: &Path) -> io::Result<Self> {
        use rustix::fs::{AtFlags, CWD, StatxFlags, makedev, statx};

        let found = statx(CWD, path, AtFlags::empty(), StatxFlags::INO)?;
        Ok(Self { device: makedev(found.stx_dev_major, found.stx_dev_minor), inode: found.stx_ino })
    }

    #[cfg(not(target_os = "linux"))]
    pub(super) fn of(path: &Path) -> io::Result<Self> {
        let metadata = fs::metadata(path)?;
        Ok(Self { device: metadata.dev(), inode: metadata.ino() })
    }
}

/// The path without links, by which SQLite names the files beside it. If there is no file yet, the links of its directory are resolved.
pub(super) fn resolve(path: &Path) -> io::Result<PathBuf> {
    match fs::canonicalize(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => {}
        resolved => return resolved,
    }
    let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = path.file_name().ok_or(ErrorKind::InvalidFilename)?;
    Ok(fs::canonicalize(directory)?.join(name))
}

/// Takes the permissions of others from a file of this process's user. Says whether they had any.
pub(super) fn keep_from_others(path: &Path) -> io::Result<bool> {
    let file = match fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(false),
        file => file?,
    };
    let is_to_be_kept = file.is_file() && file.uid() == geteuid().as_raw() && file.mode() & 0o077 != 0;
    if is_to_be_kept {
        fs::set_permissions(path, Permissions::from_mode(file.mode() & MODE))?;
    }
    Ok(is_to_be_kept)
}

/// Finds out whether the disk takes a temporary file beside the database, on a blocking thread, as a disk may be slow.
pub(super) async fn probe_aside(path: &Path) -> Result<(), Unavailable> {
    let path = path.to_owned();
    tokio::task::spawn_blocking(move || probe(&path)).await.unwrap_or(Ok(()))
}

fn probe(path: &Path) -> Result<(), Unavailable> {
    /// More than the last block of a full disk may have left.
    const N_BYTES: usize = 64 * 1024;
    let directory = path.parent().unwrap_or(Path::new("."));
    let written = tempfile::tempfile_in(directory).and_then(|mut file| {
        io::Write::write_all(&mut file, &vec![0; N_BYTES])?;
        file.sync_all()
    });
    match written {
        Ok(()) => Ok(()),
        Err(error) => unavailable(&error).map_or(Ok(()), Err),
    }
}

/// What an error of a file says of its disk.
pub(super) fn unavailable(error: &io::Error) -> Option<Unavailable> {
    match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => Some(Unavailable::Full),
        _ if is_read_only(error) => Some(Unavailable::ReadOnly),
        _ => None,
    }
}

pub(super) fn is_read_only(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::ReadOnlyFilesystem | ErrorKind::PermissionDenied)
}
