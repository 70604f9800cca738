//! Which models there are policies for.

use super::Options;
use crate::document::{Faults, Object, Path};
use crate::model::Model;

impl Options {
    /// Notes that searches do not know what to do with `model`, if that is so.
    pub fn check_model(model: &Model, object: &Object<'_, '_>, faults: &mut Faults) {
        if model.n_stochastic() > 0 {
            let detail = format!(
                "this model is stochastic (for {} pairs of a state and an action there are several outcomes), and there are no policies \
                 for such models yet",
                model.n_stochastic()
            );
            faults.note_at(&Path::Member(&object.path, "model"), detail);
        }
    }
}
