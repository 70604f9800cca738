//! Parts in which a body can go to and fro: strongly connected components.

use super::Reached;
use crate::interrupt::{Interrupted, Meter};

/// The strongly connected components of a graph, numbered so that no edge leads to a higher number.
#[derive(Debug)]
pub(super) struct Parts {
    /// By node, its component.
    pub(super) of: Vec<u32>,
    /// How many nodes each has.
    pub(super) n_nodes: Vec<u32>,
}

const NONE: u32 = u32::MAX;

impl Parts {
    /// Those of the ways between states that were reached. States that were not explored are parts by themselves.
    pub(super) fn of(reached: &Reached<'_>, meter: &mut Meter<'_>) -> Result<Self, Interrupted> {
        let n_explored = reached.ways.n_rows();
        let successors = |state: u32| if (state as usize) < n_explored { reached.ways.of(state as usize) } else { &[] };
        Self::of_graph(reached.n_states(), successors, |way| way.to, meter)
    }

    /// Those of a graph whose edges from each of its `n_nodes` nodes are given, each with where it leads. `O(n_nodes + n_edges)`.
    ///
    /// R. Tarjan, "Depth-First Search and Linear Graph Algorithms" (1972), with a stack of its own: a walk may be as deep as there are nodes.
    pub(super) fn of_graph<'e, E: 'e>(
        n_nodes: usize,
        edges: impl Fn(u32) -> &'e [E],
        to: impl Fn(&E) -> u32,
        meter: &mut Meter<'_>,
    ) -> Result<Self, Interrupted> {
        /// A node on the way that is walked.
        struct Frame {
            node: u32,
            /// How many nodes were entered before it.
            order: u32,
            /// How many of its edges were looked at.
            n_done: u32,
        }
        let mut parts = Self { of: vec![NONE; n_nodes], n_nodes: Vec::new() };
        // The first node entered that each is known to lead back to.
        let mut back = vec![NONE; n_nodes];
        let (mut frames, mut open): (Vec<Frame>, Vec<u32>) = (Vec::new(), Vec::new());
        let mut n_entered = 0;
        #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
        for root in 0..n_nodes as u32 {
            let mut entered = (back[root as usize] == NONE).then_some(root);
            loop {
                if let Some(node) = entered.take() {
                    meter.spend_or_stop(1)?;
                    back[node as usize] = n_entered;
                    frames.push(Frame { node, order: n_entered, n_done: 0 });
                    open.push(node);
                    n_entered += 1;
                }
                let Some(frame) = frames.last_mut() else { break };
                let node = frame.node as usize;
                for edge in &edges(frame.node)[frame.n_done as usize..] {
                    meter.spend_or_stop(1)?;
                    frame.n_done += 1;
                    let to = to(edge);
                    if back[to as usize] == NONE {
                        entered = Some(to);
                        break;
                    }
                    if parts.of[to as usize] == NONE {
                        back[node] = back[node].min(back[to as usize]);
                    }
                }
                if entered.is_some() {
                    continue;
                }
                if back[node] == frame.order {
                    parts.close(&mut open, frame.node);
                }
                frames.pop();
                if let Some(before) = frames.last()
                    && parts.of[node] == NONE
                {
                    let before = before.node as usize;
                    back[before] = back[before].min(back[node]);
                }
            }
        }
        Ok(parts)
    }

    /// Makes a component of the open nodes from `first` on.
    fn close(&mut self, open: &mut Vec<u32>, first: u32) {
        #[expect(clippy::cast_possible_truncation, reason = "no more than nodes")]
        let part = self.n_nodes.len() as u32;
        let mut n_nodes = 0;
        while let Some(node) = open.pop() {
            self.of[node as usize] = part;
            n_nodes += 1;
            if node == first {
                break;
            }
        }
        self.n_nodes.push(n_nodes);
    }

    /// By component, whether an edge leaves it.
    pub(super) fn can_be_left(&self, reached: &Reached<'_>) -> Vec<bool> {
        let mut can_be_left = vec![false; self.n_nodes.len()];
        for (from, ways) in reached.ways.iter().enumerate() {
            let part = self.of[from];
            if ways.iter().any(|way| self.of[way.to as usize] != part) {
                can_be_left[part as usize] = true;
            }
        }
        can_be_left
    }
}
