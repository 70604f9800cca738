//! A stream through a service, over as many connections as it takes.
//!
//! ```text
//! connect -> open -> observations out, steps in -> done
//!    ^                      |
//!    +--- resume <- wait <--+ the connection is lost
//! ```
//!
//! Observations are kept until the service has said that they are durable. A new connection asks for the steps after the last one
//! printed, and is sent the observations from the first one on that the service does not have: nothing is lost, nothing comes twice.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::Arc;
use std::time::Duration;

use serde_json::json;
use tokio::sync::mpsc;

use super::client::{self, Answers, Frames};
use super::frames::Problem;
use super::printer::{Answer, Printer};
use crate::cli::CliError;
use crate::cli::input::{MAX_READ_AHEAD, Observation, Observations, Source};
use crate::cli::options::FlaggedRequest;

/// How long to wait before the first attempt to take up a lost stream; twice as long before each further one.
const FIRST_DELAY: Duration = Duration::from_millis(100);

/// Attempts come at least this often.
const MAX_DELAY: Duration = Duration::from_secs(5);

/// A stream, however often its connection is lost.
pub(super) struct StreamSession {
    client: reqwest::Client,
    server: String,
    /// The frame that opens it.
    open: FlaggedRequest,
    /// Its id, once it is open.
    id: Option<String>,
    source: Arc<Source>,
    observations: mpsc::Receiver<Result<Option<Observation>, CliError>>,
    /// Observations that are not durable as far as is known, in order. The first is the observation `n_received`.
    waiting: VecDeque<Observation>,
    n_received: u32,
    /// Whether the input is at its end.
    is_complete: bool,
}

/// Why a connection was of no more use.
enum Broken {
    /// Another one may do.
    Lost(CliError),
    /// There is nothing to be done.
    Failed(CliError),
}

impl From<CliError> for Broken {
    fn from(error: CliError) -> Self {
        match error {
            CliError::NoService { .. } | CliError::Http { .. } | CliError::Answer { status: 503, .. } => {
                Self::Lost(error)
            }
            _ => Self::Failed(error),
        }
    }
}

impl StreamSession {
    pub(super) fn new(client: reqwest::Client, server: &str, open: FlaggedRequest, observations: Observations) -> Self {
        Self {
            client,
            server: server.to_owned(),
            open,
            id: None,
            source: Arc::clone(observations.source()),
            observations: observations.read_ahead(),
            waiting: VecDeque::with_capacity(MAX_READ_AHEAD),
            n_received: 0,
            is_complete: false,
        }
    }

    /// Streams until the policy is done. A connection that is lost once the session is open is replaced, unless that fails
    /// `max_retries` times in a row without any progress in between.
    ///
    /// # Errors
    ///
    /// If the input, the options or the service are at fault, or the connection is lost for good.
    pub(super) async fn run(mut self, printer: &mut Printer<'_, impl Write>, max_retries: u32) -> Result<(), CliError> {
        let mut n_retries = 0;
        let mut delay = FIRST_DELAY;
        loop {
            let before = (self.n_received, printer.n_steps());
            let error = match self.speak(printer).await {
                Ok(()) => return Ok(()),
                Err(Broken::Failed(error)) => return Err(error),
                Err(Broken::Lost(error)) => error,
            };
            let Some(id) = &self.id else { return Err(error) };
            if before != (self.n_received, printer.n_steps()) {
                (n_retries, delay) = (0, FIRST_DELAY);
            }
            if n_retries == max_retries {
                tracing::debug!(error = &error as &dyn std::error::Error, "the last attempt");
                let detail = format!("the connection is lost; session {id} can be resumed: {error}");
                return Err(CliError::Stream(detail));
            }
            n_retries += 1;
            printer
                .note(&format!("the connection is lost; attempt {n_retries} of {max_retries} to resume in {delay:?}"));
            tokio::time::sleep(delay).await;
            delay = (delay * 2).min(MAX_DELAY);
        }
    }

    /// Streams over one connection.
    async fn speak(&mut self, printer: &mut Printer<'_, impl Write>) -> Result<(), Broken> {
        let (frames, mut answers) = client::connect(&self.client, &self.server).await?;
        match &self.id {
            None => frames.send(&self.open.document()).await,
            Some(id) => frames.send(&json!({"type": "resume", "session": id, "step": printer.n_steps()})).await,
        };
        self.opened(printer, &mut answers).await?;

        // How many of the waiting observations were sent here. The request ends with the frames.
        let (mut n_sent, mut frames) = (0, Some(frames));
        loop {
            if let Some(sending) = &frames {
                self.send(sending, &mut n_sent).await;
            }
            if self.is_complete {
                frames = None;
            }
            let may_read = !self.is_complete && self.waiting.len() < MAX_READ_AHEAD;
            tokio::select! {
                next = self.observations.recv(), if may_read => match next.transpose()?.flatten() {
                    Some(observation) => self.waiting.push_back(observation),
                    None => self.is_complete = true,
                },
                answer = Self::receive(printer, &mut answers) => match answer? {
                    Answer::Done => return Ok(()),
                    Answer::Received { seq } => {
                        let n_acknowledged = self.received(printer, seq)?;
                        n_sent = n_sent.saturating_sub(n_acknowledged);
                    }
                    Answer::Error { problem } => return Err(self.refused(problem)),
                    Answer::Hello | Answer::Opened { .. } | Answer::Step => {}
                },
            }
        }
    }

    /// Waits until the session is open, at wherever the service has it.
    async fn opened(&mut self, printer: &mut Printer<'_, impl Write>, answers: &mut Answers) -> Result<(), Broken> {
        loop {
            match Self::receive(printer, answers).await? {
                Answer::Opened { session, received } => {
                    self.id = Some(session);
                    self.received(printer, received)?;
                    return Ok(());
                }
                Answer::Error { problem } => return Err(self.refused(problem)),
                _ => {}
            }
        }
    }

    /// Sends the observations that were not sent yet, and the end if it is reached.
    async fn send(&self, frames: &Frames, n_sent: &mut usize) {
        // Whether anybody listens is told by the answers.
        for observation in self.waiting.iter().skip(*n_sent) {
            let seq = self.n_received as usize + *n_sent;
            frames.send(&json!({"type": "observe", "seq": seq, "states": [&observation.state]})).await;
            *n_sent += 1;
        }
        if self.is_complete {
            frames.send(&json!({"type": "end", "seq": self.n_received as usize + *n_sent})).await;
        }
    }

    async fn receive(printer: &mut Printer<'_, impl Write>, answers: &mut Answers) -> Result<Answer, Broken> {
        let Some(text) = answers.receive().await? else {
            return Err(Broken::Lost(CliError::Stream("the service ended it".to_owned())));
        };
        Ok(printer.frame(&text)?)
    }

    /// Forgets what comes before the observation `seq`, which is durable. Gives how many observations that were.
    fn received(&mut self, printer: &Printer<'_, impl Write>, seq: u32) -> Result<usize, Broken> {
        let n_acknowledged = seq.checked_sub(self.n_received).map(|n| n as usize);
        let Some(n_acknowledged) = n_acknowledged.filter(|n| *n <= self.waiting.len()) else {
            let detail = format!("the service has {seq} observations, where it had {}", self.n_received);
            return Err(Broken::Failed(CliError::Stream(detail)));
        };
        self.waiting.drain(..n_acknowledged);
        self.n_received = seq;
        printer.received(seq);
        Ok(n_acknowledged)
    }

    /// Errors are about the first observation that is not acknowledged, but for those that are about the connection.
    fn refused(&self, problem: Problem) -> Broken {
        let is_passing = problem.is_passing();
        let spot = self.waiting.front().filter(|_| self.id.is_some()).map(|observation| &observation.spot);
        let error = problem.told(spot, |faults| self.open.told(faults, 0, &self.source, &[]));
        if is_passing { Broken::Lost(error) } else { Broken::Failed(error) }
    }
}
