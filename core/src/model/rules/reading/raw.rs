//! Rules whose expressions are not read yet.

use super::declared::ReadAttributes;
use super::texts::{Texts, Wanted};
use crate::document::{Faults, Object, Path, Place, Range, TWICE};
use crate::model::ActionIdx;
use crate::model::action::ReadActions;

/// Most rules.
const MAX_RULES: usize = 10_000;
/// Most outcomes of a rule.
const MAX_OUTCOMES: usize = 1000;
/// How far from 1 the probabilities of a rule may sum.
const SUM_TOLERANCE: f64 = 1e-9;

/// A rule whose expressions are not read yet: they are told by their numbers.
pub(super) struct RawRule {
    pub(super) action: Option<ActionIdx>,
    pub(super) when: Option<usize>,
    pub(super) effects: Vec<(f64, Vec<(usize, usize)>)>,
    pub(super) cost: Option<usize>,
}

/// Reads rules, as far as they have no faults.
pub(super) fn read_rules<'v>(
    place: &Place<'v, '_>,
    attributes: Option<&ReadAttributes>,
    actions: Option<&ReadActions<'_>>,
    texts: &mut Texts<'v>,
    faults: &mut Faults,
) -> Option<Vec<RawRule>> {
    let items = place.array(faults)?;
    if items.is_empty() || items.len() > MAX_RULES {
        return place.mismatch(&format!("1 to {MAX_RULES} rules"), faults);
    }
    let rules: Vec<Option<RawRule>> = items
        .iter()
        .enumerate()
        .map(|(n, item)| {
            let place = place.item(n, item);
            let object = place.object(&["action", "when", "then", "outcomes", "cost"], faults)?;
            let action = object.required("action", faults);
            let action = action.zip(actions).and_then(|(place, actions)| actions.read_reference(&place, faults));
            let when = object.optional("when").and_then(|place| texts.add(&place, Some(n), Wanted::Flag, faults));
            let effects = read_effects(&object, n, attributes, texts, faults);
            let cost = object.optional("cost").and_then(|place| texts.add(&place, Some(n), Wanted::Cost, faults));
            Some(RawRule { action, when, effects, cost })
        })
        .collect();
    rules.into_iter().collect()
}

fn read_effects<'v>(
    object: &Object<'v, '_>,
    rule: usize,
    attributes: Option<&ReadAttributes>,
    texts: &mut Texts<'v>,
    faults: &mut Faults,
) -> Vec<(f64, Vec<(usize, usize)>)> {
    let then = object.optional("then");
    let Some(outcomes) = object.optional("outcomes") else {
        let then = then.map(|place| read_then(&place, rule, attributes, texts, faults));
        return vec![(1.0, then.unwrap_or_default())];
    };
    if let Some(then) = then {
        faults.note(&then, "a rule has either `then` or `outcomes`");
    }
    let Some(items) = outcomes.array(faults) else { return Vec::new() };
    if items.is_empty() || items.len() > MAX_OUTCOMES {
        return outcomes.mismatch(&format!("1 to {MAX_OUTCOMES} outcomes"), faults).unwrap_or_default();
    }
    let mut effects = Vec::with_capacity(items.len());
    let mut is_known = true;
    for (n, item) in items.iter().enumerate() {
        let place = outcomes.item(n, item);
        let Some(object) = place.object(&["probability", "then"], faults) else {
            is_known = false;
            continue;
        };
        let probability = object.required("probability", faults).and_then(|place| {
            let probability = place.number(Range::UpTo(1.0), faults)?;
            if probability == 0.0 {
                return place.mismatch("a number above 0, at most 1", faults);
            }
            Some(probability)
        });
        is_known &= probability.is_some();
        let then = object.optional("then").map(|place| read_then(&place, rule, attributes, texts, faults));
        effects.push((probability.unwrap_or(0.0), then.unwrap_or_default()));
    }
    let sum: f64 = effects.iter().map(|(probability, _)| probability).sum();
    if is_known && (sum - 1.0).abs() > SUM_TOLERANCE {
        faults.note(&outcomes, format!("the probabilities of a rule sum to 1, and these sum to {sum}"));
    }
    effects
}

/// The attributes that get another value, by position, ascending, and the numbers of the expressions that give it.
fn read_then<'v>(
    place: &Place<'v, '_>,
    rule: usize,
    attributes: Option<&ReadAttributes>,
    texts: &mut Texts<'v>,
    faults: &mut Faults,
) -> Vec<(usize, usize)> {
    let Some(object) = place.open_object(faults) else { return Vec::new() };
    let mut then: Vec<(usize, usize)> = Vec::new();
    for (name, value) in object.members {
        let place = Place { value, path: Path::Member(&object.path, name) };
        let Some(attributes) = attributes else { continue };
        match attributes.position(name) {
            None => attributes.note_unknown(name, &place, faults),
            Some(at) if then.iter().any(|(known, _)| *known == at) => faults.note(&place, TWICE),
            Some(at) => {
                let text = texts.add(&place, Some(rule), Wanted::Value(at), faults);
                then.extend(text.map(|text| (at, text)));
            }
        }
    }
    then.sort_unstable();
    then
}
