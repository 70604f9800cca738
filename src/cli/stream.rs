//! `etude stream`: observations in by standard input, steps out as they are committed.
//!
//! ```text
//! standard input -> thread, line by line -> OnlineMapping, or a service -> frames -> Printer -> standard output
//! ```
//!
//! With and without a server, what is printed is made from the same frames of the stream protocol.

use std::io::{self, BufRead, Write};
use std::num::NonZeroU32;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Deserialize;
use serde_json::{Map as Members, Value, json};
use tokio::sync::mpsc;

use super::map::{parse_json, parse_weight, read_json, read_model};
use super::stream_session::StreamSession;
use super::{CliError, client, render, runtime};
use crate::stream::frames::ServerFrame;
use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::document::{self, Faults, ParseError, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Cost, Demonstration, Mapper, MoveKind, OnlineMapping, Status};
use etude_core::model::Limits;

/// Lines that were read ahead.
pub(super) const MAX_READ_AHEAD: usize = 64;

#[derive(Args, Debug)]
pub(super) struct Stream {
    /// The imitator's model: a file, as for PUT /v1/models. With --server also the name of a model that is registered
    /// there; a file is registered first, under its name without the extension.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// Let the service at this address do it, such as <http://127.0.0.1:8080>, and keep the session there.
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    /// How often in a row a lost connection to the service is tried anew before it is given up.
    #[arg(long, value_name = "N", default_value_t = 10)]
    retries: u32,
    /// How many observations past the current one a step may wait for; none: commit only what is proven.
    #[arg(long, value_name = "N|none", default_value = "8", value_parser = parse_lookahead)]
    lookahead: Lookahead,
    /// Weight of an attribute; may be given for several.
    #[arg(long = "weight", value_name = "ATTRIBUTE=WEIGHT", value_parser = parse_weight)]
    weights: Vec<(String, f64)>,
    /// Where the imitator starts: a state's index, or a JSON object of attribute values.
    #[arg(long, value_name = "STATE", value_parser = parse_json)]
    start: Option<Value>,
    /// Print each step as a line of JSON, and the totals as the last one.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug)]
struct Lookahead(Option<NonZeroU32>);

impl Stream {
    /// Reads observations from standard input, one per line, and prints the steps that they commit.
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        let mut printer = Printer::new(out, self.json);
        let done = match &self.server {
            None => self.run_here(&mut printer),
            Some(server) => runtime()?.block_on(self.run_at(server, &mut printer)),
        };
        printer.progress.finish_and_clear();
        done
    }

    fn run_here(&self, printer: &mut Printer<'_, impl Write>) -> Result<(), CliError> {
        let (_, model) = read_model(&self.model, Limits::NONE)?;
        let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted)?);
        let schema = mapper.model().schema();
        let request = Value::Object(self.options());
        let mut faults = Faults::default();
        let object = Place::root(&request).open_object(&mut faults);
        let opening = object.as_ref().map(|object| {
            let weights = object.optional("weights").map(|place| schema.read_weights(&place, &mut faults));
            let start = object.optional("start").map(|place| mapper.model().read_start(&place, &mut faults)?.state());
            (weights.flatten().unwrap_or_else(|| schema.weights()), start.flatten())
        });
        let what = "the options".to_owned();
        let (weights, start) = faults.check(opening).map_err(|faults| CliError::Faults { what, faults })?;

        printer.weights = Some(schema.by_attribute(weights.as_slice().iter().copied()));
        let mut online = OnlineMapping::new(&mapper, weights, start, self.lookahead.0);
        let mut actions = Vec::new();
        let mut print = |printer: &mut Printer<'_, _>, steps: &[etude_core::mapping::CommittedStep]| {
            for step in steps {
                actions.extend(step.step.action.clone());
                printer.frame(&text_of(&ServerFrame::Step(step.into()))?)?;
            }
            Ok::<_, CliError>(())
        };
        let mut lines = Lines::new(io::stdin().lock());
        while let Some(Line { number, observation }) = lines.next()? {
            if online.n_observed() as usize == Demonstration::MAX_OBSERVATIONS {
                let most = Demonstration::MAX_OBSERVATIONS;
                return Err(CliError::Line { line: number, problem: format!("one more than the {most} that may be") });
            }
            let mut faults = Faults::default();
            let read = schema.read_observation(&Place::root(&observation), &mut faults);
            let observation =
                faults.check(read).map_err(|faults| CliError::Line { line: number, problem: faults.to_string() })?;
            let steps = online.observe(&observation, &mut Uninterrupted)?;
            printer.received(online.n_observed());
            print(printer, &steps)?;
        }
        let Some((steps, mapping)) = online.end() else { return Err(nothing_observed()) };
        print(printer, &steps)?;
        let done =
            ServerFrame::Done { policy_id: None, status: mapping.status, cost: mapping.cost, actions: Some(&actions) };
        printer.frame(&text_of(&done)?).map(drop)
    }

    async fn run_at(&self, server: &str, printer: &mut Printer<'_, impl Write>) -> Result<(), CliError> {
        let client = client::client()?;
        let model = self.register(&client, server).await?;
        let mut open = self.options();
        open.extend([("type".to_owned(), json!("open")), ("model".to_owned(), json!(model))]);
        open.insert("lookahead".to_owned(), json!(self.lookahead.0));
        StreamSession::new(client, server, open.into(), read_lines()).run(printer, self.retries).await
    }

    /// The name of the model at the service; a file is registered under its name first.
    async fn register(&self, client: &reqwest::Client, server: &str) -> Result<String, CliError> {
        if !self.model.is_file() {
            return Ok(self.model.to_string_lossy().into_owned());
        }
        let definition = read_json(&self.model)?;
        let name = self.model.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        let url = format!("{}/v1/models/{name}", server.trim_end_matches('/'));
        let _: Value = client::answer(&url, client.put(&url).json(&definition)).await?;
        Ok(name)
    }

    /// What the options amount to, as in an `open` frame.
    fn options(&self) -> Members<String, Value> {
        let weights: Members<_, _> = self.weights.iter().map(|(name, weight)| (name.clone(), json!(weight))).collect();
        let mut options = Members::from_iter([("weights".to_owned(), weights.into())]);
        options.extend(self.start.clone().map(|start| ("start".to_owned(), start)));
        options
    }
}

fn text_of(frame: &ServerFrame<'_>) -> Result<String, CliError> {
    serde_json::to_string(frame).map_err(|error| CliError::Io(error.into()))
}

fn nothing_observed() -> CliError {
    CliError::Stream("nothing was observed".to_owned())
}

/// What the service found wrong, with the line of the input where it is that.
pub(super) fn refused(problem: Problem, line: Option<u64>) -> CliError {
    let Problem { kind, detail, errors } = problem;
    match (kind.as_str(), line) {
        ("/problems/invalid", Some(line)) => {
            let places = errors.iter().map(|Fault { pointer, detail }| {
                // Each frame has one state, which is the line.
                format!("{}: {detail}", pointer.strip_prefix("/states/0").unwrap_or(pointer))
            });
            CliError::Line { line, problem: places.collect::<Vec<_>>().join("\n") }
        }
        ("/problems/empty", _) => nothing_observed(),
        _ => {
            let places = errors.iter().map(|Fault { pointer, detail }| format!("\n{pointer}: {detail}"));
            CliError::Stream(detail + &places.collect::<String>())
        }
    }
}

/// A line of the input.
pub(super) struct Line {
    /// Counted from 1, blank ones too.
    pub(super) number: u64,
    pub(super) observation: Value,
}

struct Lines<R> {
    input: R,
    n_read: u64,
}

impl<R: BufRead> Lines<R> {
    fn new(input: R) -> Self {
        Self { input, n_read: 0 }
    }

    /// The next line that is not blank; `None` at the end.
    fn next(&mut self) -> Result<Option<Line>, CliError> {
        let mut text = Vec::new();
        loop {
            text.clear();
            if self.input.read_until(b'\n', &mut text)? == 0 {
                return Ok(None);
            }
            self.n_read += 1;
            if !text.trim_ascii().is_empty() {
                break;
            }
        }
        let number = self.n_read;
        let told = |error: ParseError| CliError::Line { line: number, problem: error.to_string() };
        Ok(Some(Line { number, observation: document::parse(text.trim_ascii()).map_err(told)? }))
    }
}

/// Reads standard input in a thread of its own, because waiting for it cannot be given up.
fn read_lines() -> mpsc::Receiver<Result<Option<Line>, CliError>> {
    let (sender, lines) = mpsc::channel(MAX_READ_AHEAD);
    std::thread::spawn(move || {
        let mut input = Lines::new(io::stdin().lock());
        loop {
            let line = input.next();
            let is_last = !matches!(line, Ok(Some(_)));
            if sender.blocking_send(line).is_err() || is_last {
                return;
            }
        }
    });
    lines
}

/// A frame from the service, as far as it is of use here.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub(super) enum Frame {
    Hello,
    Opened { session: String, weights: ByAttribute<f64>, received: u32 },
    Received { seq: u32 },
    Step(Step),
    Done { policy_id: Option<String>, status: Status, cost: Cost },
    Error { problem: Problem },
}

/// A committed step.
#[derive(Debug, Deserialize)]
#[expect(clippy::struct_field_names, reason = "one word for one thing, as in the frame")]
pub(super) struct Step {
    pub(super) step: u32,
    pub(super) observation: u32,
    #[serde(rename = "move")]
    pub(super) kind: MoveKind,
    pub(super) action: Option<String>,
    pub(super) state: ByAttribute<Scalar>,
    pub(super) distance: f64,
    pub(super) cost: f64,
    pub(super) proven: bool,
    pub(super) after: u32,
}

#[derive(Debug, Deserialize)]
pub(super) struct Problem {
    #[serde(rename = "type")]
    kind: String,
    detail: String,
    #[serde(default)]
    errors: Vec<Fault>,
}

impl Problem {
    /// Whether it is one of the service that passes, so that the session is to be resumed.
    pub(super) fn is_passing(&self) -> bool {
        ["/problems/stopping", "/problems/overloaded", "/problems/internal"].contains(&self.kind.as_str())
    }
}

#[derive(Debug, Deserialize)]
struct Fault {
    pointer: String,
    detail: String,
}

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
    progress: ProgressBar,
    /// By which attributes are shown: those that weigh something.
    weights: Option<ByAttribute<f64>>,
    n_steps: u64,
    /// Widths of the columns of actions and states, which grow with what was seen.
    widths: (usize, usize),
}

impl<'o, W: Write> Printer<'o, W> {
    fn new(out: &'o mut W, is_json: bool) -> Self {
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

    fn readable(&mut self, step: &Step) -> String {
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

fn parse_lookahead(text: &str) -> Result<Lookahead, String> {
    if text == "none" {
        return Ok(Lookahead(None));
    }
    let lookahead =
        text.parse().ok().filter(|lookahead: &NonZeroU32| lookahead.get() as usize <= Demonstration::MAX_OBSERVATIONS);
    lookahead
        .map(|lookahead| Lookahead(Some(lookahead)))
        .ok_or_else(|| format!("expected a number from 1 to {}, or none", Demonstration::MAX_OBSERVATIONS))
}
