//! Which attributes a group misses.

use super::Abstracted;
use crate::interrupt::{Interrupted, Meter};
use crate::mapping::heuristic::abstraction::ClassIdx;
use crate::model::Rows;

impl Abstracted<'_> {
    /// Searches until it is known what mappings cost at least that begin in the most promising start. Gives the attributes that the group
    /// misses: that its cheapest way changes from a value that they no longer have.
    pub(in crate::mapping::heuristic::abstraction) fn solve_from_start(
        &mut self,
        meter: &mut Meter<'_>,
    ) -> Result<Vec<usize>, Interrupted> {
        let problem = self.problem;
        let alone = |row: &[u32]| {
            let columns = self.projected.columns.iter();
            let entries =
                columns.map(|own| self.projected.table.at(own.offset + row[own.projection.position] as usize, 0));
            entries.fold(0.0, |sum, entry| sum + entry.distance + entry.cost_to_go)
        };
        let starts = problem.starts.iter(problem.model);
        let Some((start, row)) = starts.min_by(|(_, row), (_, other)| alone(row).total_cmp(&alone(other))) else {
            return Ok(Vec::new());
        };
        self.settle(start, 0, f64::INFINITY, meter)?;
        let mut current = row.to_vec();
        let mut missed = Vec::new();
        for number in self.cheapest_way(self.abstraction.classes[start as usize], meter)? {
            let (from, to) = self.abstraction.states[number];
            let [row, row_after] = [from, to].map(|state| problem.model.states().row(state));
            for position in (0..row.len()).filter(|at| row[*at] != row_after[*at]) {
                if current[position] != row[position] && self.abstraction.positions.binary_search(&position).is_err() {
                    missed.push(position);
                }
                current[position] = row_after[position];
            }
        }
        missed.sort_unstable();
        missed.dedup();
        Ok(missed)
    }

    /// The ways that are gone from a class at the first observation to the end, by their numbers, if that is closed.
    fn cheapest_way(&self, start: ClassIdx, meter: &mut Meter<'_>) -> Result<Vec<usize>, Interrupted> {
        let (last, n_classes, ways) = (self.problem.last(), self.abstraction.n_classes(), &self.abstraction.ways);
        let ways_into = (0..n_classes).flat_map(|to| ways.range(to).map(move |number| (to, number)));
        let entries = ways_into.map(|(to, number)| (ways.items()[number].from, (to, number)));
        let ways_out: Rows<(usize, usize)> = Rows::try_of_entries(n_classes, entries, || meter.spend_or_stop(1))?;
        let (mut class, mut i) = (start as usize, 0);
        let mut gone = Vec::new();
        // Actions without cost could go on for ever.
        while gone.len() <= n_classes + last
            && let Some(cost) = self.closed_cost(class, i)
        {
            let moves = |class: usize, i: usize| self.closed_cost(class, i).map(|cost| self.moves_to(class, i, cost));
            if i < last && moves(class, i + 1).is_some_and(|moves| moves.advanced == cost) {
                i += 1;
                continue;
            }
            meter.spend_or_stop(1 + ways_out.of(class).len() as u64)?;
            let next = ways_out.of(class).iter().find_map(|(to, number)| {
                let way = self.kinds[ways.items()[*number].kind as usize];
                let matches = i < last && moves(*to, i + 1).is_some_and(|moves| moves.matched(way) == cost);
                let lingers = moves(*to, i).is_some_and(|moves| moves.extra(way) == cost);
                (matches || lingers).then_some((*to, i + usize::from(matches), *number))
            });
            let Some((to, next_i, number)) = next else { break };
            gone.push(number);
            (class, i) = (to, next_i);
        }
        Ok(gone)
    }
}
