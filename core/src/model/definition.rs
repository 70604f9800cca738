//! What a client registers as a model.

use std::any::Any;
use std::cell::RefCell;
use std::io::{self, BufRead};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::action::ReadActions;
use super::dynamics::{Description, Dynamics};
use super::kinds::{self, DynamicsDocument};
use super::reading::{Interruptible, RawStates, RawTransitions, Reader, Skeleton};
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
        let skeleton = Reader::new(limits, &mut meter).read_value(document);
        let definition = skeleton.and_then(|skeleton| of_skeleton(skeleton, limits, &mut meter));
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
        let skeleton = Reader::new(limits, &mut meter).read_text(text, format)?;
        of_skeleton(skeleton, limits, &mut meter)
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
        let skeleton = Reader::new(limits, &mut meter).read_from(reader, format)?;
        of_skeleton(skeleton, limits, &mut meter)
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

    /// As [`Self::dynamics`], shared.
    pub(super) fn shared_dynamics<D: Any + Send + Sync>(&self) -> Option<Arc<D>> {
        let dynamics: Arc<dyn Any + Send + Sync> = self.0.clone();
        dynamics.downcast().ok()
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
    /// What `interrupt` said, if that was not to continue. [`CompileError::Faults`], where states follow from expressions, with those that
    /// have no value, or none that their attribute may have, in a state that the body comes to.
    pub fn compile(
        definition: &Definition,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Self, CompileError> {
        Arc::clone(&definition.0).compile(limits, interrupt)
    }
}

/// How many values are read between two looks at the interrupt: less than a millisecond.
const POLL_EVERY: u64 = 4096;

fn of_skeleton(skeleton: Skeleton, limits: Limits, meter: &mut Meter<'_>) -> Result<Definition, ReadError> {
    let line = skeleton.line;
    let place = Place { value: &skeleton.root, path: line.map_or(Path::Root, Path::Line) };
    let mut faults = Faults::default();
    let dynamics = read_dynamics(&place, (skeleton.states, skeleton.transitions), limits, meter, &mut faults)?;
    faults.append(skeleton.faults);
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
    /// The attributes of a state, in order: 1 to 256. Required with `table` and `experience` dynamics, and with `rules`, where they have `values`; implied
    /// by `wumpus` dynamics and then left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attributes: Option<Vec<AttributeDocument>>,
    /// The actions of this body. Required with `table` and `experience` dynamics and with `rules`; left out with `wumpus` dynamics: all six.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actions: Option<Vec<ActionDocument>>,
    /// Which states there are, and how actions lead from one to another.
    pub dynamics: DynamicsDocument,
}

#[cfg(test)]
mod tests;
