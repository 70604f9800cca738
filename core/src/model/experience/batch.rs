//! What was experienced, as it is sent: a batch of transitions.

use std::collections::HashMap;
use std::io::{BufRead, Read as _};

use serde::Serialize;
use serde_json::Value as Json;

use super::Experience;
use super::reading::read_state;
use super::values::DistinctStates;
use crate::attribute::{MAX_COST, Value, WrittenValue};
use crate::document::{Faults, ParseError, Path, Place, Quoted, Range, list_known, normal, parse};
use crate::interrupt::{Interrupted, Meter};
use crate::model::{ActionIdx, OwnCost, ReadError, StateIdx};

/// Transitions that a body was seen to make, checked against a model's attributes and actions.
#[derive(Clone, Debug)]
pub struct Batch {
    /// The client's name for it.
    pub id: String,
    /// Its canonical text: reading this gives the same batch, and equal content has equal text. Values are as they were sent.
    pub text: String,
    /// The states that it leads through, numbered by first appearance, their values rounded as the definition says.
    pub(super) states: DistinctStates,
    /// In the order in which they were sent.
    pub(super) transitions: Vec<Seen>,
}

/// A transition of a batch.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    /// A state of the batch, as is `to`.
    pub(super) from: StateIdx,
    pub(super) action: ActionIdx,
    pub(super) to: StateIdx,
    /// How often it was seen: at least once.
    pub(super) count: u64,
    /// What it cost each time, if that was told.
    pub(super) own_cost: OwnCost,
}

impl Batch {
    /// Longest name of a batch, in characters.
    pub const MAX_ID_CHARS: usize = 255;
    /// Most often that a transition of a batch may have been seen: no sum of what was ever sent overflows.
    pub const MAX_COUNT: u64 = 1_000_000_000;

    /// How many transitions it has.
    #[must_use]
    pub fn len(&self) -> usize {
        self.transitions.len()
    }

    /// Whether it has none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.transitions.is_empty()
    }

    /// Reads a batch for the model that `experience` defines; `None`: at least one fault was noted.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn read(
        experience: &Experience,
        place: &Place<'_, '_>,
        meter: &mut Meter<'_>,
        faults: &mut Faults,
    ) -> Result<Option<Self>, Interrupted> {
        let Some(object) = place.object(&["batch", "transitions"], faults) else { return Ok(None) };
        let mut reader = BatchReader::new(experience, faults);
        let id = object.required("batch", faults).and_then(|place| read_id(&place, faults));
        let place = object.required("transitions", faults);
        let Some((place, items)) = place.and_then(|place| Some((place, place.array(faults)?))) else { return Ok(None) };
        for (n, item) in items.iter().enumerate() {
            reader.read(&place.item(n, item), meter, faults)?;
        }
        Ok(reader.end(id, faults))
    }

    /// Reads a batch called `id` from lines of JSON, a transition each; likewise.
    ///
    /// # Errors
    ///
    /// [`ReadError`] if the lines could not be read, one of them is not JSON, or `interrupt` said so.
    pub(super) fn read_lines(
        experience: &Experience,
        id: &str,
        mut lines: impl BufRead,
        meter: &mut Meter<'_>,
        faults: &mut Faults,
    ) -> Result<Option<Self>, ReadError> {
        let mut reader = BatchReader::new(experience, faults);
        let name = Json::from(id);
        let path = Path::Member(&Path::Root, "batch");
        let id = read_id(&Place { value: &name, path }, faults);
        let (mut text, mut number) = (Vec::new(), 0);
        loop {
            text.clear();
            if lines.by_ref().take(MAX_LINE_BYTES).read_until(b'\n', &mut text)? == 0 {
                return Ok(reader.end(id, faults));
            }
            number += 1;
            let path = Path::Line(number);
            if text.trim_ascii().is_empty() {
                continue;
            }
            if text.len() as u64 == MAX_LINE_BYTES {
                faults.note_at(&path, format!("the line has over {MAX_LINE_BYTES} bytes"));
                return Ok(None);
            }
            match parse(&text) {
                Ok(value) => reader.read(&Place { value: &value, path }, meter, faults)?,
                Err(ParseError::Syntax { column, detail, .. }) => {
                    faults.note_at(&path, format!("not JSON at column {column}: {detail}"));
                }
                Err(ParseError::Faults(found)) => faults.append_at(number, found),
            }
        }
    }
}

/// Longest line of a batch, in bytes: it is kept while it is read.
const MAX_LINE_BYTES: u64 = 4 << 20;

/// Reads the transitions of a batch, one after the other.
struct BatchReader<'e> {
    experience: &'e Experience,
    /// Hashed with a seed, as clients choose the names.
    known: HashMap<&'e str, ActionIdx>,
    n_faults_before: usize,
    states: DistinctStates,
    transitions: Vec<Seen>,
    /// In canonical form, with a comma after each.
    text: String,
}

impl<'e> BatchReader<'e> {
    fn new(experience: &'e Experience, faults: &Faults) -> Self {
        Self {
            experience,
            known: experience.actions.iter().map(|action| &*action.name).zip(0..).collect(),
            n_faults_before: faults.count(),
            states: DistinctStates::new(experience.schema.len()),
            transitions: Vec::new(),
            text: String::new(),
        }
    }

    fn read(&mut self, place: &Place<'_, '_>, meter: &mut Meter<'_>, faults: &mut Faults) -> Result<(), Interrupted> {
        meter.spend_or_stop(2 * self.experience.schema.len() as u64)?;
        let read = Transition::read(self.experience, &self.known, place, faults);
        // Once something is wrong, the rest is read for its faults alone.
        let Some(transition) = read.filter(|_| faults.count() == self.n_faults_before) else { return Ok(()) };
        transition.write(self.experience, &mut self.text);
        let Transition { state, action, next, count, own_cost } = transition;
        let [from, to] = [state, next].map(|values| self.states.number_of(self.experience.binned(values).into_iter()));
        self.transitions.push(Seen { from, action, to, count, own_cost });
        Ok(())
    }

    /// The batch called `id`; `None` if anything was wrong with it.
    fn end(self, id: Option<&str>, faults: &Faults) -> Option<Batch> {
        let id = id.filter(|_| faults.count() == self.n_faults_before)?;
        let mut text = self.text;
        text.pop();
        text.insert_str(0, &format!("{{\"batch\":{},\"transitions\":[", serde_json::json!(id)));
        text.push_str("]}");
        Some(Batch { id: id.to_owned(), text, states: self.states, transitions: self.transitions })
    }
}

fn read_id<'v>(place: &Place<'v, '_>, faults: &mut Faults) -> Option<&'v str> {
    let id = place.string(faults)?;
    let is_id = (1..=Batch::MAX_ID_CHARS).contains(&id.chars().count());
    if is_id { Some(id) } else { place.mismatch(&format!("a name of 1 to {} characters", Batch::MAX_ID_CHARS), faults) }
}

/// A transition as it was sent.
struct Transition {
    state: Vec<Value>,
    action: ActionIdx,
    next: Vec<Value>,
    count: u64,
    own_cost: OwnCost,
}

impl Transition {
    fn read(
        experience: &Experience,
        known: &HashMap<&str, ActionIdx>,
        place: &Place<'_, '_>,
        faults: &mut Faults,
    ) -> Option<Self> {
        let object = place.object(&["state", "action", "next", "count", "cost"], faults)?;
        let [state, next] = ["state", "next"].map(|name| {
            let place = object.required(name, faults)?;
            read_state(&experience.schema, &place, faults)
        });
        let action = object.required("action", faults).and_then(|place| read_action(experience, known, &place, faults));
        let count = match object.optional("count") {
            Some(place) => place.integer(1, Batch::MAX_COUNT, faults),
            None => Some(1),
        };
        let cost = match object.optional("cost") {
            Some(place) => place.number(Range::UpTo(MAX_COST), faults).map(Some),
            None => Some(None),
        };
        Some(Self { state: state?, action: action?, next: next?, count: count?, own_cost: OwnCost::of(cost?) })
    }

    /// Adds it to `text` in canonical form, and a comma.
    fn write(&self, experience: &Experience, text: &mut String) {
        #[derive(Serialize)]
        struct Written<'t> {
            state: Vec<WrittenValue<'t>>,
            action: &'t str,
            next: Vec<WrittenValue<'t>>,
            #[serde(skip_serializing_if = "Option::is_none")]
            count: Option<u64>,
            #[serde(skip_serializing_if = "Option::is_none")]
            cost: Option<f64>,
        }
        let attributes = experience.schema.attributes();
        let [state, next] = [&self.state, &self.next]
            .map(|values| attributes.iter().zip(values).map(|(attribute, value)| attribute.written(value)).collect());
        let written = Written {
            state,
            action: &experience.actions[usize::from(self.action)].name,
            next,
            count: Some(self.count).filter(|count| *count > 1),
            cost: self.own_cost.get(),
        };
        // Writing to memory does not fail.
        text.push_str(&serde_json::to_string(&written).unwrap_or_default());
        text.push(',');
    }
}

/// Reads an action by its name.
fn read_action(
    experience: &Experience,
    known: &HashMap<&str, ActionIdx>,
    place: &Place<'_, '_>,
    faults: &mut Faults,
) -> Option<ActionIdx> {
    let name = place.string(faults)?;
    let action = known.get(normal(name).as_ref()).copied();
    if action.is_none() {
        let names = list_known(experience.actions.iter().map(|action| &action.name));
        faults.note(place, format!("unknown action {}; the model has {names}", Quoted(name)));
    }
    action
}
