//! `etude model experience`.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;

use clap::Args;

use super::CliError;
use super::opened::read_json;
use super::written::write_model;
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{CompileError, Definition, Limits, NOTHING_YET, Tally};

#[derive(Args, Debug)]
pub(super) struct Experience {
    /// The model, of which the dynamics are of the kind `experience`: JSON, as for PUT `/v1/models/{model}`.
    model: PathBuf,
    /// What was experienced, in this order: JSON, each as for POST `/v1/models/{model}/experience`. Of those of the same name, the first counts.
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
            let document = read_json(path)?;
            let mut faults = Faults::default();
            let batch = tally.read_batch(&Place::root(&document), &mut faults, &mut Uninterrupted)?;
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
