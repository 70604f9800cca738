//! Attributes: the named features by which states are observed and compared.
//!
//! A [`Schema`] lists a model's attributes in order; a state is one [`Value`] per attribute, an observation one
//! `Option<Value>` per attribute, `None` where nothing was observed. The distance between an observation `o` and
//! a state `s` is
//!
//! ```text
//! D(o, s) = sum over observed k of  w_k * delta_k(o_k, s_k)^2        w_k >= 0
//! ```
//!
//! with [`Attribute::delta`] depending on the attribute's [`Kind`]; no term is more than [`MAX_COST`]. Nothing here knows of actions or models.

mod build;
mod by_attribute;
mod document;
mod labels;
mod reading;
mod schema;
mod value;
mod weights;

use std::borrow::Cow;

use serde::Serialize;

pub use build::BuildError;
pub(crate) use build::{check_cost, check_count, check_name};
pub use by_attribute::ByAttribute;
pub use document::{AttributeDocument, KindName, ValuesDocument};
pub use labels::Labels;
pub(crate) use reading::ValueSeed;
pub use schema::Schema;
pub use value::{Scalar, Value};
pub use weights::Weights;

use crate::document::{Faults, Place, Range, list_known, normal, whole};

/// Largest cost of an action, and largest term of a distance; dimensionless. Keeps every sum along a path finite: even a
/// hundred million of them stay below the largest float.
pub const MAX_COST: f64 = 1e150;

/// A named feature of a state.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// Unique within its schema; 1 to [`Self::MAX_NAME_CHARS`] characters.
    pub name: String,
    /// How its values are written and compared.
    pub kind: Kind,
    /// Weight in the distance where a request names none. Finite, at least 0; however large, the attribute adds at most
    /// [`MAX_COST`] to a distance.
    pub weight: f64,
    /// Whether it tells states apart and is never observed nor compared; its weight is then 0.
    pub is_hidden: bool,
}

/// How the values of an attribute are written and compared.
#[derive(Clone, Debug, PartialEq)]
pub enum Kind {
    /// Numbers on a line. `delta = |o - s| / scale`.
    Number {
        /// What counts as a difference of 1. Above 0.
        scale: f64,
    },
    /// Numbers or labels on a circle of circumference `p`. `delta = min(d mod p, p - d mod p) / scale`, `d = |o - s|`.
    Cyclic {
        /// What counts as a difference of 1. Above 0.
        scale: f64,
        /// The circle.
        cycle: Cycle,
    },
    /// Strings, integers and booleans without order. `delta = 0` if equal, else 1.
    Category,
}

/// The circle that a cyclic attribute runs on.
#[derive(Clone, Debug, PartialEq)]
pub enum Cycle {
    /// Values are numbers; the circumference is above 0.
    Period(f64),
    /// Values are these labels, in order around the circle, one unit apart.
    Labels(Labels),
}

impl Cycle {
    /// The circumference `p`.
    #[must_use]
    pub fn period(&self) -> f64 {
        match self {
            Self::Period(period) => *period,
            #[expect(clippy::cast_precision_loss, reason = "there are far fewer labels than 2^52")]
            Self::Labels(labels) => labels.names().len() as f64,
        }
    }
}

impl Attribute {
    /// Longest name, in characters.
    pub const MAX_NAME_CHARS: usize = 64;
    /// Longest label, and longest string of a category, in bytes. They are repeated in every step of a policy.
    pub const MAX_TEXT_BYTES: usize = 1024;

    /// The difference between an observed and a state's value of this attribute, before weighting. At least 0, never NaN;
    /// `+inf` if it is beyond the range of floats.
    ///
    /// Values of another kind than the attribute's differ by 1; readers do not let them in.
    #[must_use]
    pub fn delta(&self, observed: &Value, own: &Value) -> f64 {
        match (&self.kind, observed, own) {
            (Kind::Number { scale }, Value::Number(o), Value::Number(s)) => {
                let apart = (o - s).abs();
                // Numbers near the limit of floats may be apart by more than a float, but not by more scales.
                if apart.is_finite() { apart / scale } else { (o / scale - s / scale).abs() }
            }
            (Kind::Cyclic { scale, cycle }, Value::Number(o), Value::Number(s)) => {
                let period = cycle.period();
                // Reduced before the subtraction, which could overflow: each value may be as large as floats are.
                let along = (o.rem_euclid(period) - s.rem_euclid(period)).abs();
                along.min(period - along) / scale
            }
            (Kind::Cyclic { scale, cycle }, Value::Label(o), Value::Label(s)) => {
                let period = cycle.period();
                let along = f64::from(o.abs_diff(*s)) % period;
                along.min(period - along) / scale
            }
            (Kind::Category, o, s) if o == s => 0.0,
            _ => 1.0,
        }
    }

    /// The attribute's term of the distance at weight `weight`: `weight * delta^2`, at most [`MAX_COST`]. Finite, at least 0.
    #[must_use]
    pub fn term(&self, weight: f64, observed: &Value, own: &Value) -> f64 {
        let delta = self.delta(observed, own);
        // Where nothing is weighed or nothing differs, an overflow of the other factor must not give NaN. Elsewhere
        // `weight * delta` leaves the range of floats only where the whole is far beyond the cap, or next to nothing;
        // `delta * delta` would leave it where a weight brings it back.
        if weight == 0.0 || delta == 0.0 { 0.0 } else { (weight * delta * delta).min(MAX_COST) }
    }

    /// A label, or a string of a category, in the form in which it is compared; `None` if it is too long.
    pub(crate) fn text(text: &str) -> Option<Cow<'_, str>> {
        // Of what is longer, no more may have been kept.
        let text = (text.len() <= Self::MAX_TEXT_BYTES).then(|| normal(text))?;
        (text.len() <= Self::MAX_TEXT_BYTES).then_some(text)
    }

    /// What its values are, as a fault says it.
    pub(crate) fn expected(&self) -> String {
        match &self.kind {
            Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. } => Range::Finite.describe(),
            Kind::Cyclic { cycle: Cycle::Labels(labels), .. } => {
                format!("one of the labels {}", list_known(labels.names()))
            }
            Kind::Category => "a string, an integer or a boolean".to_owned(),
        }
    }

    /// Reads a value of this attribute.
    pub fn read_value(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Value> {
        use serde_json::Value as Json;
        match (&self.kind, place.value) {
            (Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. }, _) => {
                let integer = place.value.as_i64().map(i128::from).or_else(|| place.value.as_u64().map(i128::from));
                if integer.is_some_and(|integer| reading::exact(integer).is_none()) {
                    let detail = "which no number holds exactly (they are 64-bit floats, whole up to 2^53): make the attribute a category";
                    faults.note(place, format!("found {}, {detail}", place.value));
                    return None;
                }
                place.number(Range::Finite, faults).map(Value::Number)
            }
            (Kind::Cyclic { cycle: Cycle::Labels(labels), .. }, value) => {
                match value.as_str().and_then(|text| labels.position(text)) {
                    Some(position) => Some(Value::Label(position)),
                    None => place.mismatch(&self.expected(), faults),
                }
            }
            (Kind::Category, Json::String(_)) => read_text(place, faults).map(|text| Value::Text(text.into())),
            (Kind::Category, Json::Bool(flag)) => Some(Value::Boolean(*flag)),
            (Kind::Category, value) => {
                let integer = value.as_i64().or_else(|| value.as_f64().filter(|_| value.is_f64()).and_then(whole));
                integer.map(Value::Integer).or_else(|| place.mismatch(&self.expected(), faults))
            }
        }
    }

    /// `value` as it is written outside, without a copy.
    pub(crate) fn written<'v>(&'v self, value: &'v Value) -> WrittenValue<'v> {
        match (value, &self.kind) {
            (Value::Label(label), Kind::Cyclic { cycle: Cycle::Labels(labels), .. }) => {
                WrittenValue::Text(&labels.names()[*label as usize])
            }
            (Value::Text(text), _) => WrittenValue::Text(text),
            _ => WrittenValue::Scalar(self.write_value(value)),
        }
    }

    /// How `value` is written outside.
    #[must_use]
    pub fn write_value(&self, value: &Value) -> Scalar {
        match (value, &self.kind) {
            (Value::Label(label), Kind::Cyclic { cycle: Cycle::Labels(labels), .. }) => {
                Scalar::Text((&*labels.names()[*label as usize]).into())
            }
            (Value::Label(label), _) => Scalar::Integer((*label).into()),
            (Value::Number(number), _) => Scalar::number(*number),
            (Value::Text(text), _) => Scalar::Text(text.clone()),
            (Value::Integer(integer), _) => Scalar::Integer(*integer),
            (Value::Boolean(flag), _) => Scalar::Boolean(*flag),
        }
    }
}

/// A value of an attribute, as it is written in JSON.
#[derive(Serialize)]
#[serde(untagged)]
pub(crate) enum WrittenValue<'v> {
    Text(&'v str),
    Scalar(Scalar),
}

/// Reads a label, or a string of a category.
fn read_text<'v>(place: &Place<'v, '_>, faults: &mut Faults) -> Option<Cow<'v, str>> {
    let text = Attribute::text(place.string(faults)?);
    text.or_else(|| place.mismatch(&format!("a string of at most {} bytes", Attribute::MAX_TEXT_BYTES), faults))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn attribute(kind: Kind) -> Attribute {
        Attribute { name: "a".to_owned(), kind, weight: 1.0, is_hidden: false }
    }

    #[test]
    fn a_number_differs_by_units_of_its_scale() {
        let a = attribute(Kind::Number { scale: 2.0 });
        assert_eq!(a.delta(&Value::Number(1.0), &Value::Number(-4.0)).to_bits(), 2.5_f64.to_bits());
        assert_eq!(a.term(3.0, &Value::Number(1.0), &Value::Number(-4.0)).to_bits(), 18.75_f64.to_bits());
    }

    #[test]
    fn a_cyclic_value_differs_by_the_shorter_way_round() {
        let heading = attribute(Kind::Cyclic {
            scale: 1.0,
            cycle: Cycle::Labels(Labels::of(["east", "north", "west", "south"])),
        });
        let deltas: Vec<_> = (0..4).map(|label| heading.delta(&Value::Label(0), &Value::Label(label))).collect();
        assert_eq!(deltas, [0.0, 1.0, 2.0, 1.0]);
        let degrees = attribute(Kind::Cyclic { scale: 10.0, cycle: Cycle::Period(360.0) });
        let delta = degrees.delta(&Value::Number(-350.0), &Value::Number(730.0));
        assert!(delta.abs() < 1e-12, "{delta}");
        assert_eq!(degrees.delta(&Value::Number(350.0), &Value::Number(10.0)).to_bits(), 2.0_f64.to_bits());
    }

    #[test]
    fn cyclic_values_as_large_as_floats_differ_by_less_than_their_period() {
        let degrees = attribute(Kind::Cyclic { scale: 1.0, cycle: Cycle::Period(360.0) });
        for (o, s) in [(f64::MAX, -f64::MAX), (-f64::MAX, 1.0), (f64::MIN_POSITIVE, -f64::MIN_POSITIVE)] {
            let delta = degrees.delta(&Value::Number(o), &Value::Number(s));
            assert!((0.0..=180.0).contains(&delta), "{o} and {s}: {delta}");
        }
    }

    #[test]
    fn a_term_is_lost_to_the_range_of_floats_only_where_it_is_beyond_it() {
        let a = attribute(Kind::Number { scale: 1.0 });
        let term = |weight, delta| a.term(weight, &Value::Number(delta), &Value::Number(0.0));
        for (weight, delta, expected) in [(1e-300, 1e200, 1e100), (1e300, 1e-170, 1e-40), (3.0, 2.5, 18.75)] {
            let term: f64 = term(weight, delta);
            assert!((term / expected - 1.0).abs() < 1e-12, "{weight} * {delta}^2: {term}");
        }
        assert_eq!((term(1e300, 1e200), term(0.0, 1e200), term(1e300, 0.0)), (MAX_COST, 0.0, 0.0));
        let wide = attribute(Kind::Number { scale: 1e308 });
        assert_eq!(wide.delta(&Value::Number(1.5e308), &Value::Number(-1.5e308)), 3.0);
    }

    #[test]
    fn a_value_that_is_too_long_or_unknown_is_not_repeated_at_length() {
        let long = serde_json::Value::from("x".repeat(1_000_000));
        let labels: Vec<String> = (0..60_000).map(|n| format!("label {n}")).collect();
        for kind in [Kind::Category, Kind::Cyclic { scale: 1.0, cycle: Cycle::Labels(Labels::new(labels.into_iter())) }]
        {
            let mut faults = Faults::default();
            assert_eq!(attribute(kind).read_value(&Place::root(&long), &mut faults), None);
            assert!(faults.listed()[0].detail.len() < 500, "{faults}");
        }
    }

    #[test]
    fn categories_are_equal_or_not() {
        let a = attribute(Kind::Category);
        assert!(a.delta(&Value::Text("a".into()), &Value::Text("a".into())).abs() < f64::EPSILON);
        assert!((a.delta(&Value::Integer(1), &Value::Boolean(true)) - 1.0).abs() < f64::EPSILON);
    }
}
