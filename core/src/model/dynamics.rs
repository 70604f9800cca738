//! The seam between a model and where it comes from: what every kind of dynamics is to the rest.
//!
//! A kind of dynamics is one folder beside this file. It has a type that implements [`Dynamics`], a function [`Read`] that makes one from
//! JSON, and an entry in `kinds`. Dynamics that list their states make a [`Model`] of them (`table`); those whose states follow from rules
//! implement [`Implicit`](super::Implicit), by which [`Model::explore`] makes one, listed or searched lazily (`wumpus`). Nothing outside
//! the folder and `kinds` knows the kind.

use std::any::Any;
use std::fmt::Debug;
use std::io::{self, Write as _};
use std::sync::Arc;

use serde::Serialize;

use super::reading::{RawStates, RawTransitions};
use super::{Action, ActionDocument, CompileError, Limits, Model};
use crate::attribute::{AttributeDocument, Schema};
use crate::document::{Faults, Object, Place};
use crate::interrupt::{Interrupt, Interrupted, Meter};

/// Which states a body may be in, and how its actions lead from one to another: checked, with defaults filled in, not yet compiled.
pub(crate) trait Dynamics: Any + Debug + Send + Sync {
    /// The attributes of the states.
    fn schema(&self) -> &Schema;

    /// About how much memory [`Self::compile`] takes at most, in bytes: for as many states as there can be within `limits`.
    fn compiling_bytes(&self, limits: Limits) -> u64;

    /// Makes the model that searches run on.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue; [`CompileError::Faults`] with what shows only where states are found: that
    /// something leads out of what there is.
    fn compile(self: Arc<Self>, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, CompileError>;

    /// Writes the definition as JSON in canonical form, with [`write_definition`].
    ///
    /// # Errors
    ///
    /// If `writer` failed.
    fn write(&self, writer: &mut dyn io::Write) -> io::Result<()>;
}

/// Reads dynamics of one kind. `None`: it noted at least one fault.
pub(super) type Read =
    fn(&mut Description<'_, '_>, Limits, &mut Meter<'_>, &mut Faults) -> Result<Option<Arc<dyn Dynamics>>, Interrupted>;

/// The document that dynamics are read from; what reads its lists takes them out.
pub(super) struct Description<'v, 'p> {
    /// The whole model, whose members are `attributes`, `actions` and `dynamics`.
    pub(super) model: &'p Object<'v, 'p>,
    /// The member `dynamics`.
    pub(super) dynamics: Place<'v, 'p>,
    /// What `dynamics` has under `states`; there, an empty array is left.
    pub(super) states: Option<RawStates>,
    /// What `dynamics` has under `transitions`, likewise.
    pub(super) transitions: Option<RawTransitions>,
}

/// Writes a definition as JSON in canonical form. `attributes` are left out where the dynamics imply them; `dynamics` begin with
/// their `kind`.
pub(super) fn write_definition(
    writer: &mut dyn io::Write,
    attributes: Option<Vec<AttributeDocument>>,
    actions: &[Action],
    dynamics: &impl Serialize,
) -> io::Result<()> {
    #[derive(Serialize)]
    struct Document<'d, D> {
        #[serde(skip_serializing_if = "Option::is_none")]
        attributes: Option<Vec<AttributeDocument>>,
        actions: Vec<ActionDocument>,
        dynamics: &'d D,
    }
    let actions = actions.iter().map(ActionDocument::from).collect();
    // A token at a time would be a virtual call at a time.
    let mut writer = io::BufWriter::with_capacity(1 << 16, writer);
    serde_json::to_writer(&mut writer, &Document { attributes, actions, dynamics })?;
    writer.flush()
}
