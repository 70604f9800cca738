//! Models: what a body can do in its world.
//!
//! A [`Definition`] is what a client registers: attributes, actions with costs, and dynamics of some kind. It is compiled into a [`Model`],
//! which is the same to searches whatever it was made from: states with their rows of values, and a [`Graph`] of transitions. Where there
//! are too many states to list them, each search finds those that it comes to (`Space`, [`Model::is_lazy`]).
//!
//! ```text
//! JSON --Definition::parse--> Definition( dyn Dynamics ) --compile--> Model { schema, actions, states, graph, start }
//!                                   |                                   |
//!                                   |                                   +--Space--> searches
//!                                   +--write--> canonical JSON: hash, store
//! ```
//!
//! Each file uses only those above it, and `reading`, which takes a text apart without knowing of dynamics:
//!
//! | file | is |
//! |---|---|
//! | `action`, `room`, `states`, `rows`, `graph`, `operator`, `limits` | the parts |
//! | `space` | states and transitions as a search sees them |
//! | `implicit`, `explored` | rules by which states follow from one another; what was found by them |
//! | `reach`, `compiled`, `origin` | which values states have; the model; where a request says that the imitator starts |
//! | `dynamics` | the seam: what every kind of dynamics is to the rest |
//! | `table`, `planning`, `rules`, `wumpus`, `experience` | the kinds, a folder each |
//! | `kinds` | the list of kinds |
//! | `definition`, `builder`, `import` | what a client registers, as JSON, by calls, or from the files of other tools |
//! | `experienced` | what was experienced with a registered model |
//!
//! Nothing here knows of demonstrations.

mod action;
mod builder;
mod compiled;
mod deadly;
mod definition;
mod dynamics;
mod experience;
mod experienced;
mod explored;
mod graph;
mod implicit;
mod import;
mod kinds;
mod limits;
mod operator;
mod origin;
mod planning;
mod reach;
mod reading;
mod room;
mod rows;
#[cfg(feature = "rules")]
mod rules;
mod space;
mod states;
mod table;
mod wumpus;

pub use action::{Action, ActionDocument, ActionIdx};
pub use builder::ModelBuilder;
pub use compiled::Model;
pub use definition::{Definition, DefinitionDocument};
pub use experience::{
    Batch, Experience, ExperienceCounts, ExperienceDocument, KeptTally, NOTHING_YET, SeenStateDocument,
    SeenStatesDocument, Tally,
};
pub use graph::{Graph, OwnCost, Transition};
pub use implicit::{Implicit, Outcome};
pub use import::{Edits, ImportError, ImportFile, ImportFormat, Spot, import};
pub use kinds::DynamicsDocument;
pub use limits::{CompileError, Limits};
pub use operator::Operator;
pub use origin::{Origin, OriginRow};
pub use planning::{ConditionalDocument, OperatorDocument, PackedState, Planning, PlanningDocument};
pub use reading::{Format, MAX_LINE_BYTES, ReadError};
pub(crate) use room::{make_room, room_to_make};
pub(crate) use rows::Rows;
#[cfg(feature = "rules")]
pub use rules::{OutcomeDocument, RuleDocument, RulesDocument, StatesDocument};
pub(crate) use space::{Space, Whole};
pub use states::{Start, StateIdx, States};
pub use table::{ActionReference, StartDocument, Table, TableDocument, TransitionDocument};
pub use wumpus::{Act, Cave, CaveState, Cell, CellDocument, Heading, PoseDocument, WumpusDocument};
