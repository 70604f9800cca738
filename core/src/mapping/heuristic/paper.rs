//! The paper's estimate, `C_HC` + `C_HR` (Gudla & Huber, FLAIRS 2003). Not admissible; kept for reproduction.

use super::Heuristic;
use crate::mapping::Problem;

/// For a node `(i, s)`, let `j > i` be the observation still ahead that is closest to `s` (the earliest among equals). `C_HC`
/// removes the terms of `D(o_j, s)` that are not 0 one by one, largest first, adding what remains after each removal
/// and the least action cost; `C_HR` is `(n - j)` times the least action cost.
///
/// It overestimates where one action changes two attributes, and where the rest of the demonstration is better skipped.
pub(crate) struct Paper<'p> {
    problem: &'p Problem<'p>,
    least_action_cost: f64,
}

impl<'p> Paper<'p> {
    pub(crate) fn new(problem: &'p Problem<'p>) -> Self {
        Self { problem, least_action_cost: problem.body.least_cost() }
    }
}

impl Heuristic for Paper<'_> {
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64 {
        let (distances, last) = (&self.problem.distances, self.problem.last());
        let ahead = (observation + 1..=last).map(|j| (distances.distance(j, row), j));
        let Some((_, j)) = ahead.min_by(|(d, _), (other, _)| d.total_cmp(other)) else { return 0.0 };
        let mut terms: Vec<f64> = distances.terms(j, row).map(|(_, term)| term).filter(|term| *term > 0.0).collect();
        terms.sort_unstable_by(|a, b| b.total_cmp(a));
        let mut remaining: f64 = terms.iter().sum();
        let mut estimate = 0.0;
        for term in terms {
            remaining = (remaining - term).max(0.0);
            estimate += remaining + self.least_action_cost;
        }
        #[expect(clippy::cast_precision_loss, reason = "there are at most MAX_OBSERVATIONS")]
        let n_after = (last - j) as f64;
        estimate + n_after * self.least_action_cost
    }

    fn work(&self, observation: usize) -> u64 {
        1 + (self.problem.last() - observation) as u64
    }
}
