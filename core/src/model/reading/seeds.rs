//! How each value of a model's text is taken in as the parser meets it.

use serde::de::{DeserializeSeed, Deserializer, Error, IgnoredAny, MapAccess, SeqAccess};
use serde_json::{Map, Value};

use super::items::{Entry, Row};
use super::lists::{RawStates, RawTransitions};
use super::raw::Raw;
use super::take::{Take, Taking, traced};
use super::{Limits, PathStep, Reader, Stop};
use crate::document::{Path, TWICE};
use crate::interrupt::Meter;

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
pub(super) struct Seed<'r, 'm, 'i, 'p> {
    reader: &'r mut Reader<'m, 'i>,
    position: Position,
    path: Path<'p>,
}

impl<'r, 'm, 'i, 'p> Seed<'r, 'm, 'i, 'p> {
    pub(super) fn new(reader: &'r mut Reader<'m, 'i>, position: Position, path: Path<'p>) -> Self {
        Self { reader, position, path }
    }
}

impl<'de> DeserializeSeed<'de> for Seed<'_, '_, '_, '_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        self.reader.hold(size_of::<Value>())?;
        Taking(self).deserialize(deserializer)
    }
}

impl<'de> Take<'de> for Seed<'_, '_, '_, '_> {
    type Taken = Value;

    fn scalar(self, found: Raw<&str>) -> Value {
        if let Raw::Text(text) = found {
            self.reader.n_held_bytes += text.len();
        }
        found.scalar().unwrap_or_default()
    }

    fn array<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let Self { reader, position, path } = self;
        match position {
            Position::States { is_in_model } => return reader.take_states(items, is_in_model),
            Position::Transitions { is_in_model } => return reader.take_transitions(items, is_in_model),
            _ => {}
        }
        let mut held = Vec::new();
        loop {
            let place = Path::Item(&path, held.len());
            let item = items.next_element_seed(Seed::new(reader, Position::Elsewhere, place));
            match reader.traced(item, || PathStep::Item(held.len()))? {
                Some(item) => held.push(item),
                None => return Ok(Value::Array(held)),
            }
        }
    }

    fn object<A: MapAccess<'de>>(self, mut members: A) -> Result<Value, A::Error> {
        let Self { reader, position, path } = self;
        let mut held = Map::new();
        while let Some(name) = members.next_key::<String>()? {
            reader.hold(size_of::<String>() + name.len())?;
            let place = Path::Member(&path, &name);
            if held.contains_key(&name) {
                // Items of two lists could not be told apart later.
                reader.twice.note_at(&place, TWICE);
            }
            let member = members.next_value_seed(Seed::new(reader, position.of_member(&name), place));
            let member = reader.traced(member, || PathStep::Member(name.clone()))?;
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
