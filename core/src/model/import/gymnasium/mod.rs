//! The transition table `P` of a Gymnasium environment, as JSON.
//!
//! ```jsonc
//! {"format": "etude.gymnasium.v1", "environment": "FrozenLake-v1",
//!  "attributes": ["row", "col"],                        // by name, or in full, as in a model; left out: the state's number
//!  "actions": ["left", "down", "right", "up"],          // left out: their numbers
//!  "states": [[0, 0], [0, 1]],                          // by state, a value for each attribute
//!  "start": [0],                                        // left out: any state
//!  "P": {"0": {"0": [[1.0, 0, 0.0, false]], "1": [[1.0, 4, 0.0, false]]}}}
//!                                                       // by state and action: [probability, next state, reward, terminated]
//! ```
//!
//! Members may stand in any order. `P` alone is read as well, and may be nested arrays in place of objects. A negative reward is what the
//! transition costs. No action leaves a state in which an episode ends.

mod parsing;

use std::cell::RefCell;
use std::cmp::Ordering;
use std::collections::HashSet;
use std::io::{self, BufRead};

use serde::de::DeserializeSeed;
use serde_json::Value as Json;

use self::parsing::Document;
use super::draft::{Draft, DraftAttribute, Way, cost_of};
use super::{Edits, ImportError, Spot};
use crate::attribute::Schema;
use crate::document::{Faults, Path, Place, Quoted};
use crate::interrupt::Meter;
use crate::model::reading::Raw;
use crate::model::{Action, ActionIdx, Definition, Limits};

/// What a file says it is, if it says so.
const FORMAT: &str = "etude.gymnasium.v1";

/// Reads the table in `reader`.
pub(super) fn read(
    reader: impl BufRead,
    edits: &Edits,
    limits: Limits,
    meter: &mut Meter<'_>,
) -> Result<Definition, ImportError> {
    let table = RefCell::new(Reading::new(limits));
    let mut json = serde_json::Deserializer::from_reader(reader);
    let read = Document(&table).deserialize(&mut json).and_then(|()| json.end());
    let Reading { draft, failure, has_table, n_states, ahead, attributes, actions, start, .. } = table.into_inner();
    if let Some(failure) = failure {
        return Err(failure);
    }
    read.map_err(told)?;
    if !has_table {
        return Err(ImportError::at(Spot::Whole, "there is no `P`: the table by state and action"));
    }
    if !ahead.is_empty() {
        return Err(ImportError::at(Spot::Whole, format!("/P: state {n_states} is missing")));
    }
    Whole { draft, n_states, attributes, actions, start }.finish(edits, meter)
}

/// What is told of a text that is not JSON, or not of this form.
fn told(error: serde_json::Error) -> ImportError {
    if error.is_io() {
        return io::Error::from(error).into();
    }
    let [line, column] = [error.line(), error.column()].map(|n| u64::try_from(n).unwrap_or(u64::MAX));
    let detail = error.to_string();
    let detail = detail.split(" at line ").next().unwrap_or_default();
    // As everywhere else.
    let mismatch = detail.strip_prefix("invalid type: ").and_then(|mismatch| mismatch.split_once(", expected "));
    let detail = mismatch.map_or_else(|| detail.to_owned(), |(found, what)| format!("expected {what}, found {found}"));
    ImportError::at(Spot::Column(line, column), detail)
}

/// `[probability, next state, reward, terminated]`.
type Outcome = (f64, u64, f64, bool);

/// A file as it is read.
struct Reading {
    draft: Draft,
    failure: Option<ImportError>,
    has_table: bool,
    /// So many states came, counted from 0,
    n_states: u64,
    /// and these that are further ahead. Hashed with a seed, as clients choose them.
    ahead: HashSet<u64>,
    attributes: Option<Json>,
    actions: Option<Json>,
    start: Option<Json>,
    /// Whether the states of the file have values.
    has_states: bool,
    /// Actions of the state in hand.
    taken: Vec<bool>,
}

impl Reading {
    fn new(limits: Limits) -> Self {
        Self {
            draft: Draft::new(limits),
            failure: None,
            has_table: false,
            n_states: 0,
            ahead: HashSet::new(),
            attributes: None,
            actions: None,
            start: None,
            has_states: false,
            taken: Vec::new(),
        }
    }

    fn begin_state(&mut self, state: u64) -> Result<(), ImportError> {
        // The keys of an object come in any order.
        let is_new = match state.cmp(&self.n_states) {
            Ordering::Less => false,
            Ordering::Equal => {
                self.n_states += 1;
                while self.ahead.remove(&self.n_states) {
                    self.n_states += 1;
                }
                true
            }
            Ordering::Greater => self.ahead.insert(state),
        };
        if !is_new {
            return Err(ImportError::at(Spot::Whole, format!("/P/{state}: the state stands twice")));
        }
        self.taken.clear();
        Ok(())
    }

    fn begin_pair(&mut self, state: u64, action: u64) -> Result<ActionIdx, ImportError> {
        let spot = Spot::Pair(state, action);
        let index = usize::try_from(action).ok().filter(|index| *index < Action::MAX_ACTIONS);
        let detail = || format!("there may be {} actions", Action::MAX_ACTIONS);
        let index = index.ok_or_else(|| ImportError::at(spot, detail()))?;
        while self.draft.n_actions() <= index {
            let name = self.draft.n_actions().to_string();
            self.draft.push_action(name, spot)?;
        }
        if self.taken.len() <= index {
            self.taken.resize(index + 1, false);
        }
        if std::mem::replace(&mut self.taken[index], true) {
            return Err(ImportError::at(spot, "the action stands twice"));
        }
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_ACTIONS")]
        let index = index as ActionIdx;
        Ok(index)
    }

    fn push_way(&mut self, (state, action): (u64, ActionIdx), outcome: Outcome) -> Result<(), ImportError> {
        let (probability, to, reward, is_last) = outcome;
        let spot = Spot::Pair(state, action.into());
        let cost = cost_of(-reward);
        if cost.is_none() && probability > 0.0 {
            let detail = if reward > 0.0 {
                format!("a reward of {reward} is no cost")
            } else {
                format!("a reward of {reward} is too large a cost")
            };
            self.draft.refuse(action, spot, || detail);
        }
        if is_last && probability > 0.0 {
            self.draft.end_at(to);
        }
        self.draft.push_way(Way { to, probability, cost }, spot)
    }

    /// Adds the values of a state.
    fn push_row(&mut self, row: &[Json]) -> Result<(), ImportError> {
        let state = self.draft.n_rows();
        let told = |detail: String| ImportError::at(Spot::Whole, format!("/states/{state}: {detail}"));
        if !std::mem::replace(&mut self.has_states, true) {
            let named = |n: usize| DraftAttribute::Named(format!("attribute {n}"));
            self.draft.set_attributes((0..row.len()).map(named).collect());
        }
        let n_attributes = self.draft.n_attributes();
        if row.len() != n_attributes || row.is_empty() {
            return Err(told(format!("expected {} values, found {}", n_attributes.max(1), row.len())));
        }
        let values: Option<Vec<Raw<&str>>> = row.iter().map(raw).collect();
        let values = values.ok_or_else(|| told("expected numbers, strings and booleans".to_owned()))?;
        self.draft.push_row(values, Spot::Whole)
    }
}

fn raw(value: &Json) -> Option<Raw<&str>> {
    Some(match value {
        Json::Bool(flag) => Raw::Boolean(*flag),
        Json::Number(number) => match (number.as_u64(), number.as_i64()) {
            (Some(whole), _) => Raw::Whole(whole),
            (None, Some(negative)) => Raw::Negative(negative),
            (None, None) => Raw::float(number.as_f64()?),
        },
        Json::String(text) => Raw::Text(text),
        Json::Null | Json::Array(_) | Json::Object(_) => return None,
    })
}

/// A file that was read to its end.
struct Whole {
    draft: Draft,
    n_states: u64,
    attributes: Option<Json>,
    actions: Option<Json>,
    start: Option<Json>,
}

impl Whole {
    fn finish(mut self, edits: &Edits, meter: &mut Meter<'_>) -> Result<Definition, ImportError> {
        let n_states = self.n_states;
        self.draft.expect_states(n_states, Spot::Whole)?;
        if self.draft.n_rows() == 0 {
            self.draft.number_states(n_states)?;
        }
        if let Some(attributes) = &self.attributes {
            self.draft.set_attributes(read_attributes(attributes, self.draft.n_attributes())?);
        }
        if let Some(actions) = self.actions.take() {
            self.name_actions(&actions)?;
        }
        if let Some(start) = &self.start {
            let items = start.as_array().map_or(std::slice::from_ref(start), Vec::as_slice);
            for item in items {
                let state = item.as_u64().filter(|state| *state < n_states).and_then(|state| state.try_into().ok());
                let detail = || format!("/start: {item} is no state: there are {n_states}, counted from 0");
                self.draft.start.push(state.ok_or_else(|| ImportError::at(Spot::Whole, detail()))?);
            }
        }
        self.draft.finish(edits, meter)
    }

    fn name_actions(&mut self, actions: &Json) -> Result<(), ImportError> {
        let names: Option<Vec<&str>> = actions.as_array().and_then(|names| names.iter().map(Json::as_str).collect());
        let names = names.ok_or_else(|| ImportError::at(Spot::Whole, "/actions: expected names"))?;
        if names.len() < self.draft.n_actions() {
            let detail = format!("/actions: {} names, but `P` has {} actions", names.len(), self.draft.n_actions());
            return Err(ImportError::at(Spot::Whole, detail));
        }
        for (n, name) in names.into_iter().enumerate() {
            if n < self.draft.n_actions() {
                self.draft.name_action(n, name.to_owned());
            } else {
                self.draft.push_action(name.to_owned(), Spot::Whole)?;
            }
        }
        Ok(())
    }
}

fn read_attributes(attributes: &Json, n_values: usize) -> Result<Vec<DraftAttribute>, ImportError> {
    let items = attributes.as_array().map(Vec::as_slice).unwrap_or_default();
    if items.len() != n_values {
        let detail = format!("/attributes: expected {n_values}, one for each value of a state, found {}", items.len());
        return Err(ImportError::at(Spot::Whole, detail));
    }
    if let Some(names) = items.iter().map(Json::as_str).collect::<Option<Vec<_>>>() {
        return Ok(names.into_iter().map(|name| DraftAttribute::Named(name.to_owned())).collect());
    }
    let mut faults = Faults::default();
    let place = Place { value: attributes, path: Path::Member(&Path::Root, "attributes") };
    let read = Schema::read(&place, &mut faults).and_then(|attributes| attributes.into_iter().collect());
    let read: Vec<_> = faults.check(read).map_err(|faults| ImportError::at(Spot::Whole, faults.to_string()))?;
    Ok(read.into_iter().map(DraftAttribute::Whole).collect())
}
