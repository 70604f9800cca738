//! Requests to open a session, as they are read: first what is named, then, with the model, the rest.

use std::num::{NonZeroU32, NonZeroU64};
use std::sync::Arc;

use super::learners::LearnerState;
use super::requests::{Names, base_weights};
use etude_core::attribute::Weights;
use etude_core::document::{Faults, Object};
use etude_core::mapping::{Conditions, Demonstration, Mapper, Options, Perception};

/// Lookahead of a session that names none.
const DEFAULT_LOOKAHEAD: u32 = 8;

/// Reads what can be read of a request to open a session before its model is there: what it names, and whether it explores. Gives the
/// names if the model's could be read. Faults may have been found either way.
pub(super) fn read_names(object: &Object<'_, '_>, faults: &mut Faults) -> Option<(Names, bool)> {
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
    let learner = learner.flatten().map(str::to_owned);
    let names =
        Names { model: model?.to_owned(), learner, deadline: None, is_stored: true, own_faults: Faults::default() };
    Some((names, explores))
}

/// Reads the options that do not depend on the model.
pub(super) fn read_general(object: &Object<'_, '_>, faults: &mut Faults) -> Option<Options> {
    // Where the lookahead is left out, it is not `null`: all observations.
    let is_left_out = !object.members.contains_key("lookahead");
    let lookahead = is_left_out.then(|| NonZeroU32::new(DEFAULT_LOOKAHEAD)).flatten();
    Options::read_general(object, &Options { lookahead, ..Options::default() }, faults)
}

/// How long a step may wait at most, if anything is said of that.
pub(crate) fn read_lookahead_ms(object: &Object<'_, '_>, faults: &mut Faults) -> Option<NonZeroU64> {
    /// As large as a number of the store.
    const MAX_MS: u64 = i64::MAX as u64;
    object.optional("lookahead_ms").and_then(|place| place.integer(1, MAX_MS, faults)).and_then(NonZeroU64::new)
}

/// What a session is opened with.
pub(super) struct SessionOptions {
    pub(super) weights: Weights,
    pub(super) conditions: Conditions,
    pub(super) lookahead: Option<NonZeroU32>,
    pub(super) perception: Option<Arc<Perception>>,
    /// In milliseconds.
    pub(super) lookahead_ms: Option<NonZeroU64>,
}

/// Reads what needs the model, after the `general` options; the session's window may take about `max_bytes`.
pub(super) fn read(
    mapper: &Mapper,
    learner: Option<&LearnerState>,
    general: Option<Options>,
    object: &Object<'_, '_>,
    max_bytes: usize,
    faults: &mut Faults,
) -> Option<SessionOptions> {
    let model = mapper.model();
    // What is wrong with it was noted if it is none.
    let lookahead_ms = read_lookahead_ms(object, faults);
    Options::check_model(model, object, faults);
    let weights = base_weights(model, learner, faults);
    // Without the general options, a fault was noted.
    let options = general.unwrap_or_default().read_of_model(object, model, faults)?;
    options.check_has_lookahead(model, object, faults);
    if object.optional("lookahead").is_some() {
        options.check_lookahead(model, Demonstration::MAX_OBSERVATIONS, max_bytes, object, faults);
    }
    Some(SessionOptions {
        weights: options.weights_over(weights?),
        conditions: options.conditions(),
        lookahead: options.lookahead,
        perception: options.observe.clone(),
        lookahead_ms,
    })
}
