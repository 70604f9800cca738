//! How each value of a model's text is taken in as the parser meets it.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};

use super::lists::{NoTransition, RawIndex, RawStates, RawTerms, RawTransitions};
use super::raw::{Distinct, Raw};
use super::{Limits, PathStep, Reader, Stop};
use crate::attribute::Schema;
use crate::interrupt::Meter;

/// Takes one value, whatever it is.
trait Take<'de>: Sized {
    type Taken;

    fn scalar(self, found: Raw<&str>) -> Self::Taken;

    fn array<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Taken, A::Error> {
        let mut n_items = 0;
        while items.next_element::<IgnoredAny>()?.is_some() {
            n_items += 1;
        }
        Ok(self.scalar(Raw::Array(n_items)))
    }

    fn object<A: MapAccess<'de>>(self, mut members: A) -> Result<Self::Taken, A::Error> {
        while members.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
        Ok(self.scalar(Raw::Object))
    }
}

struct Taking<T>(T);

impl<'de, T: Take<'de>> DeserializeSeed<'de> for Taking<T> {
    type Value = T::Taken;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<T::Taken, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de, T: Take<'de>> Visitor<'de> for Taking<T> {
    type Value = T::Taken;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any JSON value")
    }

    fn visit_unit<E>(self) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Null))
    }

    fn visit_bool<E>(self, flag: bool) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Boolean(flag)))
    }

    fn visit_u64<E>(self, number: u64) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Whole(number)))
    }

    fn visit_i64<E>(self, number: i64) -> Result<T::Taken, E> {
        Ok(self.0.scalar(u64::try_from(number).map_or(Raw::Negative(number), Raw::Whole)))
    }

    fn visit_f64<E>(self, number: f64) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::float(number)))
    }

    fn visit_str<E>(self, text: &str) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Text(text)))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, items: A) -> Result<T::Taken, A::Error> {
        self.0.array(items)
    }

    fn visit_map<A: MapAccess<'de>>(self, members: A) -> Result<T::Taken, A::Error> {
        self.0.object(members)
    }
}

/// Where in the document a value stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Position {
    /// The model.
    Root,
    /// Its dynamics.
    Dynamics,
    /// A list of states; within the model's dynamics, or not.
    States { is_in_model: bool },
    /// A list of transitions, likewise.
    Transitions { is_in_model: bool },
    /// A line after the model's.
    Chunk,
    /// Anywhere else.
    Elsewhere,
}

impl Position {
    fn of_member(self, name: &str) -> Self {
        let is_in_model = self == Self::Dynamics;
        match (self, name) {
            (Self::Root, "dynamics") => Self::Dynamics,
            (Self::Dynamics | Self::Chunk, "states") => Self::States { is_in_model },
            (Self::Dynamics | Self::Chunk, "transitions") => Self::Transitions { is_in_model },
            _ => Self::Elsewhere,
        }
    }
}

/// Keeps a value as it is, without the long lists.
pub(super) struct Seed<'r, 'm, 'i> {
    reader: &'r mut Reader<'m, 'i>,
    position: Position,
}

impl<'r, 'm, 'i> Seed<'r, 'm, 'i> {
    pub(super) fn new(reader: &'r mut Reader<'m, 'i>, position: Position) -> Self {
        Self { reader, position }
    }
}

impl<'de> DeserializeSeed<'de> for Seed<'_, '_, '_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        self.reader.hold(size_of::<Value>())?;
        Taking(self).deserialize(deserializer)
    }
}

impl<'de> Take<'de> for Seed<'_, '_, '_> {
    type Taken = Value;

    fn scalar(self, found: Raw<&str>) -> Value {
        if let Raw::Text(text) = found {
            self.reader.n_held_bytes += text.len();
        }
        found.scalar().unwrap_or_default()
    }

    fn array<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let Self { reader, position } = self;
        match position {
            Position::States { is_in_model } => return reader.take_states(items, is_in_model),
            Position::Transitions { is_in_model } => return reader.take_transitions(items, is_in_model),
            _ => {}
        }
        let mut held = Vec::new();
        loop {
            let item = items.next_element_seed(Seed::new(reader, Position::Elsewhere));
            match reader.traced(item, || PathStep::Item(held.len()))? {
                Some(item) => held.push(item),
                None => return Ok(Value::Array(held)),
            }
        }
    }

    fn object<A: MapAccess<'de>>(self, mut members: A) -> Result<Value, A::Error> {
        let Self { reader, position } = self;
        if position == Position::Dynamics {
            // The last of members with the same name counts.
            (reader.states, reader.transitions) = (None, None);
        }
        let mut held = Map::new();
        while let Some(name) = members.next_key::<String>()? {
            reader.hold(size_of::<String>() + name.len())?;
            let member = members.next_value_seed(Seed::new(reader, position.of_member(&name)));
            let member = reader.traced(member, || PathStep::Member(name.clone()))?;
            if position == Position::Chunk && held.contains_key(&name) {
                reader.twice.push(name.clone());
            }
            held.insert(name, member);
        }
        Ok(Value::Object(held))
    }
}

impl Reader<'_, '_> {
    /// Counts memory of values that are kept.
    fn hold<E: Error>(&mut self, n_bytes: usize) -> Result<(), E> {
        self.n_held_bytes += n_bytes;
        if self.n_held_bytes <= self.max_held_bytes {
            return spend(self.meter, &mut self.stop, 1);
        }
        let detail = "besides its states and transitions, the model takes more memory than a model may";
        self.stop = Some(Stop::TooLarge(detail.to_owned()));
        Err(E::custom("too large"))
    }

    /// Adds a step to the path of an error, as it is passed on to the caller.
    fn traced<T, E>(&mut self, read: Result<T, E>, step: impl FnOnce() -> PathStep) -> Result<T, E> {
        traced(&mut self.trace, read, step)
    }

    fn take_states<'de, A: SeqAccess<'de>>(&mut self, mut rows: A, is_in_model: bool) -> Result<Value, A::Error> {
        /// How many are read between two checks of the memory: less than a megabyte of values.
        const LOOK_EVERY: usize = 16;
        let n_other_bytes = self.transitions.as_ref().map_or(0, RawTransitions::size_bytes);
        let Self { meter, limits, states, line, stop, trace, .. } = self;
        if is_in_model {
            *states = None;
        }
        let states = states.get_or_insert_default();
        let first = states.n_states;
        loop {
            spend(meter, stop, states.columns.len() as u64)?;
            if states.n_states.is_multiple_of(LOOK_EVERY) {
                check_memory(n_other_bytes + states.size_bytes(), *limits, stop)?;
            }
            let n_before = states.n_states;
            let is_kept = n_before < limits.max_states;
            let row = if is_kept {
                rows.next_element_seed(Taking(Row { states, trace }))
            } else {
                rows.next_element::<IgnoredAny>().map(|row| row.map(|_| states.n_states += 1))
            };
            if traced(trace, row, || PathStep::Item(n_before - first))?.is_none() {
                break;
            }
        }
        states.item_paths.add(first, states.n_states - first, *line, is_in_model);
        Ok(Value::Array(Vec::new()))
    }

    fn take_transitions<'de, A: SeqAccess<'de>>(&mut self, mut items: A, is_in_model: bool) -> Result<Value, A::Error> {
        let n_other_bytes = self.states.as_ref().map_or(0, RawStates::size_bytes);
        let Self { meter, limits, transitions, line, stop, trace, .. } = self;
        if is_in_model {
            *transitions = None;
        }
        let transitions = transitions.get_or_insert_default();
        let first = transitions.n_transitions;
        loop {
            spend(meter, stop, 1)?;
            check_memory(n_other_bytes + transitions.size_bytes(), *limits, stop)?;
            let n_before = transitions.n_transitions;
            let is_kept = n_before < limits.max_transitions;
            let item = if is_kept {
                items.next_element_seed(Taking(Entry { transitions, trace }))
            } else {
                items.next_element::<IgnoredAny>().map(|item| item.map(|_| transitions.n_transitions += 1))
            };
            if traced(trace, item, || PathStep::Item(n_before - first))?.is_none() {
                break;
            }
        }
        transitions.item_paths.add(first, transitions.n_transitions - first, *line, is_in_model);
        Ok(Value::Array(Vec::new()))
    }
}

/// Counts values that were read.
fn spend<E: Error>(meter: &mut Meter<'_>, stop: &mut Option<Stop>, n_values: u64) -> Result<(), E> {
    meter.spend_or_stop(n_values).map_err(|interrupted| {
        *stop = Some(Stop::Interrupted(interrupted));
        E::custom("interrupted")
    })
}

/// Stops where the lists take more memory than they may.
fn check_memory<E: Error>(n_bytes: usize, limits: Limits, stop: &mut Option<Stop>) -> Result<(), E> {
    if n_bytes <= limits.max_bytes {
        return Ok(());
    }
    let detail = format!(
        "the model takes over {} MB once it is compiled, more than there is for one (ETUDE_MAX_MEMORY)",
        limits.max_bytes >> 20
    );
    *stop = Some(Stop::TooLarge(detail));
    Err(E::custom("too large"))
}

fn traced<T, E>(trace: &mut Vec<PathStep>, read: Result<T, E>, step: impl FnOnce() -> PathStep) -> Result<T, E> {
    if read.is_err() {
        trace.push(step());
    }
    read
}

/// Takes a state.
struct Row<'r> {
    states: &'r mut RawStates,
    trace: &'r mut Vec<PathStep>,
}

impl<'de> Take<'de> for Row<'_> {
    type Taken = ();

    fn scalar(self, found: Raw<&str>) {
        self.states.add_no_row(found);
    }

    fn array<A: SeqAccess<'de>>(self, mut cells: A) -> Result<(), A::Error> {
        let Self { states, trace } = self;
        let mut len = 0;
        loop {
            let cell = if len < Schema::MAX_ATTRIBUTES {
                if len == states.columns.len() {
                    states.columns.push(Distinct::default());
                }
                let cell = cells.next_element_seed(Taking(Numbered(&mut states.columns[len])));
                cell.map(|number| number.map(|number| states.cells.push(number)))
            } else {
                cells.next_element::<IgnoredAny>().map(|cell| cell.map(|_| ()))
            };
            if traced(trace, cell, || PathStep::Item(len))?.is_none() {
                break;
            }
            len += 1;
        }
        states.end_row(len);
        Ok(())
    }
}

/// How many parts a transition has at most.
const MAX_PARTS: usize = 5;

/// Takes a transition.
struct Entry<'r> {
    transitions: &'r mut RawTransitions,
    trace: &'r mut Vec<PathStep>,
}

impl<'de> Take<'de> for Entry<'_> {
    type Taken = ();

    fn scalar(self, found: Raw<&str>) {
        self.transitions.add_faulty(NoTransition::Other(found.owned()));
    }

    fn array<A: SeqAccess<'de>>(self, mut parts: A) -> Result<(), A::Error> {
        let Self { transitions, trace } = self;
        let from = parts.next_element_seed(Taking(Index));
        let Some(from) = traced(trace, from, || PathStep::Item(0))? else {
            transitions.add_faulty(NoTransition::Array(0));
            return Ok(());
        };
        let reference = parts.next_element_seed(Taking(Numbered(&mut transitions.references)));
        let Some(reference) = traced(trace, reference, || PathStep::Item(1))? else {
            transitions.add_faulty(NoTransition::Array(1));
            return Ok(());
        };
        let to = parts.next_element_seed(Taking(Index));
        let Some(to) = traced(trace, to, || PathStep::Item(2))? else {
            transitions.add_faulty(NoTransition::Array(2));
            return Ok(());
        };
        let mut terms = RawTerms::NONE;
        let mut len = 3;
        loop {
            let found = parts.next_element_seed(Taking(AsIs));
            match (traced(trace, found, || PathStep::Item(len))?, len) {
                (None, _) => break,
                (Some(found), 3) => terms.probability = found,
                (Some(found), 4) => terms.cost = found,
                (Some(_), _) => {}
            }
            len += 1;
        }
        if len <= MAX_PARTS {
            transitions.add(from, reference, to, terms);
        } else {
            transitions.add_faulty(NoTransition::Array(len));
        }
        Ok(())
    }
}

/// Takes a value as it is.
struct AsIs;

impl Take<'_> for AsIs {
    type Taken = Raw;

    fn scalar(self, found: Raw<&str>) -> Raw {
        found.owned()
    }
}

/// Takes a value, and gives its number among the distinct ones.
struct Numbered<'r>(&'r mut Distinct);

impl Take<'_> for Numbered<'_> {
    type Taken = u32;

    fn scalar(self, found: Raw<&str>) -> u32 {
        self.0.number_of(found)
    }
}

/// Takes the index of a state.
struct Index;

impl Take<'_> for Index {
    type Taken = RawIndex;

    fn scalar(self, found: Raw<&str>) -> RawIndex {
        match found {
            Raw::Whole(number) => u32::try_from(number).map_err(|_| found.owned()),
            _ => Err(found.owned()),
        }
    }
}
