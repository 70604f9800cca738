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
//! with [`Attribute::delta`] depending on the attribute's [`Kind`]. Nothing here knows of actions or models.

mod by_attribute;
mod schema;
mod value;
mod weights;

pub use by_attribute::ByAttribute;
pub use schema::{AttributeDocument, KindName, Schema};
pub use value::{Scalar, Value};
pub use weights::Weights;

use crate::document::{Faults, Place, Range};

/// Largest term of a distance, and largest cost of an action. Keeps every sum along a path finite: even a hundred
/// million of them stay below the largest float.
pub const MAX_COST: f64 = 1e150;

/// A named feature of a state.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// Unique within its schema; 1 to [`Self::MAX_NAME_CHARS`] characters.
    pub name: String,
    /// How its values are written and compared.
    pub kind: Kind,
    /// Weight in the distance where a request names none. Finite, at least 0.
    pub weight: f64,
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
    /// Values are these labels, in order around the circle, one unit apart. At least 1, all different.
    Labels(Vec<String>),
}

impl Cycle {
    /// The circumference `p`.
    #[must_use]
    pub fn period(&self) -> f64 {
        match self {
            Self::Period(period) => *period,
            #[expect(clippy::cast_precision_loss, reason = "there are far fewer labels than 2^52")]
            Self::Labels(labels) => labels.len() as f64,
        }
    }
}

impl Attribute {
    /// Longest name, in characters.
    pub const MAX_NAME_CHARS: usize = 64;

    /// The difference between an observed and a state's value of this attribute, before weighting. Finite or
    /// `+inf` (if numbers near the limit of floats are subtracted), at least 0.
    ///
    /// Values of another kind than the attribute's differ by 1; readers do not let them in.
    #[must_use]
    pub fn delta(&self, observed: &Value, own: &Value) -> f64 {
        match (&self.kind, observed, own) {
            (Kind::Number { scale }, Value::Number(o), Value::Number(s)) => (o - s).abs() / scale,
            (Kind::Cyclic { scale, cycle }, Value::Number(o), Value::Number(s)) => {
                let period = cycle.period();
                let along = (o - s).abs() % period;
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

    /// The attribute's term of the distance at weight `weight`: `weight * delta^2`, at most [`MAX_COST`].
    #[must_use]
    pub fn term(&self, weight: f64, observed: &Value, own: &Value) -> f64 {
        let delta = self.delta(observed, own);
        // Where nothing is weighed or nothing differs, an overflow of the other factor must not give NaN.
        if weight == 0.0 || delta == 0.0 { 0.0 } else { (weight * (delta * delta)).min(MAX_COST) }
    }

    /// Reads a value of this attribute.
    pub fn read_value(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Value> {
        use serde_json::Value as Json;
        match (&self.kind, place.value) {
            (Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. }, _) => {
                place.number(Range::Finite, faults).map(Value::Number)
            }
            (Kind::Cyclic { cycle: Cycle::Labels(labels), .. }, Json::String(text)) => {
                match labels.iter().position(|label| label == text) {
                    #[expect(clippy::cast_possible_truncation, reason = "the schema bounds the number of labels")]
                    Some(position) => Some(Value::Label(position as u32)),
                    None => place.mismatch(&format!("one of the labels {}", labels.join(", ")), faults),
                }
            }
            (Kind::Cyclic { cycle: Cycle::Labels(labels), .. }, _) => {
                place.mismatch(&format!("one of the labels {}", labels.join(", ")), faults)
            }
            (Kind::Category, Json::String(text)) => Some(Value::Text(text.as_str().into())),
            (Kind::Category, Json::Bool(flag)) => Some(Value::Boolean(*flag)),
            (Kind::Category, Json::Number(number)) if number.is_i64() => number.as_i64().map(Value::Integer),
            (Kind::Category, _) => place.mismatch("a string, an integer or a boolean", faults),
        }
    }

    /// How `value` is written outside.
    #[must_use]
    pub fn write_value(&self, value: &Value) -> Scalar {
        match (value, &self.kind) {
            (Value::Label(label), Kind::Cyclic { cycle: Cycle::Labels(labels), .. }) => {
                Scalar::Text(labels[*label as usize].as_str().into())
            }
            (Value::Label(label), _) => Scalar::Integer((*label).into()),
            (Value::Number(number), _) => Scalar::number(*number),
            (Value::Text(text), _) => Scalar::Text(text.clone()),
            (Value::Integer(integer), _) => Scalar::Integer(*integer),
            (Value::Boolean(flag), _) => Scalar::Boolean(*flag),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn attribute(kind: Kind) -> Attribute {
        Attribute { name: "a".to_owned(), kind, weight: 1.0 }
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
            cycle: Cycle::Labels(["east", "north", "west", "south"].map(String::from).to_vec()),
        });
        let deltas: Vec<_> = (0..4).map(|label| heading.delta(&Value::Label(0), &Value::Label(label))).collect();
        assert_eq!(deltas, [0.0, 1.0, 2.0, 1.0]);
        let degrees = attribute(Kind::Cyclic { scale: 10.0, cycle: Cycle::Period(360.0) });
        let delta = degrees.delta(&Value::Number(-350.0), &Value::Number(730.0));
        assert!(delta.abs() < 1e-12, "{delta}");
        assert_eq!(degrees.delta(&Value::Number(350.0), &Value::Number(10.0)).to_bits(), 2.0_f64.to_bits());
    }

    #[test]
    fn categories_are_equal_or_not() {
        let a = attribute(Kind::Category);
        assert!(a.delta(&Value::Text("a".into()), &Value::Text("a".into())).abs() < f64::EPSILON);
        assert!((a.delta(&Value::Integer(1), &Value::Boolean(true)) - 1.0).abs() < f64::EPSILON);
    }
}
