//! What the backward search knows of each node.

/// By class and observation, what it costs to go on, as far as that is known, in memory that is used again: most nodes are never looked at, and
/// to write all of them anew would take as long as the search. They are negative until they are closed.
#[derive(Debug, Default)]
pub(in crate::mapping) struct KnownCosts {
    /// [`UNKNOWN`] but for those in `known`, in the order of nodes' numbers, and perhaps of more.
    costs: Vec<f64>,
    /// Where something is known.
    known: Vec<ClassNode>,
    n_classes: usize,
    /// Binary digits of a node's number that are the observation's; those before them are the class's.
    shift: u32,
}

/// The number of a node.
pub(super) type ClassNode = u32;

const UNKNOWN: f64 = f64::NEG_INFINITY;

impl KnownCosts {
    /// How much memory a node takes of which something is known, in bytes, besides what each node takes.
    pub(super) const NODE_BYTES: usize = size_of::<ClassNode>();

    /// How much memory nodes take of which nothing is known, in bytes.
    pub(super) fn bytes_for(n_classes: usize, n_observations: usize) -> usize {
        n_classes.saturating_mul(n_observations.next_power_of_two()).saturating_mul(size_of::<f64>())
    }

    /// How much memory they take, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        Self::bytes_for(self.n_classes, 1 << self.shift) + self.known.len() * Self::NODE_BYTES
    }

    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        self.costs.capacity() * size_of::<f64>() + self.known.capacity() * Self::NODE_BYTES
    }

    /// Forgets what was known, for so many classes and observations.
    pub(super) fn prepare(&mut self, n_classes: usize, n_observations: usize) {
        self.known.drain(..).for_each(|node| self.costs[node as usize] = UNKNOWN);
        (self.n_classes, self.shift) = (n_classes, n_observations.next_power_of_two().ilog2());
        let n_nodes = n_classes << self.shift;
        if self.costs.len() < n_nodes {
            self.costs.resize(n_nodes, UNKNOWN);
        }
    }

    /// The number of a node.
    #[inline]
    pub(super) fn number_of(&self, class: usize, i: usize) -> ClassNode {
        #[expect(clippy::cast_possible_truncation, reason = "there are fewer than 2^32 nodes")]
        let number = (class << self.shift | i) as ClassNode;
        number
    }

    /// The class and the observation of a node.
    #[inline]
    pub(super) fn node_of(&self, number: ClassNode) -> (usize, usize) {
        ((number >> self.shift) as usize, (number & ((1 << self.shift) - 1)) as usize)
    }

    #[inline]
    pub(super) fn at(&self, number: ClassNode) -> f64 {
        self.costs[number as usize]
    }

    /// Takes note of a cost, if it is less than what is known. Says whether it is.
    #[inline]
    pub(super) fn lower(&mut self, number: ClassNode, cost: f64) -> bool {
        let known = &mut self.costs[number as usize];
        let is_less = cost < known.abs();
        if is_less {
            if *known == UNKNOWN {
                self.known.push(number);
            }
            *known = -cost;
        }
        is_less
    }

    /// The cost of a node is the least.
    #[inline]
    pub(super) fn close(&mut self, number: ClassNode) {
        let known = &mut self.costs[number as usize];
        *known = known.abs();
    }
}
