//! Demonstrations without what repeats itself: of a robot that stands still, a log has the same state again and again.

use super::Demonstration;
use crate::attribute::{Attribute, Kind, Schema, Value};

impl Demonstration {
    /// The demonstration without the observations that stay close to the last one that was kept: within `within`, by positions of
    /// attributes, in each of these, and equal in all others. The first and the last stay. Gives the numbers of those that are kept. An
    /// attribute that was not observed is close to itself not observed.
    pub(in crate::mapping) fn collapsed(&self, schema: &Schema, within: &[(usize, f64)]) -> (Self, Vec<u32>) {
        let mut limits = vec![None; schema.len()];
        for (position, limit) in within {
            limits[*position] = Some(*limit);
        }
        let is_close = |kept: &[Option<Value>], next: &[Option<Value>]| {
            let attributes = schema.attributes().iter().zip(&limits);
            attributes.zip(kept.iter().zip(next)).all(|((attribute, limit), values)| match (limit, values) {
                (Some(limit), (Some(kept), Some(next))) => apart(attribute, kept, next) <= *limit,
                (_, (kept, next)) => kept == next,
            })
        };
        let (mut values, mut numbers) = (Vec::new(), Vec::new());
        let mut kept: Option<&[Option<Value>]> = None;
        for (index, observation) in (0..).zip(self.iter()) {
            let is_last = index as usize + 1 == self.len();
            if is_last || kept.is_none_or(|kept| !is_close(kept, observation)) {
                kept = Some(observation);
                values.extend_from_slice(observation);
                numbers.push(index);
            }
        }
        (Self { values, n_attributes: self.n_attributes }, numbers)
    }
}

/// How far two values are apart, in the attribute's own units.
fn apart(attribute: &Attribute, one: &Value, other: &Value) -> f64 {
    match (&attribute.kind, one, other) {
        (Kind::Number { .. }, Value::Number(one), Value::Number(other)) => (one - other).abs(),
        (Kind::Number { scale } | Kind::Cyclic { scale, .. }, ..) => attribute.delta(one, other) * scale,
        (Kind::Category, ..) => attribute.delta(one, other),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value as Json, json};

    use super::*;
    use crate::document::{Faults, Place};

    fn kept(schema: &Schema, within: &[(usize, f64)], seen: &Json) -> Vec<u32> {
        let seen = Demonstration::read(schema, &Place::root(seen), &mut Faults::default()).unwrap();
        let (kept, numbers) = seen.collapsed(schema, within);
        assert!(kept.iter().zip(&numbers).all(|(kept, number)| kept == seen.observation(*number as usize)));
        numbers
    }

    #[test]
    fn what_stays_close_to_the_last_one_kept_is_dropped_but_for_the_first_and_the_last() {
        let attributes =
            [Attribute::number("x").with_scale(10.0), Attribute::category("door"), Attribute::cyclic("angle", 360.0)];
        let schema = Schema::new(attributes).unwrap();
        let creeping = json!([{"x": 0}, {"x": 0.25}, {"x": 0.5}, {"x": 0.75}, {"x": 1}, {"x": 1.25}]);
        // Slowly, it gets away all the same: it is the last one kept that counts.
        assert_eq!(kept(&schema, &[(0, 0.5)], &creeping), [0, 3, 5]);
        assert_eq!(kept(&schema, &[(0, 0.0)], &creeping), [0, 1, 2, 3, 4, 5]);
        assert_eq!(kept(&schema, &[(0, 9.0)], &creeping), [0, 5]);
        let other = json!([{"x": 0}, {"x": 0, "door": "a"}, {"x": 0.1, "door": "a"}, {"door": "a"}, {"door": "b"}, {"door": "b"}, {}]);
        assert_eq!(kept(&schema, &[(0, 0.5)], &other), [0, 1, 3, 4, 6]);
        let round = json!([{"angle": 359}, {"angle": 1}, {"angle": 5}, {"angle": 6}]);
        assert_eq!(kept(&schema, &[(2, 3.0)], &round), [0, 2, 3]);
        assert_eq!(kept(&schema, &[(0, 1.0)], &json!([{"x": 1}])), [0]);
    }
}
