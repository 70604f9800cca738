//! Where a request says that the imitator starts.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use super::explored::Unexplored;
use super::{ActionIdx, Model, StateIdx};
use crate::attribute::{MAX_COST, Value};
use crate::document::{Faults, Path, Place, Quoted, Range, list_known, normal};

/// A state that a request says the imitator may start in.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Origin {
    /// This state.
    State(StateIdx),
    /// A state of a model that is searched lazily, which has no number: its row. Only [`Model::read_start`] makes one, so that there is such
    /// a state.
    Row(OriginRow),
}

/// The row of a state that is there. Shape `[n_attributes]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OriginRow(pub(crate) Vec<u32>);

impl Model {
    /// Reads the start of a request: one [state](Self::read_start), or a list of states, at least one.
    pub fn read_starts(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Origin>> {
        let Some(items) = place.value.as_array() else {
            return self.read_start(place, faults).map(|start| vec![start]);
        };
        let most = Self::MAX_STARTS.max(self.states.len() as usize);
        if items.is_empty() || items.len() > most {
            faults.note(place, format!("expected 1 to {most} states, found {}", items.len()));
            return None;
        }
        let starts: Vec<Option<Origin>> =
            items.iter().enumerate().map(|(n, item)| self.read_start(&place.item(n, item), faults)).collect();
        starts.into_iter().collect()
    }

    /// Most start states of a request, unless the model lists more.
    const MAX_STARTS: usize = 10_000;

    /// Reads names of actions: an array.
    pub fn read_action_names(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<ActionIdx>> {
        let items = place.array(faults)?;
        let known = self.actions_by_name();
        let mut read = Vec::with_capacity(items.len().min(self.actions.len()));
        let n_before = faults.count();
        for (n, item) in items.iter().enumerate() {
            let place = place.item(n, item);
            if let Some(name) = place.string(faults) {
                read.extend(self.find_action(&known, name, &place.path, faults));
            }
        }
        read.sort_unstable();
        read.dedup();
        (faults.count() == n_before).then_some(read)
    }

    /// Reads costs of actions, 0 to 1e150: an object by action name. A transition that has its own cost keeps that.
    pub fn read_action_costs(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<(ActionIdx, f64)>> {
        let object = place.open_object(faults)?;
        let known = self.actions_by_name();
        let mut read = Vec::new();
        let n_before = faults.count();
        for (name, place) in object.iter() {
            let action = self.find_action(&known, name, &place.path, faults);
            let cost = place.number(Range::UpTo(MAX_COST), faults);
            read.extend(action.zip(cost));
        }
        (faults.count() == n_before).then_some(read)
    }

    /// Hashed with a seed, as clients choose the names.
    fn actions_by_name(&self) -> HashMap<&str, ActionIdx> {
        self.actions.iter().map(|action| &*action.name).zip(0..).collect()
    }

    fn find_action(
        &self,
        known: &HashMap<&str, ActionIdx>,
        name: &str,
        path: &Path<'_>,
        faults: &mut Faults,
    ) -> Option<ActionIdx> {
        let action = known.get(normal(name).as_ref()).copied();
        if action.is_none() {
            let names = list_known(self.actions.iter().map(|action| &action.name));
            faults.note_at(path, format!("unknown action {}; the model has {names}", Quoted(name)));
        }
        action
    }

    /// Reads the start of a request: a state's index, or an object of attribute values that exactly one state has. Of a model that is
    /// searched lazily, only the start states have an index, and an object must give all attributes but those that follow from others.
    pub fn read_start(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Origin> {
        match &self.unexplored {
            None => self.read_known(place, faults).map(Origin::State),
            Some(unexplored) if place.value.is_object() => {
                let row = self.read_row(&**unexplored, place, faults)?;
                Some(Origin::Row(OriginRow(row)))
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

    /// Whether there is a state with this row, in a model that is searched lazily.
    pub(crate) fn has_row(&self, row: &[u32]) -> bool {
        let is_row = row.len() == self.schema.len()
            && row.iter().enumerate().all(|(at, value)| (*value as usize) < self.states.domain(at).len());
        let known: Vec<Option<u32>> = row.iter().copied().map(Some).collect();
        is_row && self.unexplored.as_ref().is_some_and(|unexplored| unexplored.complete_row(&known).is_some())
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
        let wanted = self.schema.read_state(place, faults)?;
        (faults.count() == n_before).then_some(wanted)
    }

    fn has_values(&self, state: StateIdx, wanted: &[Option<Value>]) -> bool {
        let mut pairs = self.states.values(state).zip(wanted);
        pairs.all(|(value, wanted)| wanted.as_ref().is_none_or(|wanted| wanted == value))
    }
}

const NO_STATE: &str = "no state of the model has these values";
