//! Prints a stream, frame by frame, above a line of progress.
//!
//! Its columns are written by hand, as a table of comfy-table is laid out once all its rows are known: here each is shown at once.

use std::io::Write;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::frames::{Frame, Problem, StepFrame};
use crate::cli::{CliError, render};
use etude_core::attribute::ByAttribute;

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
    /// Widths of the columns of actions and states, which grow with what was seen.
    widths: (usize, usize),
}

impl<'o, W: Write> Printer<'o, W> {
    pub(super) fn new(out: &'o mut W, is_json: bool) -> Self {
        // Draws nothing unless standard error is a terminal.
        let progress = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        if let Ok(style) = ProgressStyle::with_template("{spinner} {pos} observations in, {msg} steps committed") {
            progress.set_style(style);
        }
        progress.set_message("0");
        Self { out, is_json, progress, weights: None, n_steps: 0, widths: (10, 20) }
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
                    let state = render::state(self.weights.as_ref(), &step.state);
                    // Room for what other states will take.
                    self.widths.1 = state.chars().count() + 3;
                    let (action_width, state_width) = self.widths;
                    let header = format!(
                        "step  observation  move   {:<action_width$}  {:<state_width$}  distance    cost  proven  after",
                        "action", "state",
                    );
                    self.line(&header)?;
                }
                let line = if self.is_json { text.to_owned() } else { self.readable(&step) };
                self.line(&line)?;
                Answer::Step
            }
            Frame::Done { policy_id, status, cost } => {
                let line = if self.is_json {
                    text.to_owned()
                } else {
                    let policy = policy_id.map(|id| format!("\npolicy    {id}")).unwrap_or_default();
                    format!("{}status    {}{policy}", render::cost(&cost), status.name())
                };
                self.line(&line)?;
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

    fn readable(&mut self, step: &StepFrame) -> String {
        let state = render::state(self.weights.as_ref(), &step.state);
        let action = step.action.as_deref().unwrap_or("-");
        self.widths = (self.widths.0.max(action.len()), self.widths.1.max(state.chars().count()));
        let (action_width, state_width) = self.widths;
        format!(
            "{:>4}  {:>11}  {:<5}  {action:<action_width$}  {state:<state_width$}  {:>8}  {:>6}  {:<6}  {:>5}",
            step.step,
            step.observation,
            render::name(step.kind),
            render::decimal(step.distance),
            render::decimal(step.cost),
            if step.proven { "yes" } else { "no" },
            step.after,
        )
    }

    /// Writes a line at once, above the progress line.
    fn line(&mut self, line: &str) -> Result<(), CliError> {
        let Self { out, progress, .. } = self;
        progress.suspend(|| writeln!(out, "{line}").and_then(|()| out.flush()))?;
        Ok(())
    }
}
