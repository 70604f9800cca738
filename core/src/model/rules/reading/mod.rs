//! Reading rules, with all their faults.

mod declared;
mod raw;
mod texts;

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, OnceLock};

use declared::ReadAttributes;
use raw::{RawRule, read_rules};
use texts::{Texts, Wanted};

use super::document::{OutcomeDocument, RuleDocument, RulesDocument, StatesDocument};
use super::{Effect, Placed, Rule, Rules, State};
use crate::attribute::Scalar;
use crate::document::{Faults, Object, Path, Place, Range, normal};
use crate::expression::Datum;
use crate::interrupt::{Interrupted, Meter};
use crate::model::action::ReadActions;
use crate::model::dynamics::{Description, Dynamics};
use crate::model::{Action, ActionReference, Limits};

/// Cost of an action that names none.
const DEFAULT_ACTION_COST: f64 = 1.0;
/// Most constants, with all items of lists.
const MAX_CONSTANTS: usize = 65_536;
/// Most nodes that all expressions together come to in one state: about ten milliseconds.
const MAX_WORK: u64 = 1 << 20;

/// Reads a model whose states follow from rules. If attributes or actions have faults, what does not depend on them is still checked.
pub(in crate::model) fn read(
    description: &mut Description<'_, '_>,
    _: Limits,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Arc<dyn Dynamics>>, Interrupted> {
    let (model, dynamics) = (description.model, description.dynamics);
    let n_before = faults.count();
    let attributes = model.required("attributes", faults);
    let attributes = attributes.and_then(|place| ReadAttributes::read(&place, faults));
    let actions = model.required("actions", faults);
    let actions = actions.and_then(|place| ReadActions::read(&place, DEFAULT_ACTION_COST, faults));
    let Some(object) = dynamics.object(&["kind", "constants", "start", "rules", "unsafe"], faults) else {
        return Ok(None);
    };
    let constants = read_constants(&object, attributes.as_ref(), faults);
    let mut texts = Texts::default();
    let raw = object.required("rules", faults);
    let raw = raw.and_then(|place| read_rules(&place, attributes.as_ref(), actions.as_ref(), &mut texts, faults));
    let deadly = object.optional("unsafe").and_then(|place| texts.add(&place, None, Wanted::Flag, faults));
    let start = object.required("start", faults);
    let start = start.zip(attributes.as_ref()).and_then(|(place, attributes)| attributes.read_states(&place, faults));
    let placed = match (&attributes, &constants) {
        (Some(attributes), Some(constants)) => texts.read(attributes, constants, meter, faults)?,
        _ => return Ok(None),
    };
    let is_faultless = faults.count() == n_before;
    let rules = || {
        let (attributes, actions) = (attributes?, actions?.complete()?);
        let (start, raw) = (start?, raw?);
        let mut placed = placed;
        let mut take = |text: Option<usize>| text.and_then(|text| placed[text].take());
        let document = document_of(&object, &attributes, &actions, &start, &raw);
        let deadly = take(deadly);
        let mut by_action: Vec<Vec<Rule>> = actions.iter().map(|_| Vec::new()).collect();
        for rule in raw {
            let when = take(rule.when);
            let then = |then: Vec<(usize, usize)>, take: &mut dyn FnMut(Option<usize>) -> Option<Placed>| {
                then.into_iter().filter_map(|(at, text)| Some((at, take(Some(text))?))).collect()
            };
            let effects = rule
                .effects
                .into_iter()
                .map(|(probability, thens)| Effect { probability, then: then(thens, &mut take) });
            let effects = effects.collect();
            by_action[usize::from(rule.action?)].push(Rule { when, effects, cost: take(rule.cost) });
        }
        let (schema, domains) = attributes.complete()?;
        Some(Rules { schema, actions, domains, by_action, deadly, start, document, work: 0, plans: OnceLock::new() })
    };
    let Some(mut rules) = rules().filter(|_| is_faultless) else { return Ok(None) };
    rules.work = rules.expressions().fold(1, |sum, placed| placed.expression.work().saturating_add(sum));
    if rules.work > MAX_WORK {
        let detail = format!(
            "the rules take too long: about {} steps in one state, and at most {MAX_WORK} are allowed",
            rules.work
        );
        faults.note_at(&Path::Member(&object.path, "rules"), detail);
        return Ok(None);
    }
    if let Some(deadly) = &rules.deadly {
        for (n, state) in rules.start.iter().enumerate() {
            if deadly.flag(&rules.variables(state)).unwrap_or(true) {
                let path = Path::Member(&object.path, "start");
                let detail = format!("this state is unsafe, or cannot be told to be safe (start {n})");
                faults.note_at(&path, detail);
            }
        }
    }
    Ok(Some(Arc::new(rules) as Arc<dyn Dynamics>))
}

fn read_constants(
    object: &Object<'_, '_>,
    attributes: Option<&ReadAttributes>,
    faults: &mut Faults,
) -> Option<HashMap<String, Datum<'static>>> {
    let Some(place) = object.optional("constants") else { return Some(HashMap::new()) };
    let members = place.open_object(faults)?;
    let mut n_items = 0;
    let mut constants = HashMap::new();
    for (name, place) in members.iter() {
        if attributes.is_some_and(|attributes| attributes.position(name).is_some()) {
            faults.note(&place, "an attribute is called so already");
        }
        if let Some(constant) = read_constant(&place, &mut n_items, faults) {
            constants.insert(name.to_owned(), constant);
        }
    }
    if n_items > MAX_CONSTANTS {
        faults.note(&place, format!("expected at most {MAX_CONSTANTS} values in all, found {n_items}"));
    }
    // With all names, so that what uses them is not told to be at fault.
    for name in members.members.keys() {
        constants.entry(name.clone()).or_insert(Datum::Null);
    }
    Some(constants)
}

fn read_constant(place: &Place<'_, '_>, n_items: &mut usize, faults: &mut Faults) -> Option<Datum<'static>> {
    use serde_json::Value as Json;
    *n_items += 1;
    match place.value {
        Json::Bool(flag) => Some(Datum::Bool(*flag)),
        Json::String(text) => Some(Datum::text(&normal(text))),
        Json::Number(number) => match number.as_i64() {
            Some(number) => Some(Datum::Int(number)),
            None => place.number(Range::Finite, faults).map(Datum::Double),
        },
        Json::Array(items) => {
            let read = |(n, item)| read_constant(&place.item(n, item), n_items, faults);
            let items: Vec<Option<Datum<'static>>> = items.iter().enumerate().map(read).collect();
            items.into_iter().collect::<Option<_>>().map(Datum::list)
        }
        Json::Null | Json::Object(_) => place.mismatch("a number, a string, a boolean, or a list of these", faults),
    }
}

/// The document in canonical form, of what was read without faults.
fn document_of(
    object: &Object<'_, '_>,
    attributes: &ReadAttributes,
    actions: &[Action],
    start: &[State],
    raw: &[RawRule],
) -> RulesDocument {
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let texts = |value: Option<&serde_json::Value>| -> BTreeMap<String, String> {
        let members = value.and_then(serde_json::Value::as_object).into_iter().flatten();
        members.map(|(name, value)| (normal(name).into_owned(), text(value))).collect()
    };
    let state = |row: &State| -> BTreeMap<String, Scalar> {
        let written = attributes
            .iter()
            .zip(row)
            .map(|((attribute, domain), index)| (attribute.name.clone(), attribute.write_value(&domain.value(*index))));
        written.collect()
    };
    let start = match start {
        [one] => StatesDocument::One(state(one)),
        several => StatesDocument::Several(several.iter().map(state).collect()),
    };
    let items = object.optional("rules").and_then(|place| place.value.as_array()).into_iter().flatten();
    let rules = items.zip(raw).map(|(item, raw)| {
        let member = |name: &str| item.get(name).filter(|value| !value.is_null());
        let action = raw.action.map_or(String::new(), |action| actions[usize::from(action)].name.to_string());
        let outcomes = member("outcomes").and_then(serde_json::Value::as_array).map(|items| {
            let outcomes = items.iter().zip(&raw.effects);
            outcomes
                .map(|(item, (probability, _))| OutcomeDocument {
                    probability: *probability,
                    then: texts(item.get("then")),
                })
                .collect()
        });
        RuleDocument {
            action: ActionReference::Name(action),
            when: member("when").map(text),
            then: member("then").map(|then| texts(Some(then))),
            outcomes,
            cost: member("cost").map(text),
        }
    });
    let constants = object.optional("constants").and_then(|place| place.value.as_object()).cloned();
    RulesDocument {
        constants: constants.unwrap_or_default(),
        start,
        rules: rules.collect(),
        unsafe_when: object.optional("unsafe").map(|place| text(place.value)),
    }
}
