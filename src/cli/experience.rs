//! `etude model experience`.

use std::collections::BTreeMap;
use std::io::{self, BufRead, Read, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use indicatif::ProgressBar;
use serde_json::{Map as Members, Value, json};

use super::CliError;
use super::input::{Cells, Observations};
use super::opened::{open, read_json};
use super::written::write_model;
use etude_core::attribute::AttributeDocument;
use etude_core::document::{self, Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Batch, CompileError, Definition, Limits, NOTHING_YET, ReadError, Tally};

#[derive(Args, Debug)]
pub(super) struct Experience {
    /// The model, of which the dynamics are of the kind `experience`: JSON, as for PUT `/v1/models/{model}`.
    model: PathBuf,
    /// What was experienced, in this order: JSON, each as for POST `/v1/models/{model}/experience`; or lines of JSON, a transition each; or CSV, with
    /// a column for each attribute, one called `action`, and perhaps `cost` and `count`: what an action led to is the row after it, and a row without
    /// an action ends a run. Lines and CSV are called as their file. They may be compressed (gzip, zstd). Of those of the same name, the first counts.
    #[arg(required = true)]
    batches: Vec<PathBuf>,
    /// Where to write the model; standard output if left out.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

impl Experience {
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        let faulty = |path: &PathBuf, faults| CliError::Faults { what: path.display().to_string(), faults };
        let definition = Definition::read(&read_json(&self.model)?, Limits::NONE, &mut Uninterrupted);
        let definition = definition.map_err(|error| match error {
            CompileError::Faults(faults) => faulty(&self.model, faults),
            // Nothing interrupts it.
            error => CliError::Faulty(error.to_string()),
        })?;
        let told = |detail: &str| CliError::Faulty(format!("{}: {detail}", self.model.display()));
        let tally = Tally::new(&definition);
        let mut tally = tally.ok_or_else(|| told("the kind of its dynamics is not `experience`"))?;
        let mut known = BTreeMap::new();
        for path in &self.batches {
            let mut faults = Faults::default();
            let batch = read_batch(&tally, path, &mut faults)?;
            let batch = faults.check(batch).map_err(|faults| faulty(path, faults))?;
            match known.get(&batch.id) {
                None => tally.add(&batch),
                Some(text) if *text == batch.text => {}
                Some(_) => {
                    let detail = format!("another batch is called {:?} already, with other content", batch.id);
                    return Err(CliError::Faulty(format!("{}: {detail}", path.display())));
                }
            }
            known.insert(batch.id, batch.text);
        }
        let table = tally.definition(&mut Uninterrupted)?.ok_or_else(|| told(NOTHING_YET))?;
        write_model(&table, self.out.as_deref(), out)
    }
}

/// Reads a batch, whichever form it is of; lines as they come.
fn read_batch(tally: &Tally, path: &Path, faults: &mut Faults) -> Result<Option<Batch>, CliError> {
    let read = |source| CliError::Read { path: path.to_owned(), source };
    let name = path.to_string_lossy();
    let name = name.strip_suffix(".gz").or_else(|| name.strip_suffix(".zst")).unwrap_or(&name);
    if [".csv", ".tsv"].iter().any(|extension| name.ends_with(extension)) {
        let lines = rows_as_lines(tally, path)?;
        let batch = tally.read_lines(&name_of(path), lines.as_slice(), faults, &mut Uninterrupted);
        return batch.map_err(|error| CliError::Faulty(format!("{}: {error}", path.display())));
    }
    let mut content = open(path, &ProgressBar::hidden())?;
    // As much as is at hand.
    let head = content.fill_buf().map_err(read)?;
    if is_lines(name, head) {
        return tally.read_lines(&name_of(path), content, faults, &mut Uninterrupted).map_err(|error| match error {
            ReadError::Read(source) => read(source),
            // Nothing interrupts it, and what else is wrong is a fault.
            error => CliError::Faulty(format!("{}: {error}", path.display())),
        });
    }
    let mut text = Vec::new();
    content.read_to_end(&mut text).map_err(read)?;
    let document = document::parse(&text).map_err(|error| CliError::Faulty(format!("{}: {error}", path.display())))?;
    Ok(tally.read_batch(&Place::root(&document), faults, &mut Uninterrupted)?)
}

/// Whether a batch is one of lines: it is called so, or its first line is a transition.
fn is_lines(name: &str, head: &[u8]) -> bool {
    let first = head.split(|byte| *byte == b'\n').find(|line| !line.trim_ascii().is_empty()).unwrap_or_default();
    let is_transition = |line| {
        serde_json::from_slice(line)
            .is_ok_and(|value: Value| value.get("state").is_some() && value.get("action").is_some())
    };
    [".ndjson", ".jsonl"].iter().any(|extension| name.ends_with(extension)) || is_transition(first)
}

/// The rows of a CSV file as lines of JSON, each transition in the line of the row that it begins in.
fn rows_as_lines(tally: &Tally, path: &Path) -> Result<Vec<u8>, CliError> {
    let mut columns: Vec<AttributeDocument> = tally.schema().attributes().iter().map(Into::into).collect();
    for (name, kind) in [("action", "category"), ("cost", "number"), ("count", "number")] {
        if tally.schema().position(name).is_some() {
            let detail =
                format!("{name:?} is an attribute of the model, and would be a column of its own here: send JSON");
            return Err(CliError::Faulty(format!("{}: {detail}", path.display())));
        }
        columns.push(serde_json::from_value(json!({"name": name, "kind": kind})).map_err(io::Error::from)?);
    }
    let mut rows = Observations::open(path, &[], &Cells::told(&columns))?;
    // The header is the first line.
    let mut lines = b"\n".to_vec();
    let mut begun: Option<Members<String, Value>> = None;
    while let Some(row) = rows.next()? {
        let Value::Object(mut state) = row.state else { continue };
        let [action, cost, count] =
            ["action", "cost", "count"].map(|name| state.remove(name).filter(|cell| !cell.is_null()));
        if let Some(mut transition) = begun.take() {
            transition.insert("next".to_owned(), state.clone().into());
            serde_json::to_writer(&mut lines, &transition).map_err(io::Error::from)?;
            lines.push(b'\n');
        }
        let Some(action) = action else {
            lines.push(b'\n');
            continue;
        };
        // A name of digits looks like a number.
        let action = action.as_str().map_or_else(|| action.to_string(), str::to_owned);
        let mut transition =
            Members::from_iter([("state".to_owned(), state.into()), ("action".to_owned(), action.into())]);
        transition.extend(
            [("cost", cost), ("count", count)].into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))),
        );
        begun = Some(transition);
    }
    if begun.is_some() {
        let detail = "what the last action led to is not told: a row without an action should follow";
        return Err(CliError::Faulty(format!("{}: {detail}", path.display())));
    }
    Ok(lines)
}

/// What the lines in a file are called: as that, up to the first point.
fn name_of(path: &Path) -> String {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    name.split('.').next().filter(|stem| !stem.is_empty()).unwrap_or(&name).to_owned()
}
