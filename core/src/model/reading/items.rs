//! How each item of the two long lists is taken in: a state, a transition.

use serde::de::{IgnoredAny, SeqAccess};

use super::PathStep;
use super::lists::{NoTransition, RawIndex, RawStates, RawTerms, RawTransitions};
use super::raw::{Distinct, Raw};
use super::take::{Take, Taking, traced};
use crate::attribute::Schema;
use crate::document::whole;

/// Takes a state.
pub(super) struct Row<'r> {
    pub(super) states: &'r mut RawStates,
    pub(super) trace: &'r mut Vec<PathStep>,
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
pub(super) struct Entry<'r> {
    pub(super) transitions: &'r mut RawTransitions,
    pub(super) trace: &'r mut Vec<PathStep>,
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
            Raw::Float(bits) => {
                let number = whole(f64::from_bits(bits)).and_then(|number| u32::try_from(number).ok());
                number.ok_or_else(|| found.owned())
            }
            _ => Err(found.owned()),
        }
    }
}
