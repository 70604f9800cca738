//! The way out for frames.

use super::closing::{Closed, Over, ends};
use super::frames::{ServerFrame, WriteError};
use super::limits::Limits;
use super::messages::Outgoing;
use super::problem::StreamProblem;
use super::queue::{Gone, Sender};
use crate::service::{ServiceError, SessionError};
use etude_core::mapping::CommittedStep;

/// Puts frames into the queue, which a client that does not read keeps full.
#[derive(Clone, Copy)]
pub(super) struct Outlet<'c> {
    pub(super) outgoing: &'c Sender<Outgoing>,
    pub(super) limits: Limits,
}

impl Outlet<'_> {
    pub(super) async fn send_steps(self, steps: &[CommittedStep]) -> Result<(), Over> {
        for step in steps {
            self.send(&ServerFrame::Step(step.into())).await?;
        }
        Ok(())
    }

    pub(super) async fn send(self, frame: &ServerFrame<'_>) -> Result<(), Over> {
        let Self { outgoing, limits } = self;
        let text = frame.text_within(limits.message_bytes()).map_err(|error| match error {
            WriteError::TooLong => {
                let detail = format!(
                    "the server's next frame takes more than the {} bytes that a message may have, as the states of this model do: ask \
                     for a policy instead",
                    limits.message_bytes()
                );
                Over::because(Closed::TooLarge, StreamProblem::new("too-large", detail))
            }
            WriteError::Json(error) => ends(&SessionError::Service(ServiceError::Write(error))),
        })?;
        match tokio::time::timeout(limits.slow_after, outgoing.send(Outgoing::Frame(text))).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(Gone)) => Err(Over { closed: Closed::ByClient, problem: None }),
            Err(_) => Err(Over { closed: Closed::Overloaded, problem: None }),
        }
    }
}
