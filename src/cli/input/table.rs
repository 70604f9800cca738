//! CSV, with a header that names attributes.

use csv::{ReaderBuilder, StringRecord, Trim};
use serde_json::{Map as Members, Number, Value};
use std::collections::HashSet;

use super::column::Column;
use super::lines::Lines;
use crate::cli::{CliError, note};
use etude_core::attribute::{AttributeDocument, Cycle, Kind, KindName, Value as Known};
use etude_core::model::Model;

/// How the cells of a table become values, by attribute of a model; without any, each column is what it looks like.
#[derive(Clone, Debug)]
pub(in crate::cli) struct Cells(Vec<(String, Cell)>);

/// How the cells of an attribute become values.
#[derive(Clone, Debug)]
enum Cell {
    Number,
    Label,
    /// A cell that looks like a number or a boolean is one.
    Any,
    /// A cell that looks like a boolean or an integer is one, unless it is one of these strings, which are values of the model.
    Category(HashSet<Box<str>>),
}

impl Cells {
    /// Those of a model's attributes.
    pub(in crate::cli) fn of(model: &Model) -> Self {
        let cell = |position: usize, kind: &Kind| match kind {
            Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. } => Cell::Number,
            Kind::Cyclic { cycle: Cycle::Labels(_), .. } => Cell::Label,
            Kind::Category => {
                let texts = model.states().domain(position).iter().filter_map(|value| match value {
                    Known::Text(text) if !matches!(plain(text), Value::String(_)) => Some(text.clone()),
                    _ => None,
                });
                Cell::Category(texts.collect())
            }
        };
        let attributes = model.schema().attributes().iter().enumerate();
        Self(attributes.map(|(n, attribute)| (attribute.name.clone(), cell(n, &attribute.kind))).collect())
    }

    /// By the attributes in a service's answer. It does not say which strings the model's states have.
    pub(in crate::cli) fn told(attributes: &[AttributeDocument]) -> Self {
        let cell = |attribute: &AttributeDocument| match attribute.kind {
            KindName::Category => Cell::Category(HashSet::new()),
            KindName::Cyclic if attribute.labels.is_some() => Cell::Label,
            KindName::Number | KindName::Cyclic => Cell::Number,
        };
        Self(attributes.iter().map(|attribute| (attribute.name.clone(), cell(attribute))).collect())
    }

    /// Those of a demonstrator with attributes of its own.
    pub(in crate::cli) fn any() -> Self {
        Self(Vec::new())
    }

    fn names(&self) -> String {
        self.0.iter().map(|(name, _)| format!("{name:?}")).collect::<Vec<_>>().join(", ")
    }
}

impl Cell {
    /// The value of the cell `text`; `null` if it is empty or NaN. A cell that is no value of the attribute becomes a string, which is
    /// refused where the observation is read against the model.
    fn value(&self, text: &str) -> Value {
        if text.is_empty() || text.eq_ignore_ascii_case("nan") {
            return Value::Null;
        }
        match self {
            Self::Number => number(text).unwrap_or_else(|| text.into()),
            Self::Label => text.into(),
            Self::Any => number(text).unwrap_or_else(|| plain(text)),
            Self::Category(texts) if texts.contains(text) => text.into(),
            Self::Category(_) => plain(text),
        }
    }
}

/// A number with all its digits where JSON can write them; else rounded to a float.
fn number(text: &str) -> Option<Value> {
    if let Ok(number) = text.parse::<Number>() {
        return Some(number.into());
    }
    Some(Number::from_f64(text.parse().ok()?)?.into())
}

/// The value of a category's cell: a boolean (`true`, Python's `True`, a spreadsheet's `TRUE`), an integer (pandas writes `1.0` for 1 if
/// another cell of the column is empty), or a string.
fn plain(text: &str) -> Value {
    if text.eq_ignore_ascii_case("true") || text.eq_ignore_ascii_case("false") {
        return text.eq_ignore_ascii_case("true").into();
    }
    let integer = text.strip_suffix(".0").unwrap_or(text).parse::<i64>();
    integer.map_or_else(|_| text.into(), Value::from)
}

/// A column that is read: where it stands, the attribute, what its cells are, and how they are scaled.
struct Taken {
    index: usize,
    header: String,
    attribute: String,
    cell: Cell,
    column: Option<Column>,
}

/// The rows of a table.
pub(super) struct Table {
    lines: Lines,
    /// What stands between cells.
    separator: u8,
    n_columns: usize,
    taken: Vec<Taken>,
}

impl Table {
    /// Reads the header of a table.
    pub(super) fn read(mut lines: Lines, columns: &[Column], cells: &Cells) -> Result<Self, CliError> {
        // In countries with decimal commas, spreadsheets separate cells by semicolons.
        let head = lines.first()?;
        let separator = [b',', b';', b'\t'].into_iter().find(|separator| head.contains(separator)).unwrap_or(b',');
        let mut table = Self { lines, separator, n_columns: 0, taken: Vec::new() };
        let header = table.next_record()?.map(|(_, header)| header).unwrap_or_default();
        table.n_columns = header.len();
        table.taken = taken(table.lines.name(), &header, columns, cells)?;
        Ok(table)
    }

    /// The column of each attribute that has one.
    pub(super) fn names(&self) -> Vec<(String, String)> {
        self.taken.iter().map(|taken| (taken.attribute.clone(), taken.header.clone())).collect()
    }

    /// The next row, and where it stands; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<(u64, Value)>, CliError> {
        let Some((row, record)) = self.next_record()? else { return Ok(None) };
        if record.len() != self.n_columns {
            let (n_cells, n_columns) = (record.len(), self.n_columns);
            let detail = format!("{n_cells} cells, where the header has {n_columns}");
            return Err(self.faulty(row, &detail));
        }
        let members = self.taken.iter().map(|taken| {
            let value = taken.cell.value(&record[taken.index]);
            let value = taken.column.as_ref().map(|column| column.scale(value.clone())).unwrap_or(value);
            (taken.attribute.clone(), value)
        });
        Ok(Some((row, members.collect::<Members<_, _>>().into())))
    }

    /// The cells of the next row, and where it begins.
    fn next_record(&mut self) -> Result<Option<(u64, StringRecord)>, CliError> {
        let is_odd = |text: &[u8]| text.iter().fold(false, |is_odd, byte| is_odd ^ (*byte == b'"'));
        let Some(mut text) = self.lines.next()? else { return Ok(None) };
        let row = self.lines.n_read();
        // The end of a line does not end a cell that is quoted. A quote in such a cell is written twice.
        let mut is_open = is_odd(&text);
        while is_open {
            let Some(line) = self.lines.next_or_blank()? else {
                return Err(self.faulty(row, "a quoted cell has no end"));
            };
            is_open ^= is_odd(&line);
            text.extend_from_slice(&line);
        }
        let mut reader = ReaderBuilder::new()
            .has_headers(false)
            .trim(Trim::All)
            .delimiter(self.separator)
            .buffer_capacity(text.len())
            .from_reader(&*text);
        let mut record = StringRecord::new();
        match reader.read_record(&mut record) {
            Ok(_) => Ok(Some((row, record))),
            Err(_) => Err(self.faulty(row, "is not UTF-8")),
        }
    }

    fn faulty(&self, row: u64, detail: &str) -> CliError {
        CliError::Faulty(format!("row {row} of {}: {detail}", self.lines.name()))
    }
}

/// All columns that have a name.
fn all(name: &str, header: &StringRecord, columns: &[Column]) -> Result<Vec<Taken>, CliError> {
    if let Some(column) = columns.first() {
        let detail = "expressions of --observe say what columns are called and in which units they are";
        return Err(CliError::Faulty(format!("--column {column}: {detail}")));
    }
    let mut taken: Vec<Taken> = Vec::new();
    for (index, header) in header.iter().enumerate().filter(|(_, header)| !header.is_empty()) {
        if taken.iter().any(|taken| taken.header == header) {
            return Err(CliError::Faulty(format!("{name} has two columns {header:?}")));
        }
        let (header, attribute) = (header.to_owned(), header.to_owned());
        taken.push(Taken { index, header, attribute, cell: Cell::Any, column: None });
    }
    Ok(taken)
}

/// The columns to read. Tells whoever watches which are left.
fn taken(name: &str, header: &StringRecord, columns: &[Column], cells: &Cells) -> Result<Vec<Taken>, CliError> {
    if cells.0.is_empty() {
        return all(name, header, columns);
    }
    let named = || header.iter().map(|column| format!("{column:?}")).collect::<Vec<_>>().join(", ");
    let mut taken: Vec<Taken> = Vec::new();
    for (attribute, cell) in &cells.0 {
        let column = columns.iter().find(|column| column.attribute == *attribute);
        let find = |name: &str| header.iter().position(|column| column == name);
        let (index, scaled) = match column {
            None => (find(attribute), None),
            Some(column) => match find(&column.whole) {
                Some(index) => (Some(index), None),
                None => (
                    Some(find(&column.name).ok_or_else(|| {
                        CliError::Faulty(format!(
                            "--column {column}: {name} has no column {:?}; it has {}",
                            column.name,
                            named()
                        ))
                    })?),
                    Some(column.clone()).filter(Column::is_scaled),
                ),
            },
        };
        let Some(index) = index else { continue };
        if let Some(column) = scaled.as_ref().filter(|_| !matches!(cell, Cell::Number)) {
            return Err(CliError::Faulty(format!(
                "--column {column}: {attribute:?} is no number that could be scaled"
            )));
        }
        if header.iter().filter(|other| **other == header[index]).count() > 1 {
            return Err(CliError::Faulty(format!("{name} has two columns {:?}", &header[index])));
        }
        let (header, attribute, cell) = (header[index].to_owned(), attribute.clone(), cell.clone());
        taken.push(Taken { index, header, attribute, cell, column: scaled });
    }
    if let Some(column) = columns.iter().find(|column| !cells.0.iter().any(|(name, _)| *name == column.attribute)) {
        let detail = format!("unknown attribute {:?}; the model has {}", column.attribute, cells.names());
        return Err(CliError::Faulty(format!("--column {column}: {detail}")));
    }
    if taken.is_empty() {
        let detail = format!(
            "expected a header with attributes of the model, which are {}; found {}. Other names can be given by --column \
             ATTRIBUTE=COLUMN, and JSON is an array of observations or an object a line",
            cells.names(),
            named(),
        );
        return Err(CliError::Faulty(format!("{name}: {detail}")));
    }
    let is_left = |index: &usize| !header[*index].is_empty() && !taken.iter().any(|taken| taken.index == *index);
    let left: Vec<_> = (0..header.len()).filter(is_left).map(|index| format!("{:?}", &header[index])).collect();
    if !left.is_empty() {
        note(&format!("{name}: what is in {} is no attribute of the model, and is not looked at", left.join(", ")));
    }
    Ok(taken)
}
