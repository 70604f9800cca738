//! Models from the files of other tools.
//!
//! Each format has a reader of its own, which takes a file apart as it comes and tells what is wrong with it, and where. What lists states and
//! transitions becomes a `table` (`draft`); what says how they follow from one another is a `planning` task, unless it is small.
//!
//! | format | made by | file |
//! |---|---|---|
//! | `gymnasium` | the table `P` of an environment, as `examples/gymnasium/export.py` writes it | JSON |
//! | `sas` | the translator of Fast Downward | lines |

mod draft;
mod edits;
mod failure;
mod gymnasium;
mod lines;
mod sas;
mod words;

use std::io::BufRead;

pub use edits::Edits;
pub use failure::{ImportError, Spot};

use super::reading::Interruptible;
use super::{Definition, Limits};
use crate::interrupt::{Interrupt, Meter};

/// A format of files that models are imported from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImportFormat {
    /// The table `P` of a Gymnasium environment, as JSON.
    Gymnasium,
    /// A SAS+ task, as the translator of Fast Downward writes it.
    Sas,
}

impl ImportFormat {
    /// Every format.
    pub const ALL: [Self; 2] = [Self::Gymnasium, Self::Sas];

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Gymnasium => "gymnasium",
            Self::Sas => "sas",
        }
    }

    /// The media type by which it is sent.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Gymnasium => "application/vnd.gymnasium+json",
            Self::Sas => "application/vnd.fast-downward.sas",
        }
    }

    /// The format of a file, by how it is called and how it begins. `None` if that does not tell.
    #[must_use]
    pub fn of(_name: &str, head: &[u8]) -> Option<Self> {
        let head = head.trim_ascii_start();
        match head.first()? {
            b'{' | b'[' => Some(Self::Gymnasium),
            b'b' if head.starts_with(b"begin_version") => Some(Self::Sas),
            _ => None,
        }
    }
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
    let interrupt = std::cell::RefCell::new(interrupt);
    let (mut by_reader, mut by_maker) = (|| interrupt.borrow_mut().poll(), || interrupt.borrow_mut().poll());
    let mut by_maker_too = || interrupt.borrow_mut().poll();
    let mut meter = Meter::new(&mut by_maker, POLL_EVERY);
    let Ok([ImportFile { name, content }]) = <[_; 1]>::try_from(files) else {
        return Err(ImportError::Unfit(format!("{} is one file", format.name())));
    };
    let content = Interruptible::new(content, &mut by_reader);
    let read = match format {
        ImportFormat::Gymnasium => gymnasium::read(content, edits, limits, &mut meter),
        ImportFormat::Sas => sas::read(content, edits, &mut by_maker_too),
    };
    read.map_err(|error| error.in_file(&name))
}
