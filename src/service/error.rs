//! The errors of the service, by what the caller can do about them.

use std::error::Error;
use std::sync::Arc;

use super::{Kind, PoolError};
use crate::memory::NoRoom;
use crate::store::{StoreError, Unavailable};
use etude_core::document::{Faults, ParseError, Quoted};
use etude_core::mapping::{Shortage, WriteError};
use etude_core::model::NOTHING_YET;

/// Why the service could not do as asked.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// The body is not JSON.
    #[error(transparent)]
    Parse(#[from] ParseError),
    /// The body is JSON, but not what was asked for.
    #[error("{0}")]
    Faults(#[from] Faults),
    /// What must be kept of the body while it is read is too large.
    #[error("{0}")]
    TooLarge(String),
    /// The body could not be read to its end.
    #[error("the body could not be read")]
    Body(#[source] std::io::Error),
    /// There is nothing of this kind with this name or id.
    #[error("there is no {} {}", kind.name(), Quoted(name))]
    Unknown {
        /// What was looked for.
        kind: Kind,
        /// By which name or id.
        name: String,
        /// Where the request's body names it, if it does.
        pointer: Option<&'static str>,
    },
    /// The name is taken by something else.
    #[error("{kind} {name:?} exists with other content (hash {existing_hash}); delete it first or use another name")]
    Conflict {
        /// What it is the name of.
        kind: &'static str,
        /// The name.
        name: String,
        /// The hash of what is there.
        existing_hash: String,
    },
    /// What is to be replaced is not there, or something else is.
    #[error("{}", mismatch(name, existing_hash.as_deref()))]
    PreconditionFailed {
        /// The name.
        name: String,
        /// The hash of what is there, if anything is.
        existing_hash: Option<String>,
    },
    /// The model was told another batch of the same name.
    #[error(
        "model {model:?} was told batch {} before, with other content; give each batch a name of its own",
        Quoted(batch)
    )]
    BatchTaken {
        /// The model.
        model: String,
        /// The name of the batch.
        batch: String,
    },
    /// A model of experience has no state that the imitator may start in.
    #[error("of model {model:?}, {NOTHING_YET}")]
    NothingExperienced {
        /// The model.
        model: String,
    },
    /// A request with the same key and another body was answered.
    #[error(
        "the `Idempotency-Key` {} was sent before with another body; give each request a key of its own",
        Quoted(key)
    )]
    KeyReused {
        /// The key.
        key: String,
    },
    /// Something else needs what was to be deleted.
    #[error("{} {} cannot be deleted: {because}", kind.name(), Quoted(id))]
    InUse {
        /// What it is.
        kind: Kind,
        /// Its id.
        id: String,
        /// What needs it.
        because: &'static str,
    },
    /// The learner never had this version of its weights.
    #[error("the weights of learner {name:?} have no version {version}")]
    UnknownVersion {
        /// The learner.
        name: String,
        /// What was asked for.
        version: u64,
    },
    /// The trial has a reward, and that is not changed.
    #[error("trial {trial} has earned {existing} already")]
    AlreadyRewarded {
        /// The trial.
        trial: String,
        /// What it has earned.
        existing: f64,
    },
    /// The trial has failed, and takes neither a reward nor another reason.
    #[error("trial {trial} has failed")]
    TrialFailed {
        /// The trial.
        trial: String,
    },
    /// The searches cannot keep up, or the service is shutting down.
    #[error(transparent)]
    Pool(#[from] PoolError),
    /// The answer to a batch has no room for this item.
    #[error("the answer to this batch is full; send this item again with the next one")]
    BatchFull,
    /// There is no memory for it now, or there never is.
    #[error(transparent)]
    NoRoom(#[from] NoRoom),
    /// There is no memory for what a stream must keep, now or ever.
    #[error(transparent)]
    Shortage(#[from] Shortage),
    /// The deadline is over, and the model is still being compiled.
    #[error("model {name:?} is still being compiled; try again shortly")]
    Compiling {
        /// The model.
        name: String,
    },
    /// What is durable cannot be used now.
    #[error(transparent)]
    Unavailable(Outage),
    /// Some of what was sent was lost meanwhile; sent once more, it may go through.
    #[error("what was stored so far was removed meanwhile; send it again")]
    Lost,
    /// What is read was deleted while it was.
    #[error("it was removed while it was read")]
    Removed,
    /// The service is shutting down, and stores nothing more.
    #[error("the store takes no more writes")]
    Closed,
    /// What is durable cannot be used, for a reason that only its operator can do something about.
    #[error(transparent)]
    Storage(Arc<dyn Error + Send + Sync>),
    /// What is durable cannot be read as what was stored.
    #[error("table {table} holds an invalid {column}{}", of_row(row.as_deref()))]
    Unreadable {
        /// Where.
        table: &'static str,
        /// Of what.
        column: &'static str,
        /// Of which name or id, if that is known.
        row: Option<String>,
        /// What is wrong with it.
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
    /// What was made could not be written as JSON: a defect.
    #[error("an answer could not be written")]
    Write(#[source] serde_json::Error),
    /// A policy could not be written: a defect.
    #[error("a policy could not be written")]
    WritePolicy(#[from] WriteError),
}

/// Why what is durable cannot be used now, though nothing is wrong with what was asked. Later it may go through.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{detail}")]
pub struct Outage {
    /// What kind it is.
    pub kind: OutageKind,
    /// What is the matter, in words.
    detail: String,
}

/// What those who wait can expect of an outage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutageKind {
    /// No room is left. What is there can be read.
    Full,
    /// It takes too long, or somebody else holds it: it may be over soon.
    Slow,
    /// Nothing can be written before somebody mends it.
    Broken,
}

impl From<Unavailable> for Outage {
    fn from(unavailable: Unavailable) -> Self {
        let kind = match unavailable {
            Unavailable::Full => OutageKind::Full,
            Unavailable::Locked | Unavailable::Slow => OutageKind::Slow,
            Unavailable::ReadOnly | Unavailable::Failing { .. } | Unavailable::Gone => OutageKind::Broken,
        };
        Self { kind, detail: unavailable.to_string() }
    }
}

fn of_row(row: Option<&str>) -> String {
    row.map(|row| format!(" in the row of {row:?}")).unwrap_or_default()
}

fn mismatch(name: &str, existing_hash: Option<&str>) -> String {
    match existing_hash {
        Some(hash) => format!("model {name:?} has the hash {hash}, which is not one that `If-Match` names"),
        None => format!(
            "there is no model {name:?} to be replaced, as `If-Match` says; leave that out to register a new one"
        ),
    }
}

impl ServiceError {
    /// A row, known by its name or id, whose content cannot be read.
    pub(super) fn unreadable(
        table: &'static str,
        column: &'static str,
        row: impl Into<String>,
        source: impl Into<Box<dyn Error + Send + Sync>>,
    ) -> Self {
        Self::Unreadable { table, column, row: Some(row.into()), source: source.into() }
    }
}

impl From<StoreError> for ServiceError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::NoRoom(no_room) => Self::NoRoom(no_room),
            StoreError::Unavailable(unavailable) => Self::Unavailable(unavailable.into()),
            StoreError::Lost => Self::Lost,
            StoreError::Removed => Self::Removed,
            StoreError::Closed => Self::Closed,
            StoreError::Corrupt { table, column, row, source } => Self::Unreadable { table, column, row, source },
            error => Self::Storage(Arc::new(error)),
        }
    }
}
