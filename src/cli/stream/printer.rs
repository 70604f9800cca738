//! Prints a stream, frame by frame, above a line of progress.
//!
//! Its columns are written by hand, as a table of comfy-table is laid out once all its rows are known: here each is shown at once.

use std::fmt::Write as _;
use std::io::Write;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::frames::{Frame, Problem, StepFrame};
use crate::cli::{CliError, render};
use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::mapping::Warning;

/// What a frame was, once it was printed.
pub(super) enum Answer {
    Hello,
    Opened { session: String, received: u32 },
    Received { seq: u32 },
    Step,
    Done,
    Error { problem: Problem },
}

/// Prints frames: steps and the totals, each as soon as it is there.
pub(super) struct Printer<'o, W> {
    out: &'o mut W,
    is_json: bool,
    pub(super) progress: ProgressBar,
    /// Of the attributes. Those that weigh nothing are not shown.
    pub(super) weights: Option<ByAttribute<f64>>,
    n_steps: u64,
    /// The state that the last step led to.
    state: Option<ByAttribute<Scalar>>,
    columns: Columns,
}

/// How the columns are laid out.
#[derive(Clone, Copy)]
struct Columns {
    /// Grows with the names that were seen.
    action_width: usize,
    state_width: usize,
    /// Whether there is room for when a step was committed, and whether it was proven.
    with_proof: bool,
}

impl Columns {
    /// Columns that are no wider than `width`, if that is not very narrow.
    fn within(width: usize) -> Self {
        /// Of the columns that always stand there, with two spaces between them and an action of common length.
        const OTHERS: usize = 56;
        const PROOF: usize = 15;
        const LEAST: usize = 16;
        let with_proof = OTHERS + PROOF + LEAST <= width;
        let others = if with_proof { OTHERS + PROOF } else { OTHERS };
        Self { action_width: 10, state_width: width.saturating_sub(others).clamp(LEAST, 60), with_proof }
    }
}

impl<'o, W: Write> Printer<'o, W> {
    pub(super) fn new(out: &'o mut W, is_json: bool) -> Self {
        // Draws nothing unless standard error is a terminal.
        let progress = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        if let Ok(style) = ProgressStyle::with_template("{spinner} {pos} observations in, {msg} steps committed") {
            progress.set_style(style);
        }
        progress.set_message("0");
        Self {
            out,
            is_json,
            progress,
            weights: None,
            n_steps: 0,
            state: None,
            columns: Columns::within(render::width()),
        }
    }

    pub(super) fn received(&self, n_observations: u32) {
        self.progress.set_position(n_observations.into());
    }

    pub(super) fn frame(&mut self, text: &str) -> Result<Answer, CliError> {
        let frame: Frame = serde_json::from_str(text).map_err(|error| CliError::Io(error.into()))?;
        Ok(match frame {
            Frame::Hello => Answer::Hello,
            Frame::Opened { session, weights, received } => {
                self.weights = Some(weights);
                Answer::Opened { session, received }
            }
            Frame::Received { seq } => Answer::Received { seq },
            Frame::Step(step) => {
                self.n_steps += 1;
                self.progress.set_message(self.n_steps.to_string());
                if !self.is_json && self.n_steps == 1 {
                    let header = self
                        .row(["step", "observation", "move", "action", "distance", "cost", "proven", "after"], "state");
                    self.line(&header)?;
                }
                let line = if self.is_json { text.to_owned() } else { self.readable(step) };
                self.line(&line)?;
                Answer::Step
            }
            Frame::Done { policy_id, status, cost, warnings } => {
                let line = if self.is_json {
                    text.to_owned()
                } else {
                    let policy = policy_id.map(|id| format!("\npolicy    {id}")).unwrap_or_default();
                    format!("{}status    {}{policy}", render::cost(&cost), status.name())
                };
                self.line(&line)?;
                for Warning { pointer, detail } in warnings {
                    if self.is_json {
                        // Those who read the output by a program see it here.
                        self.progress.suspend(|| writeln!(std::io::stderr(), "warning: {pointer}: {detail}"))?;
                    } else {
                        self.line(&format!("warning   {pointer}: {detail}"))?;
                    }
                }
                Answer::Done
            }
            Frame::Error { problem } => Answer::Error { problem },
        })
    }

    /// How many steps were printed.
    pub(super) fn n_steps(&self) -> u64 {
        self.n_steps
    }

    /// Tells whoever watches of something, above the progress line; a pipe is told nothing.
    pub(super) fn note(&self, text: &str) {
        self.progress.println(text);
    }

    fn readable(&mut self, step: StepFrame) -> String {
        let state = render::changes(self.weights.as_ref(), self.state.as_ref(), &step.state);
        let action = step.action.as_deref().unwrap_or("-");
        self.columns.action_width = self.columns.action_width.max(action.chars().count());
        let cells = [
            &*step.step.to_string(),
            &step.observation.to_string(),
            render::name(step.kind),
            action,
            &render::decimal(step.distance),
            &render::decimal(step.cost),
            if step.proven { "yes" } else { "no" },
            &step.after.to_string(),
        ];
        let row = self.row(cells, &state);
        self.state = Some(step.state);
        row
    }

    /// A row of the table, with the state between its fourth and fifth cell, on as many lines as that takes.
    fn row(&self, [step, observation, kind, action, distance, cost, proven, after]: [&str; 8], state: &str) -> String {
        let Columns { action_width, state_width, with_proof } = self.columns;
        let begin = format!("{step:>4}  {observation:>11}  {kind:<5}  {action:<action_width$}");
        let mut lines = render::wrapped(state, state_width).into_iter();
        let mut row = format!("{begin}  {:<state_width$}  {distance:>8}  {cost:>6}", lines.next().unwrap_or_default());
        if with_proof {
            let _ = write!(row, "  {proven:<6}  {after:>5}");
        }
        for line in lines {
            let _ = write!(row, "\n{:width$}  {line}", "", width = begin.chars().count());
        }
        row
    }

    /// Writes a line at once, above the progress line.
    fn line(&mut self, line: &str) -> Result<(), CliError> {
        let Self { out, progress, .. } = self;
        progress.suspend(|| writeln!(out, "{line}").and_then(|()| out.flush()))?;
        Ok(())
    }
}
