//! Models from the files of other tools.
//!
//! Each format has a reader of its own, which takes a file apart as it comes and tells what is wrong with it, and where. What lists states and
//! transitions becomes a `table` (`draft`); what says how they follow from one another is a `planning` task, unless it is small.
//!
//! | format | made by | file |
//! |---|---|---|
//! | `gymnasium` | the table `P` of an environment, as `examples/gymnasium/export.py` writes it | JSON |
//! | `sas` | the translator of Fast Downward | lines |
//! | `drn` | Storm | lines |
//! | `prism` | PRISM | several files of lines, or a tar archive of them |
//! | `umb` | Storm, PRISM, Modest | a tar archive |

mod choices;
mod deadly;
mod draft;
mod drn;
mod edits;
mod failure;
mod gymnasium;
mod lines;
mod prism;
mod sas;
mod tar;
mod umb;
mod words;

use std::cell::RefCell;
use std::io::BufRead;

pub use edits::Edits;
pub use failure::{ImportError, Spot};

use super::reading::Interruptible;
use super::{Definition, Limits};
use crate::document::Quoted;
use crate::interrupt::{Interrupt, Meter};

/// A format of files that models are imported from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImportFormat {
    /// The table `P` of a Gymnasium environment, as JSON.
    Gymnasium,
    /// A SAS+ task, as the translator of Fast Downward writes it.
    Sas,
    /// Storm's explicit format.
    Drn,
    /// PRISM's explicit files.
    Prism,
    /// UMB, which Storm, PRISM and Modest share.
    Umb,
}

impl ImportFormat {
    /// Every format.
    pub const ALL: [Self; 5] = [Self::Gymnasium, Self::Sas, Self::Drn, Self::Prism, Self::Umb];

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Gymnasium => "gymnasium",
            Self::Sas => "sas",
            Self::Drn => "drn",
            Self::Prism => "prism",
            Self::Umb => "umb",
        }
    }

    /// The media type by which it is sent.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Gymnasium => "application/vnd.gymnasium+json",
            Self::Sas => "application/vnd.fast-downward.sas",
            Self::Drn => "application/vnd.storm.drn",
            Self::Prism => "application/vnd.prism+tar",
            Self::Umb => "application/vnd.umb",
        }
    }

    /// The format of a file, by how it is called and how it begins. `None` if that does not tell.
    #[must_use]
    pub fn of(name: &str, head: &[u8]) -> Option<Self> {
        if prism::PARTS.contains(&extension(name)) {
            return Some(Self::Prism);
        }
        let head = head.trim_ascii_start();
        match head.first()? {
            b'{' | b'[' => Some(Self::Gymnasium),
            b'b' if head.starts_with(b"begin_version") => Some(Self::Sas),
            b'/' | b'@' if head.windows(6).any(|part| part == b"@type:") => Some(Self::Drn),
            _ if head.get(257..262) == Some(b"ustar") => Some(Self::Umb),
            _ => None,
        }
    }

    /// What the names of the files that belong together end in, where a format has several; the one that must be there is the first.
    #[must_use]
    pub fn parts(self) -> &'static [&'static str] {
        if self == Self::Prism { &prism::PARTS } else { &[] }
    }
}

/// What a file's name ends in, after its last point.
fn extension(name: &str) -> &str {
    name.rsplit_once('.').map_or("", |(_, extension)| extension)
}

/// A file that a model is imported from, opened.
pub struct ImportFile<'f> {
    /// How it is called, also in what is told of it; may be empty where there is but one.
    pub name: String,
    /// Its content, decompressed.
    pub content: Box<dyn BufRead + 'f>,
}

/// Reads the model in `files`: one, unless the format has several.
///
/// # Errors
///
/// [`ImportError`]: what is wrong with a file, and where, or why it could not be read.
pub fn import(
    format: ImportFormat,
    files: Vec<ImportFile<'_>>,
    edits: &Edits,
    limits: Limits,
    interrupt: &mut dyn Interrupt,
) -> Result<Definition, ImportError> {
    /// How many transitions are looked at between two looks at the interrupt: less than a millisecond.
    const POLL_EVERY: u64 = 1 << 14;
    let has_named_rewards = matches!(format, ImportFormat::Drn | ImportFormat::Umb);
    if let Some(name) = edits.cost_reward.as_ref().filter(|_| !has_named_rewards) {
        let detail =
            format!("cost: expected ACTION=COST, found {}: {} has no rewards with names", Quoted(name), format.name());
        return Err(ImportError::Unfit(detail));
    }
    let interrupt = RefCell::new(interrupt);
    let poll = || interrupt.borrow_mut().poll();
    let (mut by_maker, mut by_explorer) = (poll, poll);
    let mut meter = Meter::new(&mut by_maker, POLL_EVERY);
    let mut by_readers = vec![poll; files.len()];
    let files = files.into_iter().zip(&mut by_readers);
    let mut files: Vec<_> =
        files.map(|(ImportFile { name, content }, poll)| (name, Interruptible::new(content, poll))).collect();
    if format == ImportFormat::Prism {
        return prism::read_files(files, edits, limits, &mut meter);
    }
    let (Some((name, content)), true) = (files.pop(), files.is_empty()) else {
        return Err(ImportError::Unfit(format!("{} is one file", format.name())));
    };
    let read = match format {
        ImportFormat::Gymnasium => gymnasium::read(content, edits, limits, &mut meter),
        ImportFormat::Sas => sas::read(content, edits, &mut by_explorer),
        ImportFormat::Umb => umb::read(content, edits, limits, &mut meter),
        ImportFormat::Drn | ImportFormat::Prism => drn::read(content, edits, limits, &mut meter),
    };
    read.map_err(|error| error.in_file(&name))
}
