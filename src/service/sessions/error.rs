//! Why a session could not do as told.

use etude_core::document::Faults;
use etude_core::mapping::{Demonstration, TooManySteps};

use crate::service::owners::TakenOver;
use crate::service::{PoolError, ServiceError};
use crate::store::{SessionRefusal, StoreError};

/// Why a session could not do as told.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// Observations are missing in between.
    #[error("expected seq {expected}")]
    Gap {
        /// The observation that comes next.
        expected: u32,
    },
    /// There would be more observations than a session may have.
    #[error("a session has at most {} observations", Demonstration::MAX_OBSERVATIONS)]
    TooMany,
    /// There is no demonstration to end.
    #[error("nothing was observed yet")]
    Empty,
    /// The demonstration has ended already.
    #[error("the demonstration has ended")]
    Ended,
    /// The demonstration has ended, but its policy cannot be stored. What was observed stays.
    #[error("the demonstration cannot be ended: {0}")]
    TooManySteps(#[from] TooManySteps),
    /// Something is wrong with the frame.
    #[error("{0}")]
    Faults(#[from] Faults),
    /// The session has expired, was deleted, or was ended or taken over by another connection.
    #[error("the session is not open any more")]
    NotOpen,
    /// Another connection has taken the session over, or it was deleted.
    #[error("the session was resumed on another connection, or deleted")]
    TakenOver,
    /// Whatever else can go wrong.
    #[error(transparent)]
    Service(ServiceError),
}

impl From<ServiceError> for SessionError {
    fn from(error: ServiceError) -> Self {
        match error {
            ServiceError::Faults(faults) => Self::Faults(faults),
            error => Self::Service(error),
        }
    }
}

impl From<TakenOver> for SessionError {
    fn from(TakenOver: TakenOver) -> Self {
        Self::TakenOver
    }
}

impl From<SessionRefusal> for SessionError {
    fn from(refusal: SessionRefusal) -> Self {
        match refusal {
            SessionRefusal::Superseded => Self::TakenOver,
            // Whoever drives a session knows what comes next, unless somebody else has added to it.
            SessionRefusal::NotOpen | SessionRefusal::NotNext => Self::NotOpen,
        }
    }
}

impl From<StoreError> for SessionError {
    fn from(error: StoreError) -> Self {
        ServiceError::from(error).into()
    }
}

impl From<PoolError> for SessionError {
    fn from(error: PoolError) -> Self {
        ServiceError::from(error).into()
    }
}
