//! How much the answer to a batch takes, which is bounded.

use crate::memory::{Held, Memory};
use crate::service::ServiceError;
use crate::service::search::Searched;

/// Most bytes of all policies of a batch: as many as the states of a single one may take. Items beyond that are told to be sent again.
const MAX_ANSWER_BYTES: usize = 64 << 20;

/// What the answer to a batch takes.
#[derive(Debug, Default)]
pub(super) struct Answer {
    /// For the policies as they will be answered, as they will be stored, and as they are put together; for what is to be refined, and
    /// for what is wrong.
    pub(super) held: Option<Held>,
    /// Of the policies.
    n_bytes: usize,
    /// For the rest.
    n_other_bytes: usize,
    pub(super) is_full: bool,
}

impl Answer {
    /// Takes in what became of an item, if the answer has room for it.
    pub(super) fn take_in(
        &mut self,
        searched: Result<Searched, ServiceError>,
        memory: &Memory,
    ) -> Result<Searched, ServiceError> {
        const N_COPIES: usize = 3;
        /// As it is told, and as it is put together.
        const PROBLEM_BYTES: usize = 1024;
        let (n_bytes, n_other_bytes) = match &searched {
            Ok(Searched { policy, refinement, .. }) => {
                (policy.len(), refinement.as_ref().map_or(0, |refinement| refinement.request.len()))
            }
            Err(ServiceError::Faults(faults)) => (0, PROBLEM_BYTES + N_COPIES * faults.size_bytes()),
            Err(_) => (0, PROBLEM_BYTES),
        };
        let (n_bytes, n_other_bytes) = (self.n_bytes + n_bytes, self.n_other_bytes + n_other_bytes);
        let no_room = memory.reserve(&mut self.held, N_COPIES * n_bytes + n_other_bytes).is_err();
        self.is_full |= no_room || n_bytes > MAX_ANSWER_BYTES;
        match searched {
            Ok(searched) if !self.is_full => {
                (self.n_bytes, self.n_other_bytes) = (n_bytes, n_other_bytes);
                Ok(Searched { held: None, ..searched })
            }
            Err(error) if !no_room => {
                self.n_other_bytes = n_other_bytes;
                Err(error)
            }
            _ => Err(ServiceError::BatchFull),
        }
    }
}
