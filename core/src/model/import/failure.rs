//! Why a file gives no model, and where in the file that is.

use std::fmt;
use std::io;

use crate::document::{Faults, Path};
use crate::interrupt::{Cancelled, Interrupted};
use crate::model::ReadError;

/// A place in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spot {
    /// No place in particular.
    Whole,
    /// A line, from 1.
    Line(u64),
    /// A line and a column, from 1.
    Column(u64, u64),
    /// A byte, from 0.
    Byte(u64),
    /// What follows on an action in a state, in a table `P` of Gymnasium.
    Pair(u64, u64),
}

/// Why a file gives no model.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file is not what its format says, or not what a model can be.
    #[error("{}{detail}", Told(file, *spot))]
    Malformed {
        /// Which file it is, where there are several.
        file: String,
        /// Where in the file.
        spot: Spot,
        /// What is wrong there, and what would be right.
        detail: String,
    },
    /// What should be done with it does not fit what is in it: an action that is to be removed is not there.
    #[error("{0}")]
    Unfit(String),
    /// The file could not be read to its end.
    #[error("the file could not be read")]
    Read(#[source] io::Error),
    /// The model takes more memory than it may.
    #[error("{0}")]
    TooLarge(String),
    /// The caller asked for it to be stopped, or the time was up.
    #[error(transparent)]
    Interrupted(#[from] Interrupted),
}

impl ImportError {
    pub(super) fn at(spot: Spot, detail: impl Into<String>) -> Self {
        Self::Malformed { file: String::new(), spot, detail: detail.into() }
    }

    /// The same error, in the file called `name`.
    pub(super) fn in_file(self, name: &str) -> Self {
        match self {
            Self::Malformed { file, spot, detail } if file.is_empty() => {
                Self::Malformed { file: name.to_owned(), spot, detail }
            }
            other => other,
        }
    }
}

impl From<io::Error> for ImportError {
    fn from(error: io::Error) -> Self {
        match error.get_ref().and_then(|inner| inner.downcast_ref::<Interrupted>()) {
            Some(interrupted) => Self::Interrupted(*interrupted),
            None if error.kind() == io::ErrorKind::InvalidData || error.kind() == io::ErrorKind::UnexpectedEof => {
                Self::at(Spot::Whole, format!("cannot be decompressed: {error}"))
            }
            None => Self::Read(error),
        }
    }
}

impl From<ImportError> for ReadError {
    fn from(error: ImportError) -> Self {
        match error {
            ImportError::Malformed { file, spot, detail } => {
                let mut faults = Faults::default();
                let line =
                    if let Spot::Line(line) | Spot::Column(line, _) = spot { Path::Line(line) } else { Path::Root };
                let detail = match spot {
                    Spot::Whole | Spot::Byte(_) => format!("{}{detail}", Told(&file, spot)),
                    Spot::Column(_, column) if file.is_empty() => format!("column {column}: {detail}"),
                    Spot::Column(_, column) => format!("{file}: column {column}: {detail}"),
                    Spot::Line(_) | Spot::Pair(..) if file.is_empty() => detail,
                    Spot::Line(_) | Spot::Pair(..) => format!("{file}: {detail}"),
                };
                match spot {
                    Spot::Pair(state, action) => {
                        let [table, state, action] = ["P".to_owned(), state.to_string(), action.to_string()];
                        let table = Path::Member(&line, &table);
                        let state = Path::Member(&table, &state);
                        faults.note_at(&Path::Member(&state, &action), detail);
                    }
                    _ => faults.note_at(&line, detail),
                }
                faults.into()
            }
            ImportError::Unfit(detail) => Faults::one("", detail).into(),
            ImportError::Read(error) => Self::Read(error),
            ImportError::TooLarge(detail) => Self::TooLarge(detail),
            ImportError::Interrupted(Interrupted::Cancelled(Cancelled)) => Self::Cancelled(Cancelled),
            ImportError::Interrupted(Interrupted::OutOfTime) => Self::OutOfTime,
        }
    }
}

/// The beginning of what is told of a place in a file.
struct Told<'f>(&'f str, Spot);

impl fmt::Display for Told<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(file, spot) = self;
        let of = if file.is_empty() { "" } else { " of " };
        match spot {
            Spot::Whole if file.is_empty() => Ok(()),
            Spot::Whole => write!(f, "{file}: "),
            Spot::Line(line) => write!(f, "line {line}{of}{file}: "),
            Spot::Column(line, column) => write!(f, "line {line}, column {column}{of}{file}: "),
            Spot::Byte(byte) => write!(f, "byte {byte}{of}{file}: "),
            Spot::Pair(state, action) => write!(f, "/P/{state}/{action}{of}{file}: "),
        }
    }
}
