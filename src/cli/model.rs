//! `etude model`.

use std::io::{BufRead, Write};
use std::path::PathBuf;

use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};

use super::CliError;
use super::experience::Experience;
use super::inspect::Inspect;
use super::opened::open;
use super::written::write_model;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Edits, ImportError, ImportFile, ImportFormat, Limits, import};

#[derive(Args, Debug)]
pub(super) struct ModelCommand {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make a model from the file of another tool.
    ///
    /// Compressed files (gzip, zstd) are read as they are.
    Import(Import),
    /// Make a model of what a body was seen to do.
    Experience(Experience),
    /// Tell what a body comes to, what it cannot undo, how far a stream should look ahead, and what of a demonstration it can never meet.
    Inspect(Inspect),
}

#[derive(Args, Debug)]
struct Import {
    /// The file; - for standard input.
    file: PathBuf,
    /// What it is; found by looking if left out.
    #[arg(long = "format", value_parser = parse_format, value_name = "FORMAT")]
    of: Option<ImportFormat>,
    /// Actions that the body lacks: a name, in which * stands for any text; may be given for several.
    #[arg(long, value_name = "PATTERN")]
    without: Vec<String>,
    /// Another name for an action or an attribute; may be given for several.
    #[arg(long, value_name = "OLD=NEW")]
    rename: Vec<String>,
    /// What an action costs, in place of what the file says; in its name, * stands for any text. Or the name of the reward that is the cost. May be
    /// given for several.
    #[arg(long, value_name = "ACTION=COST|REWARD")]
    cost: Vec<String>,
    /// States that must never be entered: an expression of CEL over the attributes of the model; may be given for several.
    #[arg(long = "unsafe", value_name = "EXPRESSION")]
    unsafe_if: Vec<String>,
    /// Where to write the model; standard output if left out.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

impl ModelCommand {
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        match &self.command {
            Command::Import(import) => import.run(out),
            Command::Experience(experience) => experience.run(out),
            Command::Inspect(inspect) => inspect.run(out),
        }
    }
}

impl Import {
    fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        let definition = self.read(&self.edits()?)?;
        write_model(&definition, self.out.as_deref(), out)
    }

    fn edits(&self) -> Result<Edits, CliError> {
        let mut edits = Edits { without: self.without.clone(), unsafe_if: self.unsafe_if.clone(), ..Edits::default() };
        let told = |flag: &str, value: &str, detail: String| CliError::Faulty(format!("{flag} {value}: {detail}"));
        for value in &self.rename {
            edits.add_rename(value).map_err(|detail| told("--rename", value, detail))?;
        }
        for value in &self.cost {
            edits.add_cost(value).map_err(|detail| told("--cost", value, detail))?;
        }
        Ok(edits)
    }

    fn read(&self, edits: &Edits) -> Result<Definition, CliError> {
        let bar = ProgressBar::no_length().with_style(style());
        let failed = |source: ImportError| CliError::Import { path: self.file.clone(), source };
        let mut content = open(&self.file, &bar)?;
        let name = self.file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let head = content.fill_buf().map_err(|error| failed(error.into()))?;
        let Some(format) = self.of.or_else(|| ImportFormat::of(&name, head)) else {
            if head.is_empty() {
                return Err(failed(ImportError::Unfit("the file is empty".to_owned())));
            }
            let known = ImportFormat::ALL.map(ImportFormat::name).join(", ");
            let detail = format!("this is of no format that is known here: {known}. Say which by --format");
            return Err(failed(ImportError::Unfit(detail)));
        };
        let parts = format.parts();
        let own = self.file.extension().and_then(|own| own.to_str()).filter(|own| parts.contains(own));
        // It is told of by name where there are several.
        let name = own.map(|_| name).unwrap_or_default();
        let mut files = vec![ImportFile { name, content }];
        for part in parts.iter().filter(|part| own.is_some_and(|own| own != **part)) {
            let path = self.file.with_extension(part);
            if path.exists() {
                let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
                files.push(ImportFile { name, content: open(&path, &ProgressBar::hidden())? });
            }
        }
        let read = import(format, files, edits, Limits::NONE, &mut Uninterrupted);
        bar.finish_and_clear();
        read.map_err(failed)
    }
}

fn style() -> ProgressStyle {
    let template = "{bar:40} {bytes} of {total_bytes}, {bytes_per_sec}";
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

fn parse_format(name: &str) -> Result<ImportFormat, String> {
    let known = || ImportFormat::ALL.map(ImportFormat::name).join(", ");
    ImportFormat::ALL
        .into_iter()
        .find(|format| format.name() == name)
        .ok_or_else(|| format!("expected one of {}", known()))
}
