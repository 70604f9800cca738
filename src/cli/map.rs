//! `etude map`.

use std::io::{self, Write};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use clap::{Args, ValueEnum};
use indicatif::ProgressBar;
use serde_json::{Value, json};

use super::drawing::PictureFlags;
use super::input::{Cells, Observations, Spot};
use super::opened::open;
use super::options::{FlaggedRequest, Lookahead, OptionFlags, ReadingFlags, parse_within};
use super::{CliError, render};
use crate::clock::Clock;
use crate::config::parse_whole;
use crate::service::hash_of_definition;
use etude_core::document::{self, Faults, ParseError, Place};
use etude_core::interrupt::{Interrupted, Signal, Uninterrupted, time_until_finish};
use etude_core::mapping::{Mapper, Policy, Request, Stamp, Warning};
use etude_core::model::{CompileError, Definition, Format, Limits, Model, ReadError};

#[derive(Args, Debug)]
pub(super) struct Map {
    /// The imitator's model: JSON, as for PUT /v1/models; - for standard input.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// The demonstration: CSV with a header, a JSON array of observed states, JSON lines, or a whole request as for POST /v1/policies;
    /// - for standard input.
    #[arg(long, value_name = "FILE")]
    demonstration: PathBuf,
    #[command(flatten)]
    reading: ReadingFlags,
    #[command(flatten)]
    options: OptionFlags,
    /// Map as a stream with this lookahead would; none, as if left out: the global optimum.
    #[arg(long, value_name = "OBSERVATIONS|none")]
    lookahead: Option<Lookahead>,
    /// Drop observations that stay within this of the last one kept in an attribute, and are equal to it in all others; may be given for several.
    #[arg(long, value_name = "ATTRIBUTE=WITHIN", value_parser = parse_within)]
    collapse: Vec<(String, f64)>,
    /// What guides the search.
    #[arg(long, value_enum)]
    heuristic: Option<HeuristicArg>,
    /// Most nodes to expand.
    #[arg(long, value_name = "N", value_parser = parse_whole::<u64>)]
    max_expansions: Option<u64>,
    /// Most milliseconds to search.
    #[arg(long, value_name = "MS", value_parser = parse_whole::<u64>)]
    deadline_ms: Option<u64>,
    /// Print the policy as JSON instead of a table.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    picture: PictureFlags,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum HeuristicArg {
    Default,
    Paper,
    None,
}

impl Map {
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        if self.model == Path::new("-") && self.demonstration == self.model {
            let detail = "--model and --demonstration: only one of them can be standard input";
            return Err(CliError::Faulty(detail.to_owned()));
        }
        let (definition, model) = read_model(&self.model)?;
        let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted)?);
        let cells = self.options.cells(|| Cells::of(mapper.model()));
        let mut observations = Observations::open(&self.demonstration, &self.reading.columns, &cells)?;
        let (request, spots) = self.request(&mut observations)?;

        let document = request.document();
        let mut faults = Faults::default();
        let object = Place::root(&document).object(Request::FIELDS, &mut faults);
        if let Some(place) = object.as_ref().and_then(|object| object.optional("learner")) {
            faults.note(&place, "a learner is known to a service alone: ask that, or give its weights by --weight");
        }
        let read = object.and_then(|object| Request::read(mapper.model(), &object, &mut faults));
        let told = |faults: Faults| request.told_of(&faults, observations.source(), &spots);
        let asked = faults.check(read).map_err(told)?;

        let clock = Clock::system();
        let started = clock.instant();
        let mut interrupt = || match asked.deadline.map(time_until_finish) {
            Some(deadline) if clock.elapsed(started) >= deadline => Signal::Finish,
            _ => Signal::Continue,
        };
        let mapping = asked.solve(&mapper, &mut interrupt)?;
        let stamp = Stamp {
            id: None,
            model: document["model"].as_str().unwrap_or_default().to_owned(),
            model_hash: hash_of_definition(&definition)?,
            lookahead: asked.lookahead.map(NonZeroU32::get),
            elapsed_us: as_micros(clock.elapsed(started)),
            warnings: asked.problem.warnings(&document::Path::Member(&document::Path::Root, "demonstration")),
            ..Stamp::default()
        };
        let policy = Policy::new(&stamp, &asked.problem, &mapping)?;
        self.picture.draw(&policy, mapper.model(), &asked.problem)?;
        let warnings = policy.warnings.iter();
        let mut warnings =
            warnings.map(|Warning { pointer, detail }| request.tell(pointer, detail, observations.source(), &spots));
        if self.json {
            serde_json::to_writer(&mut *out, &policy).map_err(io::Error::from)?;
            writeln!(out)?;
            // Those who read the output by a program see it here.
            warnings.try_for_each(|warning| writeln!(io::stderr(), "warning: {warning}"))?;
        } else {
            writeln!(out, "{}", render::steps(&policy, render::width()))?;
            write!(out, "{}", render::totals(&policy))?;
            warnings.try_for_each(|warning| writeln!(out, "warning   {warning}"))?;
        }
        Ok(())
    }

    /// The request that the files and flags amount to, and where its observations stood.
    fn request(&self, observations: &mut Observations) -> Result<(FlaggedRequest, Vec<Spot>), CliError> {
        let mut request = FlaggedRequest::new(observations.take_request());
        let (mut states, mut spots) = (Vec::new(), Vec::new());
        while let Some(observation) = observations.next()? {
            states.push(observation.state);
            spots.push(observation.spot);
        }
        if states.is_empty() {
            return Err(CliError::Faulty(observations.source().tell("", "nothing was observed")));
        }
        request.insert("demonstration", states.into());
        if request.members().get("model").is_none_or(Value::is_null) {
            let stem = self.model.file_stem().map(|stem| stem.to_string_lossy().into_owned());
            request.set(&format!("--model {}", self.model.display()), &["model"], stem.unwrap_or_default().into())?;
        }
        self.options.add_to(&mut request)?;
        for (attribute, within) in &self.collapse {
            request.set(&format!("--collapse {attribute}={within}"), &["collapse", attribute], json!(within))?;
        }
        let heuristic = self.heuristic.and_then(|heuristic| heuristic.to_possible_value());
        for (flag, name, value) in [
            ("--lookahead", "lookahead", self.lookahead.map(Lookahead::document)),
            ("--heuristic", "heuristic", heuristic.map(|heuristic| heuristic.get_name().into())),
            ("--max-expansions", "max_expansions", self.max_expansions.map(Value::from)),
            ("--deadline-ms", "deadline_ms", self.deadline_ms.map(Value::from)),
        ] {
            request.set_some(flag, name, value)?;
        }
        Ok((request, spots))
    }
}

fn as_micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}

/// Reads and compiles a model, as its file comes, which may be compressed. There is no limit to tables but memory: nobody else is served.
pub(super) fn read_model(path: &Path) -> Result<(Definition, Model), CliError> {
    let faulty = |faults| CliError::Faults { what: format!("the model {}", path.display()), faults };
    let content = open(path, &ProgressBar::hidden())?;
    let definition = Definition::parse_from(content, Format::Json, Limits::NONE, &mut Uninterrupted);
    let definition = definition.map_err(|error| match error {
        ReadError::Faults(faults) | ReadError::Parse(ParseError::Faults(faults)) => faulty(faults),
        ReadError::Cancelled(cancelled) => cancelled.into(),
        ReadError::OutOfTime => Interrupted::OutOfTime.into(),
        ReadError::Read(source) => CliError::Read { path: path.to_owned(), source },
        ReadError::Parse(_) | ReadError::TooLarge(_) => CliError::Faulty(format!("{}: {error}", path.display())),
    })?;
    let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted);
    let model = model.map_err(|error| match error {
        CompileError::Faults(faults) => faulty(faults),
        CompileError::Cancelled(cancelled) => cancelled.into(),
        CompileError::OutOfTime => Interrupted::OutOfTime.into(),
    })?;
    Ok((definition, model))
}
