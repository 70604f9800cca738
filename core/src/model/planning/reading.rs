//! Planning tasks as they are written in JSON.

use std::collections::HashMap;
use std::sync::Arc;

use serde::ser::SerializeSeq;
use serde::{Deserialize, Serialize, Serializer};

use super::{Planning, Rule, Values};
use crate::attribute::{Attribute, ByAttribute, Scalar, Schema, Value};
use crate::document::{Faults, Path, Place};
use crate::interrupt::{Interrupted, Meter};
use crate::model::action::ReadActions;
use crate::model::dynamics::{Description, Dynamics};
use crate::model::{ActionIdx, Limits};

/// Cost of an action that names none.
const DEFAULT_ACTION_COST: f64 = 1.0;

/// Reads a planning task.
pub(in crate::model) fn read(
    description: &mut Description<'_, '_>,
    _: Limits,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Arc<dyn Dynamics>>, Interrupted> {
    let n_before = faults.count();
    let model = description.model;
    let attributes = model.required("attributes", faults).and_then(|place| Schema::read(&place, faults));
    let actions = model.required("actions", faults);
    let actions = actions.and_then(|place| ReadActions::read(&place, DEFAULT_ACTION_COST, faults));
    let object = description.dynamics.object(&["kind", "values", "start", "operators", "unsafe"], faults);
    let attributes = attributes.and_then(|attributes| attributes.into_iter().collect::<Option<Vec<Attribute>>>());
    let (Some(attributes), Some(actions), Some(object)) = (attributes, actions, object) else { return Ok(None) };
    let schema = Schema::of(attributes);

    let values = object.required("values", faults);
    let Some(domains) = values.and_then(|place| read_domains(&place, &schema, faults)) else { return Ok(None) };
    let known = Known { schema: &schema, domains: &domains };
    let start = object.required("start", faults).and_then(|place| known.read_whole(&place, faults));
    let mut rules = Vec::new();
    if let Some(place) = object.required("operators", faults)
        && let Some(items) = place.array(faults)
    {
        let mut seen: HashMap<ActionIdx, usize> = HashMap::new();
        for (n, item) in items.iter().enumerate() {
            meter.spend_or_stop(1)?;
            let place = place.item(n, item);
            let Some((action, rule)) = known.read_rule(&place, &actions, faults) else { continue };
            if let Some(before) = seen.insert(action, n) {
                let detail = format!("the action has an operator already: operator {before}");
                faults.note_at(&Path::Member(&place.path, "action"), detail);
            }
            rules.push((action, rule));
        }
    }
    let deadly = object.optional("unsafe");
    let text = deadly.as_ref().and_then(|place| place.string(faults));
    let (Some(start), Some(actions)) = (start, actions.complete()) else { return Ok(None) };
    if faults.count() > n_before {
        return Ok(None);
    }
    let domains = domains.into_iter().map(|domain| domain.values).collect();
    let mut task = Planning::new(schema, actions, domains, start, rules);
    if let (Some(place), Some(text)) = (deadly, text) {
        task = match task.avoiding(text) {
            Ok(task) => task,
            Err(detail) => {
                faults.note(&place, detail);
                return Ok(None);
            }
        };
    }
    Ok(Some(Arc::new(task)))
}

/// The values of an attribute, and where each stands. Hashed with a seed, as clients choose them.
struct Domain {
    values: Vec<Value>,
    positions: HashMap<Value, u32>,
}

fn read_domains(place: &Place<'_, '_>, schema: &Schema, faults: &mut Faults) -> Option<Vec<Domain>> {
    let items = place.array(faults)?;
    if items.len() != schema.len() {
        let detail = format!("expected {} lists of values, one per attribute, found {}", schema.len(), items.len());
        faults.note(place, detail);
        return None;
    }
    let read = schema.attributes().iter().zip(items).enumerate().map(|(n, (attribute, item))| {
        let place = place.item(n, item);
        let items = place.array(faults)?;
        let mut domain = Domain { values: Vec::with_capacity(items.len()), positions: HashMap::new() };
        if items.is_empty() {
            return place.mismatch("at least one value", faults);
        }
        for (n, item) in items.iter().enumerate() {
            let place = place.item(n, item);
            let value = attribute.read_value(&place, faults)?;
            let position = u32::try_from(n).ok()?;
            if domain.positions.insert(value.clone(), position).is_some() {
                faults.note(&place, "stands twice");
                return None;
            }
            domain.values.push(value);
        }
        Some(domain)
    });
    let read: Vec<_> = read.collect();
    read.into_iter().collect()
}

/// What values are read against.
struct Known<'k> {
    schema: &'k Schema,
    domains: &'k [Domain],
}

impl Known<'_> {
    /// Reads some values of a state.
    fn read_some(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Values> {
        let n_before = faults.count();
        let values = self.schema.read_observation(place, faults)?;
        if faults.count() > n_before {
            return None;
        }
        let mut read = Values::new();
        for (n, value) in values.into_iter().enumerate() {
            let Some(value) = value else { continue };
            let Some(position) = self.domains[n].positions.get(&value) else {
                let name = &self.schema.attributes()[n].name;
                faults.note_at(&Path::Member(&place.path, name), "is none of the attribute's `values`");
                return None;
            };
            read.push((n, *position));
        }
        Some(read)
    }

    /// Reads all values of a state.
    fn read_whole(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<u32>> {
        let values = self.read_some(place, faults)?;
        let missing = (0..self.domains.len()).find(|n| values.get(*n).is_none_or(|(at, _)| at != n));
        if let Some(missing) = missing {
            faults.note_at(&Path::Member(&place.path, &self.schema.attributes()[missing].name), "is missing");
            return None;
        }
        Some(values.into_iter().map(|(_, value)| value).collect())
    }

    fn read_rule(
        &self,
        place: &Place<'_, '_>,
        actions: &ReadActions<'_>,
        faults: &mut Faults,
    ) -> Option<(ActionIdx, Rule)> {
        let object = place.object(&["action", "when", "then", "conditional"], faults)?;
        let action = object.required("action", faults).and_then(|place| actions.read_reference(&place, faults));
        let mut some = |name: &str| match object.optional(name) {
            Some(place) => self.read_some(&place, faults),
            None => Some(Values::new()),
        };
        let (when, then) = (some("when"), some("then"));
        let mut conditional = Vec::new();
        if let Some(place) = object.optional("conditional") {
            for (n, item) in place.array(faults)?.iter().enumerate() {
                let place = place.item(n, item);
                let object = place.object(&["when", "then"], faults)?;
                let when = object.required("when", faults).and_then(|place| self.read_some(&place, faults));
                let then = object.required("then", faults).and_then(|place| self.read_some(&place, faults));
                conditional.push((when?, then?));
            }
        }
        Some((action?, Rule { when: when?, then: then?, conditional }))
    }
}

/// A planning task: states by their values, and operators that need some values and change some.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = PlanningDynamics))]
pub struct PlanningDocument {
    /// The values that states may have: for each attribute, in their order, at least one.
    #[cfg_attr(feature = "openapi", schema(example = json!([["here", "there"], ["open", "shut"]])))]
    pub values: Vec<Vec<Scalar>>,
    /// The values of the state in which the imitator starts: of all attributes.
    // Of scalars; a client that is generated from a map of those takes a number for one.
    #[cfg_attr(feature = "openapi", schema(value_type = std::collections::BTreeMap<String, serde_json::Value>, example = json!({"place": "here", "door": "shut"})))]
    pub start: ByAttribute<Scalar>,
    /// What actions need and change: at most one for each.
    pub operators: Vec<OperatorDocument>,
    /// In which states the body must never be: an expression of CEL over the attributes that gives a `bool`. A state for which it has no value
    /// is not entered either.
    #[serde(default, rename = "unsafe", skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(example = "place == 'there' && door == 'shut'"))]
    pub unsafe_when: Option<String>,
}

/// What an action needs, and what it changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = PlanningOperator))]
pub struct OperatorDocument {
    /// The action, by its name.
    #[cfg_attr(feature = "openapi", schema(value_type = String, example = "open"))]
    pub action: Arc<str>,
    /// Values that must be there for it to apply; left out: none.
    #[cfg_attr(feature = "openapi", schema(value_type = std::collections::BTreeMap<String, Scalar>, example = json!({"door": "shut"}), required = false))]
    pub when: ByAttribute<Scalar>,
    /// Values that are there then; what is not named stays.
    #[cfg_attr(feature = "openapi", schema(value_type = std::collections::BTreeMap<String, Scalar>, example = json!({"door": "open"}), required = false))]
    pub then: ByAttribute<Scalar>,
    /// What else changes where further values were there before; the later ones in place of the earlier.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub conditional: Vec<ConditionalDocument>,
}

/// What changes where further values were there before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = PlanningConditional))]
pub struct ConditionalDocument {
    /// Values that must have been there.
    #[cfg_attr(feature = "openapi", schema(value_type = std::collections::BTreeMap<String, Scalar>))]
    pub when: ByAttribute<Scalar>,
    /// Values that are there then.
    #[cfg_attr(feature = "openapi", schema(value_type = std::collections::BTreeMap<String, Scalar>))]
    pub then: ByAttribute<Scalar>,
}

/// Writes the [`PlanningDocument`] of a task in canonical form, an operator at a time.
impl Serialize for Planning {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeStruct;
        let write = |attribute: usize, value: u32| {
            self.schema.attributes()[attribute].write_value(&self.domains[attribute][value as usize])
        };
        let values = |(attribute, domain): (usize, &Vec<Value>)| {
            domain.iter().map(|value| self.schema.attributes()[attribute].write_value(value)).collect::<Vec<_>>()
        };
        let start: Values = self.start.iter().copied().enumerate().collect();
        let mut fields = serializer.serialize_struct("Planning", 4 + usize::from(self.deadly.is_some()))?;
        fields.serialize_field("kind", "planning")?;
        fields.serialize_field("values", &self.domains.iter().enumerate().map(values).collect::<Vec<_>>())?;
        fields.serialize_field("start", &named(&self.schema, &start, &write))?;
        fields.serialize_field("operators", &WrittenRules(self))?;
        if let Some(deadly) = &self.deadly {
            fields.serialize_field("unsafe", deadly.text())?;
        }
        fields.end()
    }
}

fn named(schema: &Schema, values: &Values, write: &impl Fn(usize, u32) -> Scalar) -> ByAttribute<Scalar> {
    let mut items = vec![None; schema.len()];
    for (attribute, value) in values {
        items[*attribute] = Some(write(*attribute, *value));
    }
    schema.by_some_attributes(items)
}

struct WrittenRules<'t>(&'t Planning);

impl Serialize for WrittenRules<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self(task) = self;
        let write = |attribute: usize, value: u32| {
            task.schema.attributes()[attribute].write_value(&task.domains[attribute][value as usize])
        };
        let by_name = |values: &Values| named(&task.schema, values, &write);
        let mut items = serializer.serialize_seq(Some(task.rules.len()))?;
        for (action, Rule { when, then, conditional }) in &task.rules {
            items.serialize_element(&OperatorDocument {
                action: Arc::clone(&task.actions[usize::from(*action)].name),
                when: by_name(when),
                then: by_name(then),
                conditional: conditional
                    .iter()
                    .map(|(when, then)| ConditionalDocument { when: by_name(when), then: by_name(then) })
                    .collect(),
            })?;
        }
        items.end()
    }
}
