//! The long lists of a table in compact form, valid or not.

use super::raw::{Distinct, Raw};
use crate::attribute::{MAX_COST, Schema};
use crate::document::{Faults, Path};
use crate::model::{OwnCost, Transition};

/// Most states that can be told apart by an index, with one index to spare.
pub(super) const MAX_STATES: usize = u32::MAX as usize - 1;

/// Most transitions that can be told apart by an index.
pub(super) const MAX_TRANSITIONS: usize = u32::MAX as usize - 1;

/// The paths of the items of a list: the list is one array, or several arrays on lines of their own.
#[derive(Debug, Default)]
pub(in crate::model) struct ItemPaths(Vec<Run>);

/// Arrays of `n_each` items on lines that follow one another.
#[derive(Debug)]
struct Run {
    first_item: usize,
    /// The first line; `None` in a document that is not made of lines.
    line: Option<u64>,
    n_lines: u64,
    n_each: usize,
    /// Whether the array is a member of the model's dynamics, not of a line of its own.
    is_in_model: bool,
}

impl ItemPaths {
    /// Notes where the `n_items` items from `first_item` on stand.
    pub(super) fn add(&mut self, first_item: usize, n_items: usize, line: Option<u64>, is_in_model: bool) {
        if n_items == 0 {
            return;
        }
        if let Some(last) = self.0.last_mut()
            && (last.is_in_model, is_in_model) == (false, false)
            && last.n_each == n_items
            && last.line.map(|line| line + last.n_lines) == line
        {
            last.n_lines += 1;
            return;
        }
        self.0.push(Run { first_item, line, n_lines: 1, n_each: n_items, is_in_model });
    }

    /// Calls `follow` with the path of the item `item` of the list called `list`.
    pub(in crate::model) fn with_path<R>(&self, list: &str, item: usize, follow: impl FnOnce(&Path<'_>) -> R) -> R {
        let run = &self.0[self.0.partition_point(|run| run.first_item <= item) - 1];
        let within = item - run.first_item;
        let n_lines_before = (within / run.n_each) as u64;
        let root = run.line.map_or(Path::Root, |line| Path::Line(line + n_lines_before));
        let dynamics = Path::Member(&root, "dynamics");
        let parent = if run.is_in_model { &dynamics } else { &root };
        follow(&Path::Item(&Path::Member(parent, list), within % run.n_each))
    }
}

/// Adds an item to a column that begins once one says something.
pub(in crate::model) fn add_to_column<T: Copy>(column: &mut Vec<T>, n_before: usize, item: T, usual: T, is_new: bool) {
    if is_new {
        // Those before it said nothing.
        column.resize(n_before, usual);
    }
    if is_new || !column.is_empty() {
        column.push(item);
    }
}

/// What the cost and the probability of a transition take: where they are listed, in the graph, and while that is sorted.
pub(in crate::model) const COLUMNS_BYTES: usize = 4 * size_of::<f64>() + size_of::<(Transition, OwnCost, f64)>();

/// Listed states: one row each, of any length and content.
#[derive(Debug, Default)]
pub(in crate::model) struct RawStates {
    /// How many there are. Those beyond the limit are only counted.
    pub(in crate::model) n_states: usize,
    /// The distinct values of each column. At most [`Schema::MAX_ATTRIBUTES`].
    pub(in crate::model) columns: Vec<Distinct>,
    /// Per row, the number of each value in its column. Shape `[n_states, width]` unless lengths differ.
    pub(in crate::model) cells: Vec<u32>,
    /// The length of the first row.
    pub(in crate::model) width: usize,
    /// The length of each row, once one differs from the first; [`Self::NO_ROW`] for a value that is not an array.
    pub(in crate::model) lens: Option<Vec<u32>>,
    /// The first values that are not arrays.
    pub(in crate::model) no_rows: Vec<Raw>,
    /// Where each row stands.
    pub(in crate::model) item_paths: ItemPaths,
}

impl RawStates {
    pub(in crate::model) const NO_ROW: u32 = u32::MAX;

    /// About how much memory they take, in bytes, now and in the compiled model.
    pub(super) fn size_bytes(&self) -> usize {
        /// The offset of the transitions of a state, in two lists.
        const STATE_BYTES: usize = 2 * size_of::<u32>();
        let columns: usize = self.columns.iter().map(Distinct::size_bytes).sum();
        columns + size_of_val(self.cells.as_slice()) + self.n_states * STATE_BYTES
    }

    /// Ends a row of `len` cells, of which the first [`Schema::MAX_ATTRIBUTES`] were added.
    pub(super) fn end_row(&mut self, len: usize) {
        if self.n_states == 0 {
            self.width = len;
        }
        let is_different = len != self.width || len > Schema::MAX_ATTRIBUTES;
        if is_different || self.lens.is_some() {
            let len = u32::try_from(len).unwrap_or(Self::NO_ROW - 1);
            self.lens().push(len);
        }
        self.n_states += 1;
    }

    /// Adds a value that should be a row and is not.
    pub(super) fn add_no_row(&mut self, found: Raw<&str>) {
        self.lens().push(Self::NO_ROW);
        self.n_states += 1;
        if self.no_rows.len() < Faults::MAX_LISTED {
            self.no_rows.push(found.owned());
        }
    }

    fn lens(&mut self) -> &mut Vec<u32> {
        #[expect(
            clippy::cast_possible_truncation,
            reason = "rows longer than the most attributes are noted as they come"
        )]
        self.lens.get_or_insert_with(|| vec![self.width as u32; self.n_states])
    }
}

/// The index of a state, or what was found instead.
pub(in crate::model) type RawIndex = Result<u32, Raw>;

/// A value that cannot be a transition.
#[derive(Debug)]
pub(in crate::model) enum NoTransition {
    /// A value that is not an array.
    Other(Raw),
    /// An array of this many items, other than three to five.
    Array(usize),
    /// One of the parts is not of the right kind, or there are more distinct actions than names and indices.
    Parts(RawIndex, Raw, RawIndex, RawTerms),
}

/// The probability and the cost of a transition; null if left out.
#[derive(Debug)]
pub(in crate::model) struct RawTerms {
    pub(in crate::model) probability: Raw,
    pub(in crate::model) cost: Raw,
}

impl RawTerms {
    pub(super) const NONE: Self = Self { probability: Raw::Null, cost: Raw::Null };

    /// The probability, 1 if it is left out; `None` if it is none.
    pub(in crate::model) fn probability(&self) -> Option<f64> {
        if self.probability == Raw::Null {
            return Some(1.0);
        }
        self.probability.number().filter(|probability| *probability > 0.0 && *probability <= 1.0)
    }

    /// The transition's own cost; `None` if what is there is no cost.
    pub(in crate::model) fn own_cost(&self) -> Option<OwnCost> {
        if self.cost == Raw::Null {
            return Some(OwnCost::NONE);
        }
        self.cost.number().filter(|cost| (0.0..=MAX_COST).contains(cost)).map(|cost| OwnCost::of(Some(cost + 0.0)))
    }
}

/// Listed transitions. Shape `[n_transitions]` by column: 10 bytes each, and eight more for each of the costs and probabilities, once one is
/// given.
#[derive(Debug, Default)]
pub(in crate::model) struct RawTransitions {
    /// How many there are. Those beyond the limit are only counted.
    pub(in crate::model) n_transitions: usize,
    /// The state that each leaves; [`Self::NOWHERE`] for a value that cannot be a transition.
    pub(in crate::model) from: Vec<u32>,
    /// An index into `references` for each.
    pub(in crate::model) action: Vec<u16>,
    /// The state that each leads to.
    pub(in crate::model) to: Vec<u32>,
    /// Empty if all are 1.
    pub(in crate::model) probabilities: Vec<f64>,
    /// Empty if no transition has a cost of its own.
    pub(in crate::model) own_costs: Vec<OwnCost>,
    /// Distinct ways to refer to an action.
    pub(in crate::model) references: Distinct,
    /// The first values that cannot be transitions.
    pub(in crate::model) faulty: Vec<NoTransition>,
    /// How many values cannot be transitions.
    pub(in crate::model) n_faulty: usize,
    /// Where each transition stands.
    pub(in crate::model) item_paths: ItemPaths,
}

impl RawTransitions {
    pub(in crate::model) const NOWHERE: u32 = u32::MAX;

    /// About how much memory they take, in bytes, now and in the compiled model.
    pub(super) fn size_bytes(&self) -> usize {
        /// A transition is listed, and in the graph.
        const TRANSITION_BYTES: usize = 10 + size_of::<Transition>();
        let has_columns = !(self.probabilities.is_empty() && self.own_costs.is_empty());
        let columns_bytes = if has_columns { COLUMNS_BYTES } else { 0 };
        self.from.len() * (TRANSITION_BYTES + columns_bytes)
    }

    pub(super) fn add(&mut self, from: RawIndex, reference: u32, to: RawIndex, terms: RawTerms) {
        match (from, u16::try_from(reference), to, terms.probability().zip(terms.own_cost())) {
            (Ok(from), Ok(reference), Ok(to), Some((probability, own_cost))) if from != Self::NOWHERE => {
                let n_before = self.from.len();
                add_to_column(&mut self.probabilities, n_before, probability, 1.0, probability < 1.0);
                add_to_column(&mut self.own_costs, n_before, own_cost, OwnCost::NONE, own_cost.get().is_some());
                self.from.push(from);
                self.action.push(reference);
                self.to.push(to);
                self.n_transitions += 1;
            }
            (from, _, to, _) => {
                let reference = self.references.values()[reference as usize].clone();
                self.add_faulty(NoTransition::Parts(from, reference, to, terms));
            }
        }
    }

    pub(super) fn add_faulty(&mut self, faulty: NoTransition) {
        let n_before = self.from.len();
        add_to_column(&mut self.probabilities, n_before, 1.0, 1.0, false);
        add_to_column(&mut self.own_costs, n_before, OwnCost::NONE, OwnCost::NONE, false);
        self.from.push(Self::NOWHERE);
        self.action.push(0);
        self.to.push(0);
        self.n_transitions += 1;
        self.n_faulty += 1;
        if self.faulty.len() < Faults::MAX_LISTED {
            self.faulty.push(faulty);
        }
    }
}
