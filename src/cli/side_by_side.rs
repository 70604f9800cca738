//! A stream as the demo shows it: observations on one side, the steps that they commit on the other.

use std::io::Write;

use reqwest::Client;
use serde_json::{Value, json};

use super::options::faulty;
use super::stream::client;
use super::stream::frames::{Frame, StepFrame};
use super::{CliError, render};
use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::document::Fault;

/// Streams `demonstration` to `model` at the service, an observation at a time, and shows what comes back as it comes.
pub(super) async fn stream(
    http: &Client,
    server: &str,
    model: &str,
    demonstration: &Value,
    out: &mut impl Write,
) -> Result<(), CliError> {
    let io = |error: serde_json::Error| CliError::Io(error.into());
    let observations: Vec<ByAttribute<Scalar>> = serde_json::from_value(demonstration.clone()).map_err(io)?;
    let (frames, mut answers) = client::connect(http, server).await?;
    frames.send(&json!({"type": "open", "model": model, "lookahead": 8})).await;
    let observe = async |seq: usize| match observations.get(seq) {
        Some(state) => frames.send(&json!({"type": "observe", "seq": seq, "states": [state]})).await,
        None => frames.send(&json!({"type": "end", "seq": observations.len()})).await,
    };
    let mut sides = Sides { out, left: String::new() };
    sides.left("observed")?;
    sides.right("committed")?;
    let (mut weights, mut last) = (None, None);
    while let Some(text) = answers.receive().await? {
        match serde_json::from_str(&text).map_err(io)? {
            Frame::Hello => {}
            Frame::Opened { weights: known, .. } => {
                weights = Some(known);
                observe(0).await;
            }
            Frame::Received { seq } => {
                let seen = seq as usize;
                let before = seen.checked_sub(2).map(|before| &observations[before]);
                sides.left(&format!(
                    "{:>2} {}",
                    seen - 1,
                    render::changes(weights.as_ref(), before, &observations[seen - 1])
                ))?;
                // What this observation commits is on its way before the next one is answered.
                observe(seen).await;
            }
            Frame::Step(step) => {
                sides.right(&committed(weights.as_ref(), last.as_ref(), &step))?;
                last = Some(step.state);
            }
            Frame::Done { status, cost, .. } => {
                sides.flush()?;
                writeln!(out, "{}status    {}", render::cost(&cost), status.name())?;
                return Ok(());
            }
            Frame::Error { problem } => {
                let tell = |faults: &[Fault]| {
                    faulty(faults.iter().map(|fault| format!("{}: {}", fault.pointer, fault.detail)).collect(), 0)
                };
                return Err(problem.told(None, tell));
            }
        }
    }
    Err(CliError::Stream("the service ended it".to_owned()))
}

/// Width of the left column; longer texts stand alone.
const LEFT_WIDTH: usize = 20;

/// Two columns, of which the left one may wait for the right one.
struct Sides<'o, W> {
    out: &'o mut W,
    left: String,
}

impl<W: Write> Sides<'_, W> {
    fn left(&mut self, text: &str) -> Result<(), CliError> {
        self.flush()?;
        text.clone_into(&mut self.left);
        Ok(())
    }

    fn right(&mut self, text: &str) -> Result<(), CliError> {
        if self.left.len() > LEFT_WIDTH {
            self.flush()?;
        }
        writeln!(self.out, "  {:<LEFT_WIDTH$}  {text}", self.left)?;
        self.left.clear();
        Ok(())
    }

    fn flush(&mut self) -> Result<(), CliError> {
        if !self.left.is_empty() {
            writeln!(self.out, "  {}", self.left)?;
            self.left.clear();
        }
        Ok(())
    }
}

/// A step as it is shown, with what it changes of the state `before`.
fn committed(weights: Option<&ByAttribute<f64>>, before: Option<&ByAttribute<Scalar>>, step: &StepFrame) -> String {
    let how = if step.proven { "proven" } else { "lookahead" };
    format!(
        "{:>2} {:<5} {:>2} {:<10} {how:<9} {}",
        step.step,
        render::name(step.kind),
        step.observation,
        step.action.as_deref().unwrap_or("-"),
        render::changes(weights, before, &step.state),
    )
}
