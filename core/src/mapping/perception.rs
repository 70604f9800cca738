//! What the imitator observes of a demonstrator whose states are told in another vocabulary.

use serde_json::{Map, Value};

use crate::attribute::{Attribute, Scalar, Schema};
use crate::document::{Faults, Path, Place, Quoted, Repeated, normal};
use crate::expression::{Datum, Expression, Scope, read_all};

/// How the imitator's observations follow from what is told of the demonstrator: by expressions of CEL over the demonstrator's own attributes.
///
/// All numbers of the demonstrator are doubles, however they are written; beside one, an integer of the expression is read as a double. What
/// is missing or null in a row is null, and what needs it is not observed.
#[derive(Clone, Debug)]
pub struct Perception {
    /// The imitator's attributes that are observed, by name, and how.
    attributes: Vec<(String, Expression)>,
    /// The demonstrator's attributes, in the order of their numbers.
    names: Vec<String>,
}

impl PartialEq for Perception {
    fn eq(&self, other: &Self) -> bool {
        let texts = |own: &Self| -> Vec<(String, String)> {
            own.attributes.iter().map(|(name, expression)| (name.clone(), expression.text().to_owned())).collect()
        };
        texts(self) == texts(other)
    }
}

impl Perception {
    /// Reads an object with an expression for each attribute that is observed.
    pub fn read(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let object = place.open_object(faults)?;
        if !(1..=Schema::MAX_ATTRIBUTES).contains(&object.members.len()) {
            return place
                .mismatch(&format!("an expression for each of 1 to {} attributes", Schema::MAX_ATTRIBUTES), faults);
        }
        let n_before = faults.count();
        let texts: Vec<Option<&str>> = object.iter().map(|(_, place)| place.string(faults)).collect();
        let texts: Vec<&str> = texts.into_iter().collect::<Option<_>>()?;
        let mut names = Vec::new();
        let Some(read) = read_all(&texts, &Scope::open(), &mut names) else {
            faults.note(place, "there is no thread to read expressions on");
            return None;
        };
        let mut attributes = Vec::with_capacity(texts.len());
        for ((name, place), read) in object.iter().zip(read) {
            match read {
                Ok(expression) => attributes.push((normal(name).into_owned(), expression)),
                Err(flaws) => {
                    for flaw in flaws {
                        faults.note(&place, flaw);
                    }
                }
            }
        }
        (faults.count() == n_before).then_some(Self { attributes, names })
    }

    /// What is observed of a demonstrator that is in these states, as the imitator's observations are written: an array. What is wrong with
    /// several states in the same way is told once. A name that none of them has is a fault of the expression, which is at `path`.
    pub fn observe_all(&self, states: &Place<'_, '_>, path: &Path<'_>, faults: &mut Faults) -> Option<Value> {
        let items = states.array(faults)?;
        let n_before = faults.count();
        for (number, name) in self.names.iter().enumerate() {
            if !items.is_empty() && !items.iter().any(|item| member(item, name).is_some()) {
                let user = self.attributes.iter().find(|(_, expression)| expression.reads().contains(&number));
                let path = Path::Member(path, user.map_or("", |(attribute, _)| attribute));
                faults.note_at(&path, format!("no state of the demonstration has {}", Quoted(name)));
            }
        }
        let observations = self.observe_each(items.iter().enumerate().map(|(n, item)| states.item(n, item)), faults);
        let observations = observations.filter(|_| faults.count() == n_before)?;
        Some(Value::Array(observations))
    }

    /// As [`Self::observe_all`], of some of the states, which need not have all names.
    pub fn observe_each<'v, 'p>(
        &self,
        states: impl ExactSizeIterator<Item = Place<'v, 'p>>,
        faults: &mut Faults,
    ) -> Option<Vec<Value>> {
        let n_before = faults.count();
        let mut repeated = Repeated::default();
        let mut observations = Vec::with_capacity(states.len());
        for place in states {
            let mut own = Faults::default();
            observations.push(self.observe(&place, &mut own).unwrap_or_default());
            repeated.take_in(own, &place.path);
        }
        repeated.tell("states", faults);
        (faults.count() == n_before).then_some(observations)
    }

    /// As it is written in JSON: the expressions by name of the attribute.
    #[must_use]
    pub fn document(&self) -> Value {
        let texts = self.attributes.iter().map(|(name, expression)| (name.clone(), expression.text().into()));
        Value::Object(texts.collect())
    }

    /// What is observed of a demonstrator in this state: an object by the imitator's attributes.
    pub fn observe(&self, state: &Place<'_, '_>, faults: &mut Faults) -> Option<Value> {
        if !state.value.is_object() {
            return state.mismatch("a state of the demonstrator: an object by its attributes", faults);
        }
        let variables: Vec<Datum<'_>> =
            self.names.iter().map(|name| member(state.value, name).map_or(Datum::Null, datum)).collect();
        let n_before = faults.count();
        let mut observation = Map::with_capacity(self.attributes.len());
        for (name, expression) in &self.attributes {
            let note = |faults: &mut Faults, offset: u32, detail: &str| {
                faults.note(
                    state,
                    format!("what is observed as {}, {}: {detail}", Quoted(name), expression.place(offset)),
                );
            };
            match expression.evaluate(&variables) {
                Err(failure) => note(faults, failure.offset, &failure.detail),
                Ok(value) => match written(&value) {
                    Some(value) => drop(observation.insert(name.clone(), value)),
                    None => note(faults, 0, &format!("{value} is no value of an attribute")),
                },
            }
        }
        (faults.count() == n_before).then_some(Value::Object(observation))
    }
}

/// The member of this name, or the one to which it leads: `arm.angle` is that of `arm` as well.
fn member<'v>(state: &'v Value, name: &str) -> Option<&'v Value> {
    state.get(name).or_else(|| name.split('.').try_fold(state, |value, part| value.get(part)))
}

fn datum(value: &Value) -> Datum<'_> {
    match value {
        Value::Bool(flag) => Datum::Bool(*flag),
        Value::Number(number) => Datum::Double(number.as_f64().unwrap_or(f64::NAN)),
        Value::String(text) => Datum::text(&normal(text)),
        Value::Array(items) => Datum::list(items.iter().map(datum).collect()),
        Value::Null | Value::Object(_) => Datum::Null,
    }
}

/// A value of an attribute, as it is written in JSON.
fn written(value: &Datum<'_>) -> Option<Value> {
    match value {
        Datum::Null => Some(Value::Null),
        Datum::Int(number) => Some((*number).into()),
        Datum::Double(number) if number.is_finite() => serde_json::to_value(Scalar::number(*number)).ok(),
        Datum::Bool(flag) => Some((*flag).into()),
        Datum::Text(text) if text.len() <= Attribute::MAX_TEXT_BYTES => Some((**text).into()),
        Datum::Double(_) | Datum::Text(_) | Datum::List(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn perception(observe: &Value) -> Perception {
        let mut faults = Faults::default();
        let read = Perception::read(&Place::root(observe), &mut faults);
        faults.check(read).unwrap()
    }

    fn observed(observe: &Value, states: &Value) -> Result<Value, Vec<(String, String)>> {
        let mut faults = Faults::default();
        let path = Path::Member(&Path::Root, "observe");
        let all = perception(observe).observe_all(&Place::root(states), &path, &mut faults);
        faults.check(all).map_err(|faults| {
            faults.listed().iter().map(|fault| (fault.pointer.clone(), fault.detail.clone())).collect()
        })
    }

    #[test]
    fn observations_follow_from_the_demonstrators_own_attributes_however_numbers_are_written() {
        let observe = json!({
            "x": "east_m / 0.25", "row": "int(east_m) / 2", "door": "opening > 0.5 ? 'open' : 'shut'", "angle": "arm.angle + 90",
            "lit": "lamp == 'on'", "far": "math.greatest(ranges[0], ranges[1])",
        });
        let states = json!([
            {"east_m": 1, "opening": 0.75, "arm": {"angle": 10}, "lamp": "on", "ranges": [1, 2.5]},
            {"east_m": 0.5, "opening": null, "arm.angle": -10.5, "ranges": [3, 2]},
        ]);
        let expected = json!([
            {"x": 4, "row": 0, "door": "open", "angle": 100, "lit": true, "far": 2.5},
            {"x": 2, "row": 0, "door": null, "angle": 79.5, "lit": null, "far": 3},
        ]);
        assert_eq!(observed(&observe, &states), Ok(expected));
    }

    #[test]
    fn what_cannot_be_observed_is_told_with_row_and_column() {
        let observe = json!({"x": "1 + east_m", "y": "1.0 / north_m"});
        let states = json!([{"east_m": 1, "north_m": 1}, {"east_m": "far", "north_m": 0}, 7]);
        let faults = observed(&observe, &states).unwrap_err();
        let expected = [
            ("/1", "what is observed as \"x\", column 3: this cannot be done with int (1) and string (\"far\")"),
            ("/1", "what is observed as \"y\", column 1: inf is no value of an attribute"),
            ("/2", "expected a state of the demonstrator: an object by its attributes, found 7"),
        ];
        assert_eq!(faults, expected.map(|(pointer, detail)| (pointer.to_owned(), detail.to_owned())));
        let faults = observed(&json!({"x": "eest_m"}), &json!([{"east_m": 1}])).unwrap_err();
        assert_eq!(faults, [("/observe/x".to_owned(), "no state of the demonstration has \"eest_m\"".to_owned())]);
    }

    #[test]
    fn all_that_is_wrong_with_expressions_is_told_at_once() {
        let mut faults = Faults::default();
        let observe = json!({"x": "1 +", "y": "jump(a) && 'b' * 2", "z": 3});
        assert!(Perception::read(&Place::root(&observe), &mut faults).is_none());
        assert_eq!(faults.listed()[0].pointer, "/z");
        let mut faults = Faults::default();
        let observe = json!({"x": "1 +", "y": "jump(a) && 'b' * 2"});
        assert!(Perception::read(&Place::root(&observe), &mut faults).is_none());
        let told: Vec<&str> = faults.listed().iter().map(|fault| fault.pointer.as_str()).collect();
        assert_eq!(told, ["/x", "/y", "/y"], "{faults}");
    }
}
