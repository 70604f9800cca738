//! Models that commands make, as they are written.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use super::{CliError, note};
use etude_core::model::{Definition, Table};

/// Writes a model to the file at `path`, and tells what it has; to `out` if there is none.
pub(super) fn write_model(definition: &Definition, path: Option<&Path>, out: &mut impl Write) -> Result<(), CliError> {
    match path {
        None => {
            definition.write(&mut *out)?;
            writeln!(out)?;
        }
        Some(path) => {
            let written = File::create(path).and_then(|file| {
                let mut file = BufWriter::new(file);
                definition.write(&mut file)?;
                writeln!(file)?;
                file.flush()
            });
            written.map_err(|source| CliError::Write { path: path.to_owned(), source })?;
            note(&format!("{}: {}", path.display(), summary(definition)));
        }
    }
    Ok(())
}

/// What a model has.
fn summary(definition: &Definition) -> String {
    let attributes = definition.schema().len();
    match definition.dynamics::<Table>() {
        Some(table) => {
            let (states, transitions) = (table.n_states(), table.n_transitions());
            let stochastic = match table.n_stochastic() {
                0 => String::new(),
                n => format!(", {n} pairs of a state and an action with several outcomes"),
            };
            format!("{states} states of {attributes} attributes, {transitions} transitions{stochastic}")
        }
        None => format!("states of {attributes} attributes, found as they are searched"),
    }
}
