//! Models: what a body can do in its world.
//!
//! A [`Definition`] is what a client registers: attributes, actions with costs, and dynamics of one of the
//! kinds below. It is compiled into a [`Model`], whose [`Graph`] is the same whatever the source, and which searches
//! run on. A wumpus world of too many states is left unexplored: a search then finds those that it comes to (`Space`).
//!
//! ```text
//! JSON --Definition::parse--> Definition { Table | Cave } --Model::compile--> Model { schema, actions, states, graph, start }
//!                                   |
//!                                   +--Definition::write--> canonical JSON: hash, store
//! ```
//!
//! Nothing here knows of demonstrations.

mod action;
mod builder;
mod definition;
mod explored;
mod graph;
mod operator;
mod reading;
mod rows;
mod space;
mod states;
mod table;
mod wumpus;

use std::sync::{Arc, OnceLock};

pub use action::{Action, ActionDocument, ActionIdx};
pub use builder::ModelBuilder;
pub use definition::{Definition, DefinitionDocument, DynamicsDocument};
pub(crate) use explored::Explored;
pub use graph::{Graph, Transition};
pub(crate) use operator::Operator;
pub use reading::{Format, MAX_LINE_BYTES, ReadError};
pub(crate) use rows::Rows;
pub(crate) use space::{Space, Whole, make_room, room_to_make};
pub use states::{StateIdx, States};
pub use table::{ActionReference, StartDocument, Table, TableDocument, TransitionDocument};
pub use wumpus::{Act, Cave, CaveState, Cell, CellDocument, Heading, PoseDocument, WumpusDocument};

use crate::attribute::{ByAttribute, Scalar, Schema, Value};
use crate::document::{Faults, Place};
use crate::interrupt::{Cancelled, Interrupt, Interrupted};

/// What a model may at most be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Most states; those of a wumpus world are counted as they are reached, and if there are more, they are left to
    /// searches.
    pub max_states: usize,
    /// Most transitions of a table.
    pub max_transitions: usize,
    /// Most values of the states of a wumpus world, one for each state and attribute, as they are reached: to make these takes the time.
    /// If there are more, they are left to searches.
    pub max_values: usize,
    /// About how much memory the model may take while it is compiled, in bytes. A wumpus world that would take more is left to searches; a
    /// table is refused ([`ReadError::TooLarge`]).
    pub max_bytes: usize,
}

impl Limits {
    /// One million states and ten million transitions, which take a few hundred MB, at most 4 GB; and no more values than are made in a
    /// few seconds.
    pub const DEFAULT: Self =
        Self { max_states: 1_000_000, max_transitions: 10_000_000, max_values: 1 << 27, max_bytes: 4 << 30 };
    /// As much as can be told apart by indices.
    pub const NONE: Self =
        Self { max_states: usize::MAX, max_transitions: usize::MAX, max_values: usize::MAX, max_bytes: usize::MAX };
}

/// Why a definition gives no model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CompileError {
    /// The definition is at fault.
    #[error(transparent)]
    Faults(#[from] Faults),
    /// The caller lost interest.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// It takes longer than there was time.
    #[error("out of time")]
    OutOfTime,
}

impl From<Interrupted> for CompileError {
    fn from(interrupted: Interrupted) -> Self {
        match interrupted {
            Interrupted::Cancelled(cancelled) => Self::Cancelled(cancelled),
            Interrupted::OutOfTime => Self::OutOfTime,
        }
    }
}

/// Where a request says that the imitator starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// In this state.
    State(StateIdx),
    /// In this state of a model that is searched lazily.
    Cave(CaveState),
}

impl Origin {
    /// The state, if it has a number in its model.
    #[must_use]
    pub fn state(self) -> Option<StateIdx> {
        match self {
            Self::State(state) => Some(state),
            Self::Cave(_) => None,
        }
    }
}

/// Where the imitator may start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Start {
    /// In this state.
    State(StateIdx),
    /// In whichever of these states is closest to the first observation; the lowest index among equals. Not empty.
    Candidates(Vec<StateIdx>),
    /// In whichever state is closest to the first observation; the lowest index among equals.
    Any,
}

/// A body in its world, ready to be searched.
#[derive(Debug)]
pub struct Model {
    schema: Schema,
    actions: Vec<Action>,
    states: Arc<States>,
    graph: Graph,
    start: Start,
    n_transitions: usize,
    is_unsafe: Vec<bool>,
    n_unsafe: usize,
    /// The world, if its states are not known.
    unexplored: Option<Cave>,
    /// See [`Self::state_bytes`].
    state_bytes: OnceLock<usize>,
}

impl Model {
    /// Compiles `definition`. A wumpus world that is larger than `limits` allow becomes a model that is searched lazily.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub fn compile(
        definition: &Definition,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Self, Interrupted> {
        match definition {
            Definition::Table(table) => table.compile(interrupt),
            Definition::Wumpus(cave) => cave.compile(limits, interrupt),
        }
    }

    /// The attributes of its states.
    #[must_use]
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// The actions of the body, in the order of their indices.
    #[must_use]
    pub fn actions(&self) -> &[Action] {
        &self.actions
    }

    /// Whether each search finds the states that it comes to, and numbers them on its own, as there are too many to know them
    /// all. Of such a model, [`Self::states`] has only the start, and [`Self::graph`] nothing.
    #[must_use]
    pub fn is_lazy(&self) -> bool {
        self.unexplored.is_some()
    }

    /// The world, if it is searched lazily.
    pub(crate) fn unexplored(&self) -> Option<&Cave> {
        self.unexplored.as_ref()
    }

    /// The states.
    #[must_use]
    pub fn states(&self) -> &States {
        &self.states
    }

    /// The transitions that a body may make: those that have an effect and do not lead into an unsafe state.
    #[must_use]
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// Where the imitator may start when a request does not say.
    #[must_use]
    pub fn start(&self) -> &Start {
        &self.start
    }

    /// Whether `state` must never be entered.
    #[must_use]
    pub fn is_unsafe(&self, state: StateIdx) -> bool {
        self.is_unsafe.get(state as usize).copied().unwrap_or(false)
    }

    /// How many transitions its definition has, those that a body may not make included.
    #[must_use]
    pub fn n_transitions(&self) -> usize {
        self.n_transitions
    }

    /// How many states must never be entered.
    #[must_use]
    pub fn n_unsafe(&self) -> usize {
        self.n_unsafe
    }

    /// The values of `state`, as they are written outside.
    #[must_use]
    pub fn describe(&self, state: StateIdx) -> ByAttribute<Scalar> {
        self.describe_one_of(&self.states, state)
    }

    /// The values of one of `states`, which have this model's attributes, as they are written outside.
    pub(crate) fn describe_one_of(&self, states: &States, state: StateIdx) -> ByAttribute<Scalar> {
        let values = states.values(state);
        let written =
            self.schema.attributes().iter().zip(values).map(|(attribute, value)| attribute.write_value(value));
        self.schema.by_attribute(written)
    }

    /// About how many bytes of JSON the values of a state are: as many as those of the first one. `O(1)`, once it is known.
    pub fn state_bytes(&self) -> usize {
        let first = || serde_json::to_string(&self.describe(0)).map_or(usize::MAX, |text| text.len());
        *self.state_bytes.get_or_init(first)
    }

    /// About how much memory it takes to read and compile a model of so many states, transitions and attributes, in bytes: enough for
    /// most. Where nearly every state has a value of its own in several attributes, or texts are long, it takes more, as
    /// [`Self::size_bytes`] tells in the end.
    #[must_use]
    pub fn compiled_bytes(n_states: u64, n_transitions: u64, n_attributes: u64) -> u64 {
        /// Besides its row: where its transitions begin, and a value of its own.
        const STATE_BYTES: u64 = 32;
        /// Listed, in the graph and in a projection.
        const TRANSITION_BYTES: u64 = 20;
        /// Domains, actions and what else there is once.
        const OTHER_BYTES: u64 = 1 << 16;
        // Of the rows, some more while they are read.
        let row_bytes = n_attributes * (size_of::<u32>() as u64) * 3 / 2;
        let states = n_states.saturating_mul(row_bytes + STATE_BYTES);
        states.saturating_add(n_transitions.saturating_mul(TRANSITION_BYTES)).saturating_add(OTHER_BYTES)
    }

    /// Approximate size in memory, in bytes.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        let start = if let Start::Candidates(states) = &self.start { size_of_val(states.as_slice()) } else { 0 };
        start + self.states.size_bytes() + self.graph.size_bytes() + self.is_unsafe.len()
    }

    /// Reads the start of a request: a state's index, or an object of attribute values that exactly one state has. Of a model that is
    /// searched lazily, only the start has an index, 0, and an object must give all attributes (`gold` may be left out).
    pub fn read_start(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Origin> {
        match &self.unexplored {
            None => self.read_known(place, faults).map(Origin::State),
            Some(cave) if place.value.is_object() => cave.read_state(&self.schema, place, faults).map(Origin::Cave),
            Some(_) if place.value == 0 => Some(Origin::State(0)),
            Some(_) => place
                .mismatch("attribute values: this world is searched lazily, and its states have no numbers", faults),
        }
    }

    fn read_known(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<StateIdx> {
        let state = if place.value.is_object() {
            let wanted = self.read_wanted(place, faults)?;
            let mut found = (0..self.states.len()).filter(|state| self.has_values(*state, &wanted));
            match (found.next(), found.next()) {
                (Some(state), None) => state,
                (None, _) => {
                    faults.note(place, "no state of the model has these values");
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

    fn read_wanted(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Option<Value>>> {
        let n_before = faults.count();
        let wanted = self.schema.read_observation(place, faults)?;
        (faults.count() == n_before).then_some(wanted)
    }

    fn has_values(&self, state: StateIdx, wanted: &[Option<Value>]) -> bool {
        let mut pairs = self.states.values(state).zip(wanted);
        pairs.all(|(value, wanted)| wanted.as_ref().is_none_or(|wanted| wanted == value))
    }

    /// The action at `index`.
    #[must_use]
    pub fn action(&self, index: ActionIdx) -> &Action {
        &self.actions[usize::from(index)]
    }

    /// The name of the action at `index`, shared.
    #[must_use]
    pub fn action_name(&self, index: ActionIdx) -> Arc<str> {
        self.action(index).name.clone()
    }
}
