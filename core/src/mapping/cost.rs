//! The cost of a mapping, summed without the error of long sums.

use serde::{Deserialize, Serialize};

use super::{Move, Problem};
use crate::model::Space;

/// How much more than a limit a mapping may cost before it is dropped, relatively: more than sums of 100,000 terms differ by
/// rounding.
pub(super) const SLACK: f64 = 1e-9;

/// What a mapping costs: `C = C_a + C_s`, and what its end costs. Dimensionless; finite, at least 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Cost {
    /// The whole, `actions + distance + end`.
    #[cfg_attr(feature = "openapi", schema(example = 48.2))]
    pub total: f64,
    /// Costs of the actions taken, `C_a`.
    #[cfg_attr(feature = "openapi", schema(example = 7.2))]
    pub actions: f64,
    /// Weighted distances between observed and own states, one per step, `C_s`.
    #[cfg_attr(feature = "openapi", schema(example = 41.0))]
    pub distance: f64,
    /// What the weighted distance of the last state to the last observation costs once more: times the `end_weight` of the request.
    #[cfg_attr(feature = "openapi", schema(example = 0.0))]
    pub end: f64,
}

/// Sums the cost of a mapping step by step: exactly, to within an ulp, and then to the 15 significant digits that a float
/// holds of a decimal. Eighteen actions of 0.3 cost 5.4.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct CostSum {
    actions: CompensatedSum,
    distance: CompensatedSum,
    /// Of all steps, and of the end once that was added.
    total: CompensatedSum,
    end: f64,
}

impl CostSum {
    /// Adds a step's costs.
    pub(super) fn add(&mut self, action_cost: f64, distance: f64) {
        self.actions.add(action_cost);
        self.distance.add(distance);
        self.total.add(action_cost);
        self.total.add(distance);
    }

    /// Adds what ending costs, after all steps.
    pub(super) fn end(&mut self, cost: f64) {
        self.end = cost;
        self.total.add(cost);
    }

    /// The sums so far.
    pub(super) fn cost(&self) -> Cost {
        let (actions, distance) = (as_decimal(self.actions), as_decimal(self.distance));
        Cost { total: self.total(), actions, distance, end: self.end }
    }

    /// What all is that was added so far.
    pub(super) fn total(&self) -> f64 {
        as_decimal(self.total)
    }
}

/// Costs that are closer than this, as a part of them, are the same: they are told to 15 significant digits.
pub(super) const ROUNDING: f64 = 1e-14;

/// How much sums of the same costs differ, as a part of them, by the order in which a search of `n_observations` adds them up. It does
/// not look for what is cheaper by less, so that it need not go through all mappings of equal cost.
pub(super) fn rounding_of_sums(n_observations: usize) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "there are at most MAX_OBSERVATIONS")]
    let n_steps = n_observations as f64;
    // Each addition may be half a bit off, either way.
    f64::EPSILON * (8.0 + n_steps / 16.0)
}

/// What the action of each of `moves` costs in `space`; 0 without one.
pub(super) fn action_costs(problem: &Problem<'_>, space: &impl Space, moves: &[Move]) -> Vec<f64> {
    let mut from = 0;
    let costs = moves.iter().map(|step| {
        let from = std::mem::replace(&mut from, step.state);
        step.action.map_or(0.0, |action| problem.body.step_cost(space, from, action, step.state))
    });
    costs.collect()
}

/// The cost of `moves` in `space`, whose actions cost so much.
pub(super) fn cost_of(problem: &Problem<'_>, space: &impl Space, moves: &[Move], action_costs: &[f64]) -> Cost {
    let (mut sum, recurrence) = (CostSum::default(), problem.recurrence());
    for (step, action_cost) in moves.iter().zip(action_costs) {
        let terms = problem.distances.terms(step.observation as usize, space.row(step.state));
        // As a step's terms are told: what it pays is their sum.
        let distance = terms.fold(0.0, |sum, (_, term)| sum + recurrence.paid(step.kind, term));
        sum.add(*action_cost, distance);
    }
    let end = moves.last().map_or(0.0, |step| problem.end_cost(space.row(step.state)));
    sum.end(end);
    sum.cost()
}

/// A sum with a running compensation for lost low-order bits (Neumaier 1974).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct CompensatedSum {
    sum: f64,
    compensation: f64,
}

impl CompensatedSum {
    fn add(&mut self, term: f64) {
        let sum = self.sum + term;
        self.compensation +=
            if self.sum.abs() >= term.abs() { (self.sum - sum) + term } else { (term - sum) + self.sum };
        self.sum = sum;
    }

    fn value(self) -> f64 {
        self.sum + self.compensation
    }
}

/// The sum, rounded to 15 significant digits.
fn as_decimal(sum: CompensatedSum) -> f64 {
    /// Powers of ten that are floats, so that dividing by them rounds correctly.
    const POWERS: [f64; 23] = [
        1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19,
        1e20, 1e21, 1e22,
    ];
    let sum = sum.value();
    if sum == 0.0 {
        return sum;
    }
    let n_decimals = if (POWERS[0]..POWERS[15]).contains(&sum) {
        // What most costs are, and this is sooner told than by a logarithm.
        Some(15 - POWERS[..15].partition_point(|power| *power <= sum))
    } else {
        #[expect(clippy::cast_possible_truncation, reason = "the logarithm of a float is below 309")]
        usize::try_from(14 - sum.log10().floor() as i32).ok()
    };
    match n_decimals.and_then(|n_decimals| POWERS.get(n_decimals)) {
        Some(scale) => (sum * scale).round() / scale,
        None => sum,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_small_costs_add_up_exactly() {
        let mut sum = CostSum::default();
        for n in 1..=100_u32 {
            sum.add(0.3, 2.1);
            let decimal = |tenths: u32| f64::from(tenths) / 10.0;
            let expected =
                Cost { total: decimal(24 * n), actions: decimal(3 * n), distance: decimal(21 * n), end: 0.0 };
            assert_eq!(sum.cost(), expected, "after {n} steps");
        }
        assert_eq!(sum.cost().actions, 30.0);
    }

    #[test]
    fn a_sum_is_rounded_to_15_digits_whatever_its_size() {
        let written = |value: f64| format!("{value:.14e}").parse::<f64>().unwrap();
        let powers = (-8..15).map(|power| 10_f64.powi(power));
        for value in
            powers.flat_map(|power| [power.next_down(), power, power.next_up(), 3.3 * power, power * 29.0 / 3.0])
        {
            let rounded = as_decimal(CompensatedSum { sum: value, compensation: 0.0 });
            assert_eq!(rounded.to_bits(), written(value).to_bits(), "{value:e}");
        }
    }

    #[test]
    fn sums_out_of_the_reach_of_decimals_are_left_alone() {
        for term in [0.0, 1e-12, 1e150] {
            let mut sum = CostSum::default();
            sum.add(0.0, term);
            assert_eq!(sum.total().to_bits(), term.to_bits());
        }
    }
}
