//! `etude experiment`.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};
use tokio::runtime::Runtime;

use super::client::{Client, ServerUrl};
use super::{CliError, runtime, write_file};
use crate::clock::Ids;
use crate::config::{parse_count, parse_whole};
use crate::experiment::{self, Attempt, CurvePlan, Followed, Laboratory, LearnerId, Local, LocalError, Scene, plot};
use etude_core::learning::LearnerDocument;

#[derive(Args, Debug)]
pub(super) struct Experiment {
    /// Which figure of the paper.
    #[arg(value_enum)]
    figure: Figure,
    /// Directory for pictures and tables; created if missing.
    #[arg(long, default_value = "figures", value_name = "DIR")]
    out: PathBuf,
    /// A running service to do it on, such as `http://127.0.0.1:8080`; in this process if left out. The numbers are the same.
    #[arg(long, value_name = "URL")]
    server: Option<ServerUrl>,
    /// Seed of the first learner; further runs take the next ones.
    #[arg(long, default_value_t = 1, value_parser = parse_whole::<u64>, value_name = "N")]
    seed: u64,
    /// Runs of figure 7.
    #[arg(long, default_value_t = 5, value_parser = parse_count, value_name = "N")]
    runs: usize,
    /// Trials of a run.
    #[arg(long, default_value_t = 200, value_parser = parse_count, value_name = "N")]
    trials: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Figure {
    /// Two paths: the demonstrator's, and that of an imitator that cannot shoot.
    #[value(name = "figure-4")]
    Figure4,
    /// The learning curve.
    #[value(name = "figure-7")]
    Figure7,
    /// Uniform against learned weights where the gold lies elsewhere.
    #[value(name = "figure-8")]
    Figure8,
    /// All of them.
    All,
}

impl Experiment {
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        let created = fs::create_dir_all(&self.out);
        created.map_err(|source| CliError::Write { path: self.out.clone(), source })?;
        match &self.server {
            None => self.run_in(&mut Local::new(), out),
            Some(url) => self.run_in(&mut Remote::new(url)?, out),
        }
    }

    fn run_in<L: Laboratory>(&self, laboratory: &mut L, out: &mut impl Write) -> Result<(), CliError>
    where
        CliError: From<L::Error>,
    {
        let documented = CurvePlan::documented();
        let learner = LearnerDocument { seed: Some(self.seed), ..documented.learner };
        let plan = CurvePlan { learner, n_runs: self.runs, n_trials: self.trials };
        let is_wanted = |figure| self.figure == figure || self.figure == Figure::All;
        if is_wanted(Figure::Figure4) {
            let paths = experiment::figure_4(laboratory)?;
            writeln!(out, "figure 4: {} actions, cost {}, reward {}", paths.actions.len(), paths.cost, paths.reward)?;
            self.write("figure-4.svg", &plot::figure_4(&paths)?, out)?;
        }
        if is_wanted(Figure::Figure7) {
            let bar = progress("figure 7", plan.n_runs * plan.n_trials);
            let curve = experiment::figure_7(laboratory, &plan, || bar.inc(1))?;
            bar.finish_and_clear();
            writeln!(out, "figure 7: running averages over ten trials, {} runs", curve.runs.len())?;
            writeln!(out, "  trial   mean reward   deviation between runs")?;
            for point in curve.points().filter(|point| point.trial % 20 == 0 || point.trial == 10) {
                writeln!(out, "  {:>5}   {:>11.1}   {:>22.1}", point.trial, point.mean, point.sd)?;
            }
            self.write("figure-7.svg", &plot::figure_7(&curve)?, out)?;
            self.write("figure-7.csv", &plot::figure_7_csv(&curve), out)?;
        }
        if is_wanted(Figure::Figure8) {
            let bar = progress("figure 8", plan.n_trials);
            let locations = experiment::figure_8(laboratory, &plan, || bar.inc(1))?;
            bar.finish_and_clear();
            let table = plot::figure_8_text(&locations);
            writeln!(out, "figure 8: rewards with uniform and with learned weights\n{table}")?;
            self.write("figure-8.txt", &table, out)?;
            self.write("figure-8.csv", &plot::figure_8_csv(&locations), out)?;
            self.write("figure-8.svg", &plot::figure_8(&locations)?, out)?;
        }
        Ok(())
    }

    fn write(&self, name: &str, text: &str, out: &mut impl Write) -> Result<(), CliError> {
        let path = self.out.join(name);
        write_file(&path, text)?;
        writeln!(out, "  wrote {}", path.display())?;
        Ok(())
    }
}

/// A bar on standard error, if that is a terminal.
fn progress(name: &'static str, n_trials: usize) -> ProgressBar {
    let bar = ProgressBar::new(n_trials as u64).with_message(name);
    match ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} trials, {eta} left") {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// A laboratory on a running service.
struct Remote {
    runtime: Runtime,
    client: Client,
    known: Vec<&'static str>,
}

impl Remote {
    fn new(url: &ServerUrl) -> Result<Self, CliError> {
        Ok(Self { runtime: runtime()?, client: Client::new(url)?, known: Vec::new() })
    }

    /// Sees to it that the service knows the model of `scene`.
    fn register(&mut self, scene: &Scene) -> Result<(), CliError> {
        if !self.known.contains(&scene.name()) {
            let path = format!("/v1/models/{}", scene.name());
            let _: Value = self.runtime.block_on(self.client.put(&path, scene.model()))?;
            self.known.push(scene.name());
        }
        Ok(())
    }
}

fn actions(policy: &Value) -> Vec<String> {
    let actions = policy["actions"].as_array().map(Vec::as_slice).unwrap_or_default();
    actions.iter().filter_map(Value::as_str).map(str::to_owned).collect()
}

impl Laboratory for Remote {
    type Error = CliError;

    fn start_learner(&mut self, definition: &LearnerDocument) -> Result<LearnerId, CliError> {
        let name = format!("experiment-{}", Ids::random().next());
        let path = format!("/v1/learners/{name}");
        let _: Value = self.runtime.block_on(self.client.put(&path, definition))?;
        Ok(LearnerId(name))
    }

    fn draw(&mut self, learner: &LearnerId, scene: &Scene) -> Result<Attempt, CliError> {
        self.register(scene)?;
        let path = format!("/v1/learners/{}/trials", learner.0);
        let request = json!({"model": scene.name(), "demonstration": scene.demonstration()});
        let trial: Value = self.runtime.block_on(self.client.post(&path, &request))?;
        Ok(Attempt { id: trial["id"].as_str().unwrap_or_default().to_owned(), actions: actions(&trial["policy"]) })
    }

    fn learn(&mut self, learner: &LearnerId, attempt: &Attempt, reward: f64) -> Result<(), CliError> {
        let path = format!("/v1/trials/{}/reward", attempt.id);
        let _: Value = self.runtime.block_on(self.client.put(&path, &json!({"reward": reward})))?;
        let path = format!("/v1/learners/{}/learn", learner.0);
        let _: Value = self.runtime.block_on(self.client.post(&path, &Value::Null))?;
        Ok(())
    }

    fn means(&mut self, learner: &LearnerId) -> Result<BTreeMap<String, f64>, CliError> {
        let weights: Value = self.runtime.block_on(self.client.get(&format!("/v1/learners/{}/weights", learner.0)))?;
        let weights = weights["weights"].as_array().map(Vec::as_slice).unwrap_or_default();
        let named = weights
            .iter()
            .filter_map(|weight| weight["attribute"].as_str().map(str::to_owned).zip(weight["mean"].as_f64()));
        Ok(named.collect())
    }

    fn map(&mut self, scene: &Scene, learner: Option<&LearnerId>) -> Result<Followed, CliError> {
        self.register(scene)?;
        let learner = learner.map(|learner| &learner.0);
        let request = json!({"model": scene.name(), "demonstration": scene.demonstration(), "learner": learner});
        let policy: Value = self.runtime.block_on(self.client.post("/v1/policies", &request))?;
        Ok(Followed { actions: actions(&policy), cost: policy["cost"]["total"].as_f64().unwrap_or_default() })
    }
}

impl From<LocalError> for CliError {
    fn from(error: LocalError) -> Self {
        Self::Experiment(error)
    }
}
