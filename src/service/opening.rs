//! Requests to open a session, as they are read: first what is named, then, with the model at hand, the rest.

use std::num::NonZeroU32;

use super::learners::Ready;
use super::policies::{Envelope, base_weights};
use etude_core::attribute::Weights;
use etude_core::document::{Faults, Object, Path};
use etude_core::mapping::{Conditions, Demonstration, Mapper, Request, read_lookahead};
use etude_core::model::Origin;

/// Lookahead of a session that names none.
const DEFAULT_LOOKAHEAD: u32 = 8;

/// What can be read of a request to open a session before its model is at hand. What has a fault is left out.
pub(super) struct Names {
    pub(super) envelope: Envelope,
    pub(super) explores: bool,
    pub(super) lookahead: Option<NonZeroU32>,
}

impl Names {
    /// Gives the names if the model's could be read. Faults may have been found either way.
    pub(super) fn read(object: &Object<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let model = object.required("model", faults).and_then(|place| place.string(faults));
        let learner = object.optional("learner").map(|place| place.string(faults));
        let explores = object.optional("explore").and_then(|place| {
            let explores = place.boolean(faults);
            if explores == Some(true) && learner.is_none() {
                faults.note(&place, "exploring needs a learner");
            }
            explores
        });
        let explores = explores == Some(true);
        if let (true, Some(place)) = (explores, object.optional("weights"))
            && place.value.as_object().is_some_and(|weights| !weights.is_empty())
        {
            faults.note(&place, "an exploring session draws its weights");
        }
        let lookahead = match (object.optional("lookahead"), object.members.contains_key("lookahead")) {
            (Some(place), _) => read_lookahead(&place, faults),
            (None, true) => None,
            (None, false) => NonZeroU32::new(DEFAULT_LOOKAHEAD),
        };
        let learner = learner.flatten().map(str::to_owned);
        let envelope = Envelope { model: model?.to_owned(), learner, deadline: None, over_limits: Faults::default() };
        Some(Self { envelope, explores, lookahead })
    }
}

/// What a session is opened with.
pub(super) struct Opening {
    pub(super) weights: Weights,
    pub(super) start: Option<u32>,
}

impl Opening {
    /// Reads what needs the model; the session's window may take about `max_bytes`.
    pub(super) fn read(
        mapper: &Mapper,
        learner: Option<&Ready>,
        lookahead: Option<NonZeroU32>,
        object: &Object<'_, '_>,
        max_bytes: usize,
        faults: &mut Faults,
    ) -> Option<Self> {
        let model = mapper.model();
        if model.is_lazy() {
            let detail = "this world is searched lazily, which needs the whole demonstration: ask for a policy instead";
            faults.note_at(&Path::Member(&Path::Root, "model"), detail);
        }
        let base = base_weights(model, learner, faults);
        let conditions = Conditions::read(model, object, faults);
        if let (Some(lookahead), Some(place)) = (lookahead, object.optional("lookahead")) {
            Request::check_window(model, lookahead, Demonstration::MAX_OBSERVATIONS, max_bytes, &place, faults);
        }
        let (base, conditions) = base.zip(conditions)?;
        Some(Self { weights: conditions.weights_over(base), start: conditions.start.and_then(Origin::state) })
    }
}
