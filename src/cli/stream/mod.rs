//! `etude stream`: observations in, steps out as they are committed.
//!
//! ```text
//! file or standard input -> Observations, as they come -> OnlineMapping, or a service -> frames -> Printer -> standard output
//! ```
//!
//! With and without a server, what is printed is made from the same frames of the stream protocol.

pub(super) mod client;
pub(super) mod frames;
mod printer;
mod session;

use std::io::Write;
use std::num::{NonZeroU32, NonZeroU64};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use serde::Deserialize;
use serde_json::json;

use self::frames::nothing_observed;
use self::printer::Printer;
use self::session::StreamSession;
use super::client::ServerUrl;
use super::input::{Cells, Observation, Observations};
use super::map::read_model;
use super::opened::read_json;
use super::options::{FlaggedRequest, Lookahead, OptionFlags, ReadingFlags, faulty};
use super::{CliError, client as http, runtime};
use crate::clock::Clock;
use crate::config::parse_whole;
use crate::service::{Waits, read_lookahead_ms};
use crate::stream::frames::ServerFrame;
use etude_core::attribute::AttributeDocument;
use etude_core::document::{Faults, Path, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{CommittedStep, Demonstration, Mapper, OnlineMapping, Options, RequestKind, Watch};

#[derive(Args, Debug)]
pub(super) struct Stream {
    /// The imitator's model: a file, as for PUT /v1/models. With --server also the name of a model that is registered
    /// there; a file is registered first, under its name without the extension.
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// The observations: CSV with a header or JSON lines, each taken as soon as it is there; or a JSON array, or a whole request, once it
    /// is complete. - is standard input.
    #[arg(long, value_name = "FILE", default_value = "-")]
    demonstration: PathBuf,
    #[command(flatten)]
    reading: ReadingFlags,
    /// Let the service at this address do it, such as <http://127.0.0.1:8080>, and keep the session there.
    #[arg(long, value_name = "URL")]
    server: Option<ServerUrl>,
    /// How often in a row a lost connection to the service is tried anew before it is given up.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = parse_whole::<u32>)]
    retries: u32,
    /// How many observations past the current one a step may wait for; none: commit only what is proven [default: 8].
    #[arg(long, value_name = "N|none")]
    lookahead: Option<Lookahead>,
    /// For how many milliseconds a step may wait for what is observed after it; as long as the lookahead lets it unless said. The earlier of
    /// both decides.
    #[arg(long, value_name = "MS")]
    lookahead_ms: Option<NonZeroU64>,
    #[command(flatten)]
    options: OptionFlags,
    /// Print each step as a line of JSON, and the totals as the last one.
    #[arg(long)]
    json: bool,
}

/// Lookahead where nothing is said of it.
const DEFAULT_LOOKAHEAD: Lookahead = Lookahead(NonZeroU32::new(8));

/// What is looked at of a service's answer that tells of a model.
#[derive(Deserialize)]
struct Registered {
    attributes: Vec<AttributeDocument>,
}

impl Stream {
    /// Reads observations and prints the steps that they commit.
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        let mut printer = Printer::new(out, self.json);
        let done = match &self.server {
            None => runtime()?.block_on(self.run_here(&mut printer)),
            Some(server) => runtime()?.block_on(self.run_at(server.as_str(), &mut printer)),
        };
        printer.progress.finish_and_clear();
        done
    }

    async fn run_here(&self, printer: &mut Printer<'_, impl Write>) -> Result<(), CliError> {
        let is_name = !self.model.exists() && self.model.components().count() == 1 && self.model.extension().is_none();
        if is_name {
            let detail =
                "there is no such file; if it is the name of a model at a service, say where that is by --server";
            return Err(CliError::Faulty(format!("--model {}: {detail}", self.model.display())));
        }
        let (_, model) = read_model(&self.model)?;
        let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted)?);
        let schema = mapper.model().schema();
        let mut observations = Observations::open(
            &self.demonstration,
            &self.reading.columns,
            &self.options.cells(|| Cells::of(mapper.model())),
        )?;
        let request = self.request(&mut observations)?;
        let document = request.document();
        let mut faults = Faults::default();
        let object = Place::root(&document).object(RequestKind::Session.fields(), &mut faults);
        let lookahead_ms = object.as_ref().and_then(|object| read_lookahead_ms(object, &mut faults));
        let options = object.and_then(|object| {
            Options::check_model(mapper.model(), &object, &mut faults);
            let options = Options::read(&object, mapper.model(), &Options::default(), &mut faults)?;
            options.check_has_lookahead(mapper.model(), &object, &mut faults);
            Some(options)
        });
        let source = Arc::clone(observations.source());
        let told = |faults: Faults| request.told_of(&faults, &source, &[]);
        let options = faults.check(options).map_err(told)?;

        let weights = options.weights_over(schema.weights());
        printer.weights = Some(schema.by_attribute(weights.as_slice().iter().copied()));
        let mut watch = Watch::new(&weights);
        let mut online = OnlineMapping::new(&mapper, weights, options.conditions(), options.lookahead);
        let mut actions = Vec::new();
        let mut print = |printer: &mut Printer<'_, _>, steps: &[CommittedStep]| {
            for step in steps {
                actions.extend(step.step.action.clone());
                printer.frame(&text_of(&ServerFrame::Step(step.into()))?)?;
            }
            Ok::<_, CliError>(())
        };
        let (clock, mut waits, mut n_met) = (Clock::system(), Waits::of(lookahead_ms), 0);
        let mut coming = observations.read_ahead();
        loop {
            let due = waits.as_ref().and_then(|waits| waits.next(n_met, online.n_observed()));
            let is_due = async {
                match due {
                    Some(due) => clock.sleep_until(due).await,
                    None => std::future::pending().await,
                }
            };
            let next = tokio::select! {
                biased;
                () = is_due => {
                    let steps = online.decide(&mut Uninterrupted)?;
                    met(&mut waits, &mut n_met, &steps);
                    print(printer, &steps)?;
                    continue;
                }
                next = coming.recv() => next,
            };
            let Some(Observation { spot, state }) = next.transpose()?.flatten() else { break };
            if online.n_observed() as usize == Demonstration::MAX_OBSERVATIONS {
                let detail = format!("one more than the {} that may be", Demonstration::MAX_OBSERVATIONS);
                return Err(CliError::Faulty(spot.tell("", &detail)));
            }
            let mut faults = Faults::default();
            let state = match &options.observe {
                None => Some(state),
                Some(perception) => perception.observe(&Place::root(&state), &mut faults),
            };
            let read = state.and_then(|state| schema.read_observation(&Place::root(&state), &mut faults));
            let told = |faults: Faults| {
                let told = faults.listed().iter().map(|fault| spot.tell(&fault.pointer, &fault.detail));
                faulty(told.collect(), faults.count() - faults.listed().len())
            };
            let observed = faults.check(read).map_err(told)?;
            watch.observe(mapper.model(), online.n_observed() as usize, &observed);
            if let Some(waits) = &mut waits {
                waits.came(online.n_observed(), Duration::ZERO, clock.instant());
            }
            let steps = online.observe(&observed, None, &mut Uninterrupted)?;
            met(&mut waits, &mut n_met, &steps);
            printer.received(online.n_observed());
            print(printer, &steps)?;
        }
        let Some((steps, mapping)) = online.end() else { return Err(nothing_observed()) };
        print(printer, &steps)?;
        let done = ServerFrame::Done {
            policy_id: None,
            status: mapping.status,
            cost: mapping.cost,
            end: &mapping.end,
            warnings: &watch.warnings(mapper.model(), &Path::Member(&Path::Root, "states")),
            actions: Some(&actions),
        };
        printer.frame(&text_of(&done)?).map(drop)
    }

    async fn run_at(&self, server: &str, printer: &mut Printer<'_, impl Write>) -> Result<(), CliError> {
        let client = http::client()?;
        let (model, cells) = self.register(&client, server).await?;
        let mut observations = Observations::open(&self.demonstration, &self.reading.columns, &cells)?;
        let mut open = self.request(&mut observations)?;
        open.insert("type", json!("open"));
        open.insert("model", json!(model));
        StreamSession::new(client, server, open, observations).run(printer, self.retries).await
    }

    /// The name of the model at the service, and what cells are by its attributes; a file is registered under its name first.
    async fn register(&self, client: &reqwest::Client, server: &str) -> Result<(String, Cells), CliError> {
        let url = |name: &str| format!("{server}/v1/models/{name}");
        let (name, registered) = if self.model.is_file() {
            let definition = read_json(&self.model)?;
            let name = self.model.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
            let url = url(&name);
            (name, http::answer::<Registered>(&url, client.put(&url).json(&definition)).await?)
        } else {
            let name = self.model.to_string_lossy().into_owned();
            let url = url(&name);
            (name, http::answer::<Registered>(&url, client.get(&url)).await?)
        };
        Ok((name, self.options.cells(|| Cells::told(&registered.attributes))))
    }

    /// What the file and the flags say of the stream, as in an `open` frame.
    fn request(&self, observations: &mut Observations) -> Result<FlaggedRequest, CliError> {
        let mut request = FlaggedRequest::new(observations.take_request());
        if self.lookahead.is_none() && !request.members().contains_key("lookahead") {
            request.insert("lookahead", DEFAULT_LOOKAHEAD.document());
        }
        request.set_some("--lookahead", "lookahead", self.lookahead.map(Lookahead::document))?;
        request.set_some("--lookahead-ms", "lookahead_ms", self.lookahead_ms.map(|ms| json!(ms)))?;
        self.options.add_to(&mut request)?;
        Ok(request)
    }
}

/// Takes note of the observations that `steps` have met.
fn met(waits: &mut Option<Waits>, n_met: &mut u32, steps: &[CommittedStep]) {
    *n_met = steps.last().map_or(*n_met, |last| last.step.observation + 1);
    if let Some(waits) = waits {
        waits.met(*n_met);
    }
}

fn text_of(frame: &ServerFrame<'_>) -> Result<String, CliError> {
    serde_json::to_string(frame).map_err(|error| CliError::Io(error.into()))
}
