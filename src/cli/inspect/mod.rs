//! `etude model inspect`.

mod told;

use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::client::{Client, ServerUrl};
use super::input::{Cells, Observations, Source, Spot, parse_json};
use super::map::read_model;
use super::options::{FlaggedRequest, ReadingFlags, parse_observed, parse_start, parse_weight};
use super::{CliError, render, runtime};
use crate::service::hash_of_definition;
use etude_core::attribute::AttributeDocument;
use etude_core::document::{Faults, Place};
use etude_core::inspection::{Query, Report, inspect};
use etude_core::interrupt::Uninterrupted;

/// What a model is, as far as it is looked at of a service's answer.
#[derive(Deserialize)]
struct Registered {
    attributes: Vec<AttributeDocument>,
}

#[derive(Args, Debug)]
pub(super) struct Inspect {
    /// The model: a JSON file, as for PUT /v1/models; - for standard input. With --server the name of a model that is registered there.
    #[arg(value_name = "FILE|NAME")]
    model: PathBuf,
    /// A demonstration that the body would follow: a file, as for etude map. Tells what of it the body can never meet.
    #[arg(long, value_name = "FILE")]
    demonstration: Option<PathBuf>,
    #[command(flatten)]
    reading: ReadingFlags,
    /// Let the service at this address do it, such as <http://127.0.0.1:8080>.
    #[arg(long, value_name = "URL")]
    server: Option<ServerUrl>,
    /// Weight of an attribute; may be given for several. What weighs nothing is not compared.
    #[arg(long = "weight", value_name = "ATTRIBUTE=WEIGHT", value_parser = parse_weight)]
    weights: Vec<(String, f64)>,
    /// Where the imitator may start: a state's index, a JSON object of attribute values, or a JSON array of these.
    #[arg(long, value_name = "STATE", value_parser = parse_start)]
    start: Option<Value>,
    /// The weight of each observation, in order: a JSON array of numbers; 1 where it is null.
    #[arg(long, value_name = "WEIGHTS", value_parser = parse_json)]
    observation_weights: Option<Value>,
    /// What is observed as an attribute, of a demonstrator with attributes of its own, as for etude map.
    #[arg(long, value_name = "ATTRIBUTE=EXPRESSION", value_parser = parse_observed)]
    observe: Vec<(String, String)>,
    /// An action that the body lacks; may be given for several.
    #[arg(long, value_name = "ACTION")]
    without: Vec<String>,
    /// Print the report as JSON instead of tables.
    #[arg(long)]
    json: bool,
}

/// What is asked, and where its observations stood.
struct Asked {
    request: FlaggedRequest,
    source: Arc<Source>,
    spots: Vec<Spot>,
}

impl Inspect {
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        let (report, asked) = match &self.server {
            None => self.inspect_here()?,
            Some(server) => runtime()?.block_on(self.inspect_at(server))?,
        };
        if self.json {
            serde_json::to_writer(&mut *out, &report).map_err(io::Error::from)?;
            return Ok(writeln!(out)?);
        }
        write!(out, "{}", told::model(&report, render::width()))?;
        if let Some(found) = &report.demonstration {
            write!(out, "\n{}", told::demonstration(found, render::width()))?;
            for warning in &found.warnings {
                let told = asked.request.tell(&warning.pointer, &warning.detail, &asked.source, &asked.spots);
                write!(out, "{}", told::line("warning", &told, render::width()))?;
            }
        }
        Ok(())
    }

    fn inspect_here(&self) -> Result<(Report, Asked), CliError> {
        let is_name = self.model.as_os_str() != "-" && !self.model.exists() && self.model.extension().is_none();
        if is_name {
            let detail =
                "there is no such file; if it is the name of a model at a service, say where that is by --server";
            return Err(CliError::Faulty(format!("{}: {detail}", self.model.display())));
        }
        if self.demonstration.as_ref() == Some(&self.model) {
            let detail = "the model and the demonstration cannot be the same file, or both standard input";
            return Err(CliError::Faulty(format!("{}: {detail}", self.model.display())));
        }
        let (definition, model) = read_model(&self.model)?;
        let asked = self.asked(&Cells::of(&model))?;
        let document = asked.request.document();
        let mut faults = Faults::default();
        let object = Place::root(&document).object(Query::FIELDS, &mut faults);
        let query = object.and_then(|object| Query::read(&model, &object, &mut faults));
        let query =
            faults.check(query).map_err(|faults| asked.request.told_of(&faults, &asked.source, &asked.spots))?;
        let report = inspect(&model, &query, &mut Uninterrupted)?;
        let name = self.model.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        Ok((Report { model: name, model_hash: hash_of_definition(&definition)?, ..report }, asked))
    }

    async fn inspect_at(&self, server: &ServerUrl) -> Result<(Report, Asked), CliError> {
        let client = Client::new(server)?;
        let path = format!("/v1/models/{}", self.model.display());
        let registered: Registered = client.get(&path).await?;
        let asked = self.asked(&Cells::told(&registered.attributes))?;
        let path = format!("{path}/report");
        if asked.request.members().is_empty() {
            return Ok((client.get(&path).await?, asked));
        }
        let report = client.post(&path, &asked.request.document()).await?;
        Ok((report, asked))
    }

    /// The request that the files and flags amount to. Of a whole request for a policy, what does not count here is left out.
    fn asked(&self, cells: &Cells) -> Result<Asked, CliError> {
        let mut asked = Asked { request: FlaggedRequest::new(Map::new()), source: Arc::default(), spots: Vec::new() };
        let any = Cells::any();
        if let Some(path) = &self.demonstration {
            let mut observations =
                Observations::open(path, &self.reading.columns, if self.observe.is_empty() { cells } else { &any })?;
            let mut members = observations.take_request();
            members.retain(|name, _| Query::FIELDS.contains(&name.as_str()));
            asked.request = FlaggedRequest::new(members);
            let mut states = Vec::new();
            while let Some(observation) = observations.next()? {
                states.push(observation.state);
                asked.spots.push(observation.spot);
            }
            if states.is_empty() {
                return Err(CliError::Faulty(observations.source().tell("", "nothing was observed")));
            }
            asked.source = Arc::clone(observations.source());
            asked.request.insert("demonstration", states.into());
        }
        for (attribute, weight) in &self.weights {
            asked.request.set(&format!("--weight {attribute}={weight}"), &["weights", attribute], json!(weight))?;
        }
        for (attribute, expression) in &self.observe {
            let flag = format!("--observe {attribute}={expression}");
            asked.request.set(&flag, &["observe", attribute], json!(expression))?;
        }
        asked.request.set_some("--start", "start", self.start.clone())?;
        asked.request.set_some("--observation-weights", "observation_weights", self.observation_weights.clone())?;
        asked.request.set_each("--without", "without", &self.without);
        Ok(asked)
    }
}
