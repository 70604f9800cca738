//! What a client registers as a model.

use std::any::Any;
use std::cell::RefCell;
use std::io::{self, BufRead};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::action::ReadActions;
use super::dynamics::{Description, Dynamics};
use super::kinds::{self, DynamicsDocument};
use super::reading::{Interruptible, Outline, RawStates, RawTransitions, Reader};
use super::{ActionDocument, CompileError, Format, Limits, Model, ReadError};
use crate::attribute::{AttributeDocument, Schema};
use crate::document::{Faults, ParseError, Path, Place};
use crate::interrupt::{Interrupt, Interrupted, Meter};

/// What a client registers as a model: checked, with defaults filled in, not yet compiled.
#[derive(Clone, Debug)]
pub struct Definition(Arc<dyn Dynamics>);

impl Definition {
    /// A definition with these dynamics.
    pub(super) fn of(dynamics: impl Dynamics) -> Self {
        Self(Arc::new(dynamics))
    }

    /// Reads a model that is in memory as JSON values.
    ///
    /// # Errors
    ///
    /// [`CompileError::Faults`] with all faults of the document, [`CompileError::Cancelled`] or [`CompileError::OutOfTime`] if
    /// `interrupt` said so.
    pub fn read(
        document: &serde_json::Value,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Self, CompileError> {
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let outline = Reader::new(limits, &mut meter).read_value(document);
        let definition = outline.and_then(|outline| of_outline(outline, limits, &mut meter));
        definition.map_err(|error| match error {
            ReadError::Faults(faults) | ReadError::Parse(ParseError::Faults(faults)) => faults.into(),
            ReadError::Cancelled(cancelled) => cancelled.into(),
            ReadError::OutOfTime => CompileError::OutOfTime,
            // Values in memory are neither cut off nor malformed.
            error => Faults::one("", error.to_string()).into(),
        })
    }

    /// Reads a model's text.
    ///
    /// # Errors
    ///
    /// [`ReadError::Parse`] and [`ReadError::Faults`] with all faults of the text, [`ReadError::Cancelled`] or [`ReadError::OutOfTime`] if
    /// `interrupt` said so, [`ReadError::TooLarge`] if the model takes more memory than `limits` allow.
    pub fn parse(
        text: &[u8],
        format: Format,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Self, ReadError> {
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let outline = Reader::new(limits, &mut meter).read_text(text, format)?;
        of_outline(outline, limits, &mut meter)
    }

    /// Reads a model's text as it comes. Of its states and transitions, only compact arrays are kept.
    ///
    /// # Errors
    ///
    /// As [`Self::parse`]; [`ReadError::Read`] if `reader` failed.
    pub fn parse_from(
        reader: impl BufRead,
        format: Format,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Self, ReadError> {
        // Asked for by what is read and by what is made of it.
        let interrupt = RefCell::new(interrupt);
        let (mut by_reader, mut by_maker) = (|| interrupt.borrow_mut().poll(), || interrupt.borrow_mut().poll());
        let mut meter = Meter::new(&mut by_maker, POLL_EVERY);
        let reader = Interruptible::new(reader, &mut by_reader);
        let outline = Reader::new(limits, &mut meter).read_from(reader, format)?;
        of_outline(outline, limits, &mut meter)
    }

    /// The attributes of a state.
    #[must_use]
    pub fn schema(&self) -> &Schema {
        self.0.schema()
    }

    /// Its dynamics, if they are a `D`, such as a [`Cave`](super::Cave).
    #[must_use]
    pub fn dynamics<D: Any>(&self) -> Option<&D> {
        let dynamics: &dyn Any = &*self.0;
        dynamics.downcast_ref()
    }

    /// About how much memory compiling it takes at most, in bytes: for as many states as it can have within `limits`.
    #[must_use]
    pub fn compiling_bytes(&self, limits: Limits) -> u64 {
        self.0.compiling_bytes(limits)
    }

    /// Writes the definition as JSON in canonical form: defaults filled in, actions of transitions by name. Reading it gives
    /// the same definition, and equal content gives equal text.
    ///
    /// The order of lists is part of the content, also that of transitions and of candidates to start in, where it means
    /// nothing: their texts are hashed, and databases hold hashes of texts that were written in the order that was sent.
    ///
    /// # Errors
    ///
    /// If `writer` failed.
    pub fn write(&self, mut writer: impl io::Write) -> io::Result<()> {
        self.0.write(&mut writer)
    }

    /// The canonical text that [`Self::write`] writes.
    ///
    /// # Panics
    ///
    /// Never: writing to memory does not fail.
    #[must_use]
    pub fn text(&self) -> String {
        let mut text = Vec::new();
        self.write(&mut text).expect("writing to memory does not fail");
        String::from_utf8(text).expect("JSON is UTF-8")
    }
}

impl Model {
    /// Compiles `definition`. Where states follow from rules and are more than `limits` allow, the model is searched lazily.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub fn compile(
        definition: &Definition,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Self, Interrupted> {
        Arc::clone(&definition.0).compile(limits, interrupt)
    }
}

/// How many values are read between two looks at the interrupt: less than a millisecond.
const POLL_EVERY: u64 = 4096;

fn of_outline(outline: Outline, limits: Limits, meter: &mut Meter<'_>) -> Result<Definition, ReadError> {
    let line = outline.line;
    let place = Place { value: &outline.root, path: line.map_or(Path::Root, Path::Line) };
    let mut faults = Faults::default();
    let dynamics = read_dynamics(&place, (outline.states, outline.transitions), limits, meter, &mut faults)?;
    faults.append(outline.faults);
    Ok(Definition(faults.check(dynamics)?))
}

fn read_dynamics(
    place: &Place<'_, '_>,
    (states, transitions): (Option<RawStates>, Option<RawTransitions>),
    limits: Limits,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Arc<dyn Dynamics>>, Interrupted> {
    let Some(model) = place.object(&["attributes", "actions", "dynamics"], faults) else { return Ok(None) };
    let dynamics = model.required("dynamics", faults);
    let kind = dynamics.and_then(|dynamics| dynamics.value.get("kind")).and_then(serde_json::Value::as_str);
    if let Some((dynamics, read)) = dynamics.zip(kind.and_then(kinds::reader)) {
        let mut description = Description { model: &model, dynamics, states, transitions };
        return read(&mut description, limits, meter, faults);
    }
    // What the rest is to be is not known, but what it cannot be in any case is.
    model.optional("attributes").map(|place| Schema::read(&place, faults));
    model.optional("actions").map(|place| ReadActions::read(&place, 0.0, faults));
    if let Some(dynamics) = dynamics.and_then(|dynamics| dynamics.open_object(faults))
        && let Some(kind) = dynamics.required("kind", faults)
    {
        kind.mismatch::<()>(&format!("one of {}", kinds::names()), faults);
    }
    Ok(None)
}

/// A model, as it is written in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = ModelDefinition))]
pub struct DefinitionDocument {
    /// The attributes of a state, in order: 1 to 256. Required with `table` dynamics; implied by `wumpus` dynamics
    /// and then left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attributes: Option<Vec<AttributeDocument>>,
    /// The actions of this body. Required with `table` dynamics; left out with `wumpus` dynamics: all six.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actions: Option<Vec<ActionDocument>>,
    /// Which states there are, and how actions lead from one to another.
    pub dynamics: DynamicsDocument,
}

#[cfg(test)]
mod tests {
    use proptest::num::f64::{NEGATIVE, NORMAL, POSITIVE, SUBNORMAL, ZERO};
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::attribute::MAX_COST;
    use crate::document;
    use crate::interrupt::{Signal, Uninterrupted};
    use crate::model::Model;

    fn read(text: &str) -> Definition {
        let document = document::parse(text.as_bytes()).unwrap();
        Definition::read(&document, Limits::DEFAULT, &mut Uninterrupted).unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn a_definition_that_is_read_again_is_the_same_to_the_last_bit(
            weight in POSITIVE | NORMAL | SUBNORMAL | ZERO,
            scale in POSITIVE | NORMAL | SUBNORMAL,
            cost in 0.0..=MAX_COST,
            x in POSITIVE | NEGATIVE | NORMAL | SUBNORMAL | ZERO,
        ) {
            let model = json!({
                "attributes": [{"name": "x", "kind": "number", "scale": scale, "weight": weight}],
                "actions": [{"name": "a", "cost": cost}],
                "dynamics": {"kind": "table", "states": [[x]], "transitions": []},
            });
            let first = read(&model.to_string()).text();
            let again = read(&first).text();
            prop_assert_eq!(&first, &again);
            let read: DefinitionDocument = serde_json::from_str(&first).unwrap();
            let attributes = read.attributes.unwrap();
            prop_assert_eq!((attributes[0].weight, attributes[0].scale), (Some(weight), Some(scale)));
            prop_assert_eq!(read.actions.unwrap()[0].cost, Some(cost));
        }
    }

    /// The pointers of the faults of `model`, in the order of their text.
    fn faults_of(model: &serde_json::Value) -> Vec<String> {
        let read = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted);
        let Err(CompileError::Faults(faults)) = read else { panic!("{model} has faults") };
        let mut pointers: Vec<_> = faults.listed().iter().map(|fault| fault.pointer.clone()).collect();
        pointers.sort_unstable();
        pointers
    }

    fn two_states() -> serde_json::Value {
        json!({
            "attributes": [{"name": "x", "kind": "number"}],
            "actions": [{"name": "a"}, {"name": "b"}],
            "dynamics": {"kind": "table", "states": [[0], [1]], "transitions": [[0, "a", 1]]},
        })
    }

    #[test]
    fn without_known_dynamics_attributes_and_actions_are_checked_all_the_same() {
        let mut model = two_states();
        model["attributes"][0]["scale"] = json!(0);
        model["actions"][1]["cost"] = json!(-1);
        for (dynamics, pointer) in
            [(json!(null), "/dynamics"), (json!({"kind": "maze"}), "/dynamics/kind"), (json!({}), "/dynamics/kind")]
        {
            model["dynamics"] = dynamics;
            assert_eq!(faults_of(&model), ["/actions/1/cost", "/attributes/0/scale", pointer]);
        }
    }

    #[test]
    fn without_states_the_rest_of_a_table_is_checked_all_the_same() {
        let mut model = two_states();
        model["dynamics"] = json!({
            "kind": "table", "states": [], "transitions": [[0, "c", 1], [0]], "start": "here", "unsafe": [-1],
        });
        assert_eq!(
            faults_of(&model),
            [
                "/dynamics/start",
                "/dynamics/states",
                "/dynamics/transitions/0/1",
                "/dynamics/transitions/1",
                "/dynamics/unsafe/0"
            ]
        );
    }

    #[test]
    fn a_cyclic_attribute_with_a_period_and_labels_has_one_fault_whatever_these_are() {
        let mut model = two_states();
        model["attributes"] = json!([{"name": "x", "kind": "cyclic", "period": 0, "labels": []}]);
        assert_eq!(faults_of(&model), ["/attributes/0"]);
    }

    #[test]
    fn a_faulty_action_keeps_its_index_and_its_name() {
        let mut model = two_states();
        model["actions"] = json!([{"name": "a", "cost": -1}, {"name": "b"}, {"name": "a"}]);
        model["dynamics"]["transitions"] = json!([[0, "a", 1], [0, 1, 1], [1, 2, 0], [1, 3, 0], [1, "c", 0]]);
        let expected = ["/actions/0/cost", "/actions/2/name", "/dynamics/transitions/3/1", "/dynamics/transitions/4/1"];
        assert_eq!(faults_of(&model), expected);
        // What an action without a name is called is not known.
        model["actions"] = json!([{"name": 7}, {"name": "b"}, {"cost": 1}, {"name": "b"}]);
        model["dynamics"]["transitions"] = json!([[0, "c", 1]]);
        assert_eq!(faults_of(&model), ["/actions/0/name", "/actions/2/name", "/actions/3/name"]);
    }

    #[test]
    fn unsafe_states_are_a_set() {
        let text = |listed: serde_json::Value| {
            let mut model = two_states();
            model["dynamics"]["states"] = json!([[0], [1], [2], [3]]);
            model["dynamics"]["unsafe"] = listed;
            read(&model.to_string()).text()
        };
        assert_eq!(text(json!([3, 1, 3])), text(json!([1, 3])));
    }

    #[test]
    fn what_a_fault_says_is_short_however_long_the_document() {
        let long = "x".repeat(100_000);
        let actions: Vec<_> = (0..4000).map(|n| json!({"name": format!("action {n}")})).collect();
        let mut model = two_states();
        model["actions"] = actions.into();
        model["dynamics"]["transitions"] = json!([[0, long, 1], [0, "fly", 1]]);
        model["attributes"] = json!([{"name": long, "kind": long}, {"name": long, "kind": "number"}]);
        let read = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted);
        let Err(CompileError::Faults(faults)) = read else { panic!("the model has faults") };
        for fault in faults.listed() {
            assert!(fault.detail.len() < 500, "{fault:?}");
        }
        let cave = json!({"dynamics": {"kind": "wumpus", "width": 2, "height": 2}, "actions": [{"name": long}]});
        let read = Definition::read(&cave, Limits::DEFAULT, &mut Uninterrupted);
        let Err(CompileError::Faults(faults)) = read else { panic!("the cave has faults") };
        assert!(faults.listed().iter().all(|fault| fault.detail.len() < 500));
    }

    #[test]
    fn reading_asks_again_and_again_whether_to_go_on() {
        let many: Vec<_> = (0..20_000).map(|n| json!([n])).collect();
        let edges: Vec<_> = (0..20_000).map(|n| json!([n, "a", 0])).collect();
        let mut states = two_states();
        states["dynamics"]["states"] = many.into();
        let mut transitions = states.clone();
        transitions["dynamics"]["transitions"] = edges.into();
        let pits: Vec<_> = (0..20_000).map(|n| json!([n % 200 + 1, n / 200])).collect();
        let cave = json!({"dynamics": {"kind": "wumpus", "width": 300, "height": 300, "pits": pits}});
        for (model, n_polls_least) in [(states, 5), (transitions, 9), (cave, 4)] {
            let mut n_polls = 0;
            let mut count = || {
                n_polls += 1;
                Signal::Continue
            };
            assert!(Definition::read(&model, Limits::DEFAULT, &mut count).is_ok());
            assert!(n_polls >= n_polls_least, "{n_polls}");
            let mut n_left = n_polls_least;
            let mut cancel = || {
                n_left -= 1;
                if n_left == 0 { Signal::Cancel } else { Signal::Continue }
            };
            let cancelled = Definition::read(&model, Limits::DEFAULT, &mut cancel);
            assert!(matches!(cancelled, Err(CompileError::Cancelled(_))));
        }
    }

    /// A line of states in a table, of which each leads on to the next two, and the first ones; the attribute tells all of them apart.
    fn line(n_states: usize) -> serde_json::Value {
        let edges = (2..n_states).flat_map(|n| [json!([n - 2, "a", n - 1]), json!([n - 2, "b", n])]);
        json!({
            "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "a"}, {"name": "b"}],
            "dynamics": {
                "kind": "table", "states": (0..n_states).map(|n| [n]).collect::<Vec<_>>(), "transitions": edges.collect::<Vec<_>>(),
            },
        })
    }

    #[test]
    fn a_text_that_is_not_read_in_time_is_no_model() {
        let model = two_states();
        let read = Definition::read(&model, Limits::DEFAULT, &mut || Signal::Finish);
        assert!(matches!(read, Err(CompileError::OutOfTime)), "{read:?}");
        let text = model.to_string();
        let read = Definition::parse(text.as_bytes(), Format::Json, Limits::DEFAULT, &mut || Signal::Finish);
        assert!(matches!(read, Err(ReadError::OutOfTime)), "{read:?}");
    }

    #[test]
    fn a_table_that_would_take_more_memory_than_it_may_is_refused_while_it_is_read() {
        let text = line(2000).to_string();
        let read = |max_bytes| {
            let limits = Limits { max_bytes, ..Limits::NONE };
            Definition::parse(text.as_bytes(), Format::Json, limits, &mut Uninterrupted)
        };
        let definition = read(usize::MAX).unwrap();
        let model = Model::compile(&definition, Limits::NONE, &mut Uninterrupted).unwrap();
        let n_bytes = model.size_bytes();
        assert!(read(6 * n_bytes).is_ok());
        // Whether its states are too many, or its transitions.
        for max_bytes in [n_bytes / 8, n_bytes] {
            let error = read(max_bytes).unwrap_err();
            assert!(matches!(&error, ReadError::TooLarge(detail) if detail.contains("ETUDE_MAX_MEMORY")), "{error}");
        }
        let limits = Limits { max_bytes: n_bytes, ..Limits::NONE };
        let read = Definition::read(&line(2000), limits, &mut Uninterrupted);
        assert!(matches!(read, Err(CompileError::Faults(_))), "{read:?}");
    }
}
