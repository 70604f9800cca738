//! `etude map`.

use std::fs;
use std::io::{self, Read, Write};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use clap::{Args, ValueEnum};
use serde_json::{Map as Members, Value, json};

use super::{CliError, render};
use crate::clock::Clock;
use crate::service::hash_of;
use etude_core::document::{self, Faults, Place};
use etude_core::interrupt::{Interrupted, Signal, Uninterrupted, time_until_finish};
use etude_core::mapping::{Mapper, Policy, Request, Stamp};
use etude_core::model::{CompileError, Definition, Limits, Model};

#[derive(Args, Debug)]
pub(super) struct Map {
    /// The imitator's model: JSON, as for PUT /v1/models; - for standard input.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// The demonstration: a JSON array of observed states, or a whole request as for POST /v1/policies; - for standard input.
    #[arg(long, value_name = "FILE")]
    demonstration: PathBuf,
    /// Weight of an attribute; may be given for several.
    #[arg(long = "weight", value_name = "ATTRIBUTE=WEIGHT", value_parser = parse_weight)]
    weights: Vec<(String, f64)>,
    /// Where the imitator starts: a state's index, or a JSON object of attribute values.
    #[arg(long, value_name = "STATE", value_parser = parse_json)]
    start: Option<Value>,
    /// Map as a stream with this lookahead would; left out: the global optimum.
    #[arg(long, value_name = "OBSERVATIONS")]
    lookahead: Option<u32>,
    /// What guides the search.
    #[arg(long, value_enum)]
    heuristic: Option<HeuristicArg>,
    /// Most nodes to expand.
    #[arg(long, value_name = "N")]
    max_expansions: Option<u64>,
    /// Most milliseconds to search.
    #[arg(long, value_name = "MS")]
    deadline_ms: Option<u64>,
    /// Print the policy as JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum HeuristicArg {
    Default,
    Paper,
    None,
}

impl Map {
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        // A lookahead needs all states.
        let limits = if self.lookahead.is_some() { Limits::NONE } else { Limits::DEFAULT };
        let (definition, model) = read_model(&self.model, limits)?;
        let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted)?);

        let request = self.request()?;
        let mut faults = Faults::default();
        let object = Place::root(&request).object(Request::FIELDS, &mut faults);
        let read = object.and_then(|object| Request::read(mapper.model(), &object, &mut faults));
        let what = format!("the request made of {}", self.demonstration.display());
        let asked = faults.check(read).map_err(|faults| CliError::Faults { what, faults })?;

        let clock = Clock::system();
        let started = clock.instant();
        let mut interrupt = || match asked.deadline.map(time_until_finish) {
            Some(deadline) if clock.elapsed(started) >= deadline => Signal::Finish,
            _ => Signal::Continue,
        };
        let mapping = asked.solve(&mapper, &mut interrupt)?;
        let stamp = Stamp {
            id: None,
            model: request["model"].as_str().unwrap_or_default().to_owned(),
            model_hash: hash_of(&definition.text()),
            lookahead: asked.lookahead.map(NonZeroU32::get),
            elapsed_us: as_micros(clock.elapsed(started)),
            ..Stamp::default()
        };
        let policy = Policy::new(&stamp, &asked.problem, &mapping)?;
        if self.json {
            serde_json::to_writer(&mut *out, &policy).map_err(io::Error::from)?;
            writeln!(out)?;
        } else {
            writeln!(out, "{}", render::steps(&policy))?;
            write!(out, "{}", render::totals(&policy))?;
        }
        Ok(())
    }

    /// The request that the files and options amount to.
    fn request(&self) -> Result<Value, CliError> {
        let mut request = match read_json(&self.demonstration)? {
            Value::Object(request) => request,
            demonstration => Members::from_iter([("demonstration".to_owned(), demonstration)]),
        };
        let stem = || self.model.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        request.entry("model").or_insert_with(|| stem().into());
        if !self.weights.is_empty() {
            let weights = request.entry("weights").or_insert(Value::Null);
            if weights.is_null() {
                *weights = json!({});
            }
            let Value::Object(weights) = weights else {
                let path = self.demonstration.display();
                return Err(CliError::Option(format!("--weight: the `weights` of {path} are no object")));
            };
            weights.extend(self.weights.iter().map(|(attribute, weight)| (attribute.clone(), json!(weight))));
        }
        let heuristic = self.heuristic.and_then(|heuristic| heuristic.to_possible_value());
        let options = [
            ("start", self.start.clone()),
            ("lookahead", self.lookahead.map(Value::from)),
            ("heuristic", heuristic.map(|heuristic| heuristic.get_name().into())),
            ("max_expansions", self.max_expansions.map(Value::from)),
            ("deadline_ms", self.deadline_ms.map(Value::from)),
        ];
        request.extend(options.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))));
        Ok(request.into())
    }
}

fn as_micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}

/// Reads and compiles a model. There is no limit to tables but memory: nobody else is served.
pub(super) fn read_model(path: &Path, limits: Limits) -> Result<(Definition, Model), CliError> {
    let model_error = |error| match error {
        CompileError::Faults(faults) => CliError::Faults { what: path.display().to_string(), faults },
        CompileError::Cancelled(cancelled) => cancelled.into(),
        CompileError::OutOfTime => Interrupted::OutOfTime.into(),
    };
    let definition = Definition::read(&read_json(path)?, Limits::NONE, &mut Uninterrupted).map_err(model_error)?;
    let model = Model::compile(&definition, limits, &mut Uninterrupted)?;
    Ok((definition, model))
}

pub(super) fn read_json(path: &Path) -> Result<Value, CliError> {
    let read = if path == Path::new("-") {
        let mut text = Vec::new();
        io::stdin().lock().read_to_end(&mut text).map(|_| text)
    } else {
        fs::read(path)
    };
    let text = read.map_err(|source| CliError::Read { path: path.to_owned(), source })?;
    document::parse(&text).map_err(|source| CliError::Parse { path: path.to_owned(), source })
}

pub(super) fn parse_weight(text: &str) -> Result<(String, f64), String> {
    let (attribute, weight) = text.rsplit_once('=').ok_or("expected ATTRIBUTE=WEIGHT")?;
    let weight: f64 = weight.parse().map_err(|_| format!("expected a number, found {weight:?}"))?;
    if weight.is_finite() { Ok((attribute.to_owned(), weight)) } else { Err("expected a finite number".to_owned()) }
}

pub(super) fn parse_json(text: &str) -> Result<Value, String> {
    document::parse(text.as_bytes()).map_err(|error| error.to_string())
}
