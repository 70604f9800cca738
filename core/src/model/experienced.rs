//! What was experienced with a registered model, and the model that it makes.

use super::{Definition, Tally};
use crate::interrupt::{Interrupt, Interrupted};

impl Tally {
    /// Nothing experienced yet; `None` if `definition` is not one of a model of experience.
    #[must_use]
    pub fn new(definition: &Definition) -> Option<Self> {
        definition.shared_dynamics().map(Self::of)
    }

    /// The model that was experienced: a table. `None` if there is no state to start in.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub fn definition(&self, interrupt: &mut dyn Interrupt) -> Result<Option<Definition>, Interrupted> {
        Ok(self.table(interrupt)?.map(Definition::of))
    }
}
