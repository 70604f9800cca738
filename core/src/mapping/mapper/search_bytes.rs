//! How much memory a search will take at most.

use super::{HeuristicName, Mapper, Settings, way_bytes};
use crate::mapping::Problem;
use crate::mapping::heuristic::abstraction::Abstracted;
use crate::mapping::heuristic::projected::{self, TableRoom};
use crate::mapping::search::{astar, banded, best_first, layered, sweep};

impl Mapper {
    /// About how much memory a search takes at most, in bytes: its budget, or less if all nodes of `problem` take less. Most
    /// searches look at a small part of the nodes. With this as its budget, a search finds what it finds with the one in `settings`.
    ///
    /// # Panics
    ///
    /// If `problem` is of another model.
    #[must_use]
    pub fn search_bytes(&self, problem: &Problem<'_>, settings: Settings) -> usize {
        self.check(problem);
        let Settings { heuristic, budget, .. } = settings;
        let model = &*self.model;
        if model.is_lazy() {
            return budget.max_bytes;
        }
        let n_observations = problem.demonstration.len();
        let n_nodes = model.graph().n_states().saturating_mul(n_observations);
        let (tables, are_all_in_columns) =
            projected::most_bytes(&self.projections, problem, TableRoom::within(budget.max_bytes));
        let is_layered = are_all_in_columns
            && n_nodes <= self.patience.max_layered_nodes
            && layered::is_within(budget, problem, n_nodes);
        let n_bytes = match heuristic {
            // Tables have a quarter of the budget, and it half.
            HeuristicName::Default if is_layered => 2 * layered::bytes_for(model, n_nodes).max(2 * tables),
            HeuristicName::Default => {
                let search = best_first::most_bytes(model, n_observations)
                    .max(banded::most_bytes(model, n_observations))
                    .max(sweep::most_bytes(model, n_observations));
                let abstracted = if self.may_abstract() {
                    // It has half of what the tables leave.
                    2 * Abstracted::most_bytes(self.max_classes(), problem)
                } else {
                    0
                };
                search.saturating_add(2 * tables).saturating_add(abstracted)
            }
            HeuristicName::None => best_first::most_bytes(model, n_observations),
            HeuristicName::Paper => astar::most_bytes(n_nodes).max(4 * tables),
        };
        budget.max_bytes.min(n_bytes.saturating_add(way_bytes(problem)))
    }
}
