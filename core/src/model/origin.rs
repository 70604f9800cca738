//! Where a request says that the imitator starts.

use std::sync::Arc;

use super::explored::Unexplored;
use super::{Model, StateIdx};
use crate::attribute::Value;
use crate::document::{Faults, Place, Quoted};

/// The state that a request says the imitator starts in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// This state.
    State(StateIdx),
    /// A state of a model that is searched lazily, which has no number: its row. Only [`Model::read_start`] makes one, so that there is such
    /// a state.
    Row(OriginRow),
}

/// The row of a state that is there. Shape `[n_attributes]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OriginRow(pub(crate) Arc<[u32]>);

impl Origin {
    /// The state, if it has a number in its model.
    #[must_use]
    pub fn state(self) -> Option<StateIdx> {
        match self {
            Self::State(state) => Some(state),
            Self::Row(_) => None,
        }
    }
}

impl Model {
    /// Reads the start of a request: a state's index, or an object of attribute values that exactly one state has. Of a model that is
    /// searched lazily, only the start states have an index, and an object must give all attributes but those that follow from others.
    pub fn read_start(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Origin> {
        match &self.unexplored {
            None => self.read_known(place, faults).map(Origin::State),
            Some(unexplored) if place.value.is_object() => {
                let row = self.read_row(&**unexplored, place, faults)?;
                Some(Origin::Row(OriginRow(row.into())))
            }
            Some(_) => {
                let index = place.whole().and_then(|index| StateIdx::try_from(index).ok());
                match index.filter(|index| *index < self.states.len()) {
                    Some(index) => Some(Origin::State(index)),
                    None => place.mismatch(
                        "attribute values: this world is searched lazily, and its states have no numbers",
                        faults,
                    ),
                }
            }
        }
    }

    fn read_known(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<StateIdx> {
        let state = if place.value.is_object() {
            let wanted = self.read_wanted(place, faults)?;
            let mut found = (0..self.states.len()).filter(|state| self.has_values(*state, &wanted));
            match (found.next(), found.next()) {
                (Some(state), None) => state,
                (None, _) => {
                    faults.note(place, NO_STATE);
                    return None;
                }
                (Some(first), Some(second)) => {
                    let detail = format!("more than one state has these values, among them {first} and {second}");
                    faults.note(place, detail);
                    return None;
                }
            }
        } else {
            place.index(self.states.len() as usize, "state", faults)?
        };
        if self.is_unsafe(state) {
            faults.note(place, format!("state {state} is unsafe"));
            return None;
        }
        Some(state)
    }

    /// Reads the row of a state that has no number. Whether the body could come to it is not asked.
    fn read_row(&self, unexplored: &dyn Unexplored, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<u32>> {
        let wanted = self.read_wanted(place, faults)?;
        let attributes = self.schema.attributes().iter().zip(&wanted).enumerate();
        let mut missing = attributes.filter(|(at, (_, value))| value.is_none() && !unexplored.is_derived(*at));
        if let Some((_, (attribute, _))) = missing.next() {
            let detail = format!(
                "the states of this world are found as it is searched, so all attributes of one are needed; {} is missing",
                Quoted(&attribute.name)
            );
            faults.note(place, detail);
            return None;
        }
        let row = self.row_of(&wanted).and_then(|row| unexplored.complete_row(&row));
        if row.is_none() {
            faults.note(place, NO_STATE);
        }
        row
    }

    /// Where these values stand in their domains; `None` if one of them does not.
    fn row_of(&self, wanted: &[Option<Value>]) -> Option<Vec<Option<u32>>> {
        let index = |(at, wanted): (usize, &Option<Value>)| {
            let Some(wanted) = wanted else { return Some(None) };
            let index = self.states.domain(at).iter().position(|value| value == wanted)?;
            u32::try_from(index).ok().map(Some)
        };
        wanted.iter().enumerate().map(index).collect()
    }

    fn read_wanted(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Option<Value>>> {
        let n_before = faults.count();
        let wanted = self.schema.read_observation(place, faults)?;
        (faults.count() == n_before).then_some(wanted)
    }

    fn has_values(&self, state: StateIdx, wanted: &[Option<Value>]) -> bool {
        let mut pairs = self.states.values(state).zip(wanted);
        pairs.all(|(value, wanted)| wanted.as_ref().is_none_or(|wanted| wanted == value))
    }
}

const NO_STATE: &str = "no state of the model has these values";
