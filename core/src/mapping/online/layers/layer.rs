//! The cheapest ways to every state at one observation.

use super::ways_in::WaysIn;
use crate::mapping::distances::ObservedDistances;
use crate::model::StateIdx;

/// How a way comes to a node: the last of its links.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Link(u32);

impl Link {
    /// Of the root, and of states that no way leads to.
    pub(super) const NONE: Self = Self(0);
    /// From the same state in the layer before. What comes from [before the starts](Layer::before_starts) has this too.
    pub(super) const SKIP: Self = Self(1);

    /// From the layer before, by the way into the state that has this number.
    #[inline]
    pub(super) fn matched(way: usize) -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "memory ends before there are 2^30 ways")]
        let way = way as u32;
        Self(2 + 2 * way)
    }

    /// From the same layer.
    #[inline]
    pub(super) fn extra(way: usize) -> Self {
        Self(Self::matched(way).0 + 1)
    }

    #[inline]
    pub(super) fn is_within(self) -> bool {
        self.way().is_some() && self.0 % 2 == 1
    }

    /// The number of the way into the state, if it is one.
    #[inline]
    pub(super) fn way(self) -> Option<usize> {
        (self.0 as usize / 2).checked_sub(1)
    }

    /// The state that the node with this state comes from.
    #[inline]
    pub(super) fn from(self, ways_in: &WaysIn, state: StateIdx) -> StateIdx {
        self.way().map_or(state, |way| ways_in.sources(state)[way])
    }
}

/// A state at an observation, as part of a way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    pub(super) link: Link,
    /// How many nodes with a survivor come from it; [`Self::DEAD`] if no survivor hangs on it.
    pub(super) n_children: u32,
}

impl Node {
    pub(super) const DEAD: u32 = u32::MAX;
    pub(super) const ABSENT: Self = Self { link: Link::NONE, n_children: Self::DEAD };

    pub(super) fn is_alive(self) -> bool {
        self.n_children != Self::DEAD
    }
}

/// A number of a node as a layer keeps it: in a byte where all numbers fit, and the greatest is for [`Node::DEAD`].
pub(super) trait Number: Copy {
    fn of(number: u32) -> Self;

    fn get(self) -> u32;
}

impl Number for u8 {
    #[inline]
    fn of(number: u32) -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "the greatest is the greatest")]
        let number = number as Self;
        number
    }

    #[inline]
    fn get(self) -> u32 {
        if self == Self::MAX { u32::MAX } else { u32::from(self) }
    }
}

impl Number for u32 {
    #[inline]
    fn of(number: u32) -> Self {
        number
    }

    #[inline]
    fn get(self) -> u32 {
        self
    }
}

/// A [`Node`] in few bytes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Packed<N> {
    link: N,
    n_children: N,
}

impl<N: Number> From<Node> for Packed<N> {
    #[inline]
    fn from(Node { link, n_children }: Node) -> Self {
        Self { link: N::of(link.0), n_children: N::of(n_children) }
    }
}

impl<N: Number> Packed<N> {
    #[inline]
    pub(super) fn node(self) -> Node {
        Node { link: Link(self.link.get()), n_children: self.n_children.get() }
    }

    /// Counts a child of a node that is alive.
    #[inline]
    pub(super) fn add_child(&mut self) {
        self.n_children = N::of(self.n_children.get() + 1);
    }
}

/// The nodes of a layer.
#[derive(Debug)]
pub(super) enum Nodes {
    /// Shape `[n_states]`, if no node has so many ways that their numbers do not fit.
    Narrow(Vec<Packed<u8>>),
    /// Shape `[n_states]`, else.
    Wide(Vec<Packed<u32>>),
    /// Those that are alive, or were when they were gathered; in the order of their states.
    Few(Vec<(StateIdx, Node)>),
}

impl Nodes {
    /// The most ways into a state, or out of one, for which nodes are narrow: twice as many links with numbers, and twice as many children.
    const MOST_NARROW: usize = 126;

    /// How much memory a state takes at most, in bytes.
    pub(super) const MOST_BYTES_EACH: usize = size_of::<Packed<u32>>();

    /// None, of `n_states`.
    pub(super) fn absent(n_states: usize, ways_in: &WaysIn) -> Self {
        if ways_in.most <= Self::MOST_NARROW {
            Self::Narrow(vec![Node::ABSENT.into(); n_states])
        } else {
            Self::Wide(vec![Node::ABSENT.into(); n_states])
        }
    }

    /// How much memory a state takes, in bytes.
    pub(super) fn bytes_each(most_ways: usize) -> usize {
        if most_ways <= Self::MOST_NARROW { size_of::<Packed<u8>>() } else { Self::MOST_BYTES_EACH }
    }

    fn clear(&mut self) {
        match self {
            Self::Narrow(nodes) => nodes.fill(Node::ABSENT.into()),
            Self::Wide(nodes) => nodes.fill(Node::ABSENT.into()),
            Self::Few(nodes) => nodes.clear(),
        }
    }

    #[inline]
    fn get(&self, state: StateIdx) -> Node {
        match self {
            Self::Narrow(nodes) => nodes[state as usize].node(),
            Self::Wide(nodes) => nodes[state as usize].node(),
            Self::Few(nodes) => {
                nodes.binary_search_by_key(&state, |(state, _)| *state).map_or(Node::ABSENT, |at| nodes[at].1)
            }
        }
    }

    /// Changes the node of a state that there is one of.
    #[inline]
    pub(super) fn set(&mut self, state: StateIdx, node: Node) {
        match self {
            Self::Narrow(nodes) => nodes[state as usize] = node.into(),
            Self::Wide(nodes) => nodes[state as usize] = node.into(),
            Self::Few(nodes) => {
                let at = nodes.binary_search_by_key(&state, |(state, _)| *state);
                nodes[at.expect("what a survivor hangs on is kept")].1 = node;
            }
        }
    }

    /// Those that are alive, in the order of their states.
    fn alive(&self) -> Vec<(StateIdx, Node)> {
        fn among<N: Number>(nodes: &[Packed<N>]) -> Vec<(StateIdx, Node)> {
            let nodes = (0..).zip(nodes).map(|(state, node)| (state, node.node()));
            nodes.filter(|(_, node)| node.is_alive()).collect()
        }
        match self {
            Self::Narrow(nodes) => among(nodes),
            Self::Wide(nodes) => among(nodes),
            Self::Few(nodes) => nodes.iter().filter(|(_, node)| node.is_alive()).copied().collect(),
        }
    }

    pub(super) fn size_bytes(&self) -> usize {
        match self {
            Self::Narrow(nodes) => size_of_val(nodes.as_slice()),
            Self::Wide(nodes) => size_of_val(nodes.as_slice()),
            Self::Few(nodes) => nodes.capacity() * size_of::<(StateIdx, Node)>(),
        }
    }
}

/// The cheapest ways to every state at one observation: how each comes there.
#[derive(Debug)]
pub(super) struct Layer {
    /// Of the states to the observation.
    pub(super) observed: ObservedDistances,
    pub(super) nodes: Nodes,
    n_alive: usize,
    /// How many states there may be a way to; nothing was written of others. Else 0.
    n_reached: usize,
}

/// An array that a layer has no more use for, kept to be filled again.
#[derive(Debug)]
pub(super) struct Spare {
    nodes: Nodes,
    n_reached: usize,
}

impl Spare {
    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.nodes.size_bytes()
    }

    /// Nodes of which those out of reach are absent. As what is within reach only ever shrinks, those written of as many states as now are
    /// have nothing to be cleared.
    pub(super) fn cleared(mut self, n_reached: usize) -> Nodes {
        if self.n_reached != n_reached {
            self.nodes.clear();
        }
        self.nodes
    }
}

impl Layer {
    /// Of nodes that are alive at `n_reached` states, and absent at the others.
    pub(super) fn new(observed: ObservedDistances, nodes: Nodes, n_reached: usize) -> Self {
        Self { observed, nodes, n_alive: n_reached, n_reached }
    }

    /// What stands before the first observation's layer while the start is not decided: a node 0 from which all starts come, for nothing.
    pub(super) fn before_starts() -> Self {
        let root = Node { link: Link::NONE, n_children: 0 };
        Self { observed: ObservedDistances::default(), nodes: Nodes::Few(vec![(0, root)]), n_alive: 1, n_reached: 0 }
    }

    /// How many nodes survivors hang on.
    pub(super) fn n_alive(&self) -> usize {
        self.n_alive
    }

    #[inline]
    pub(super) fn node(&self, state: StateIdx) -> Node {
        self.nodes.get(state)
    }

    /// Makes a node the root: it comes from nowhere.
    pub(super) fn set_root(&mut self, state: StateIdx) {
        self.nodes.set(state, Node { link: Link::NONE, ..self.node(state) });
    }

    /// Counts a child of a node that is alive.
    pub(super) fn add_child(&mut self, state: StateIdx) {
        let node = self.node(state);
        self.nodes.set(state, Node { n_children: node.n_children + 1, ..node });
    }

    /// Takes off a child of a node, and gives how many are left.
    #[inline]
    pub(super) fn remove_child(&mut self, state: StateIdx) -> u32 {
        let node = self.node(state);
        let n_children = node.n_children - 1;
        self.nodes.set(state, Node { n_children, ..node });
        n_children
    }

    /// Lets a node die, and gives what it hung on by.
    #[inline]
    pub(super) fn kill(&mut self, state: StateIdx) -> Link {
        let node = self.node(state);
        self.n_alive -= 1;
        self.nodes.set(state, Node { n_children: Node::DEAD, ..node });
        node.link
    }

    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of::<Self>() + self.nodes.size_bytes() + self.observed.size_bytes()
    }

    /// Keeps only nodes that are alive, if that takes much less memory. Gives the array that is free then.
    pub(super) fn thin(&mut self) -> Option<Spare> {
        if 2 * self.n_alive * size_of::<(StateIdx, Node)>() > self.nodes.size_bytes() {
            return None;
        }
        let alive = Nodes::Few(self.nodes.alive());
        match std::mem::replace(&mut self.nodes, alive) {
            Nodes::Few(_) => None,
            nodes => Some(Spare { nodes, n_reached: self.n_reached }),
        }
    }

    /// What can be filled again.
    pub(super) fn into_spare(self) -> (Option<Spare>, ObservedDistances) {
        let spare = match self.nodes {
            Nodes::Few(_) => None,
            nodes => Some(Spare { nodes, n_reached: self.n_reached }),
        };
        (spare, self.observed)
    }
}
