//! `etude stream`: observations in by standard input, steps out as they are committed.
//!
//! ```text
//! standard input -> thread, line by line -> OnlineMapping, or a service -> frames -> Printer -> standard output
//! ```
//!
//! With and without a server, what is printed is made from the same frames of the stream protocol.

pub(super) mod client;
pub(super) mod frames;
mod lines;
mod printer;
mod session;

use std::io::{self, Write};
use std::num::NonZeroU32;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use serde_json::{Map as Members, Value, json};

use self::frames::nothing_observed;
use self::lines::{Line, Lines, read_lines};
use self::printer::Printer;
use self::session::StreamSession;
use super::map::{parse_json, parse_weight, read_json, read_model};
use super::{CliError, client as http, runtime};
use crate::stream::frames::ServerFrame;
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{CommittedStep, Demonstration, Mapper, OnlineMapping};
use etude_core::model::Limits;

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
        let mut print = |printer: &mut Printer<'_, _>, steps: &[CommittedStep]| {
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
        let client = http::client()?;
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
        let _: Value = http::answer(&url, client.put(&url).json(&definition)).await?;
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
