//! A stream through a service, over as many connections as it takes.
//!
//! ```text
//! connect -> open -> lines out, steps in -> done
//!    ^                      |
//!    +--- resume <- wait <--+ the connection is lost
//! ```
//!
//! Lines are kept until the service has said that they are durable. A new connection asks for the steps after the last one
//! printed, and is sent the lines from the first one on that the service does not have: nothing is lost, nothing comes twice.

use std::collections::VecDeque;
use std::io::Write;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::sync::mpsc;

use super::client::{self, Answers, Frames};
use super::frames::{Problem, refused};
use super::lines::{Line, MAX_READ_AHEAD};
use super::printer::{Answer, Printer};
use crate::cli::CliError;

/// How long to wait before the first attempt to take up a lost stream; twice as long before each further one.
const FIRST_DELAY: Duration = Duration::from_millis(100);

/// Attempts come at least this often.
const MAX_DELAY: Duration = Duration::from_secs(5);

/// A stream, however often its connection is lost.
pub(super) struct StreamSession {
    client: reqwest::Client,
    server: String,
    /// The frame that opens it.
    open: Value,
    /// Its id, once it is open.
    id: Option<String>,
    lines: mpsc::Receiver<Result<Option<Line>, CliError>>,
    /// Lines that are not durable as far as is known, in order. The first is the observation `n_received`.
    waiting: VecDeque<Line>,
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
            CliError::Http { .. } | CliError::Answer { status: 503, .. } => Self::Lost(error),
            _ => Self::Failed(error),
        }
    }
}

impl StreamSession {
    pub(super) fn new(
        client: reqwest::Client,
        server: &str,
        open: Value,
        lines: mpsc::Receiver<Result<Option<Line>, CliError>>,
    ) -> Self {
        let waiting = VecDeque::with_capacity(MAX_READ_AHEAD);
        Self { client, server: server.to_owned(), open, id: None, lines, waiting, n_received: 0, is_complete: false }
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
            None => frames.send(&self.open).await,
            Some(id) => frames.send(&json!({"type": "resume", "session": id, "step": printer.n_steps()})).await,
        };
        self.opened(printer, &mut answers).await?;

        // How many of the waiting lines were sent here. The request ends with the frames.
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
                line = self.lines.recv(), if may_read => match line.transpose()?.flatten() {
                    Some(line) => self.waiting.push_back(line),
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

    /// Sends the lines that were not sent yet, and the end if it is reached.
    async fn send(&self, frames: &Frames, n_sent: &mut usize) {
        // Whether anybody listens is told by the answers.
        for line in self.waiting.iter().skip(*n_sent) {
            let seq = self.n_received as usize + *n_sent;
            frames.send(&json!({"type": "observe", "seq": seq, "states": [&line.observation]})).await;
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

    /// Forgets the lines before the observation `seq`, which are durable. Gives how many.
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

    /// Errors are about the first line that is not acknowledged, but for those that are about the connection.
    fn refused(&self, problem: Problem) -> Broken {
        let is_passing = problem.is_passing();
        let error = refused(problem, self.waiting.front().map(|line| line.number));
        if is_passing { Broken::Lost(error) } else { Broken::Failed(error) }
    }
}
