//! The ways to the survivors, as a tree of which only what survivors hang on is kept.

use crate::mapping::{Move, MoveKind};
use crate::model::{ActionIdx, StateIdx};

/// A place in the tree. Ids of removed nodes are given out again.
pub(super) type NodeId = u32;

/// Stands for "no node".
pub(super) const NO_NODE: NodeId = NodeId::MAX;

/// Stands for "no action".
pub(super) const NO_ACTION: ActionIdx = ActionIdx::MAX;

/// The ways to the survivors, from the root on.
#[derive(Debug, Default)]
pub(super) struct Tree {
    nodes: Vec<TreeNode>,
    free: Vec<NodeId>,
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct TreeNode {
    pub(super) parent: NodeId,
    pub(super) state: StateIdx,
    pub(super) observation: u32,
    pub(super) n_children: u32,
    /// All children's ids, combined by exclusive or: of a node with one child, that child.
    pub(super) children: NodeId,
    pub(super) action: ActionIdx,
}

impl Tree {
    /// How many nodes there are.
    pub(super) fn n_alive(&self) -> usize {
        self.nodes.len() - self.free.len()
    }

    pub(super) fn get(&self, id: NodeId) -> &TreeNode {
        &self.nodes[id as usize]
    }

    fn get_mut(&mut self, id: NodeId) -> &mut TreeNode {
        &mut self.nodes[id as usize]
    }

    pub(super) fn clear(&mut self) {
        self.nodes.clear();
        self.free.clear();
    }

    /// Adds a root.
    pub(super) fn plant(&mut self, observation: u32, state: StateIdx) -> NodeId {
        self.place(TreeNode { parent: NO_NODE, action: NO_ACTION, state, observation, ..TreeNode::default() })
    }

    /// Adds a node below its parent.
    pub(super) fn add(&mut self, node: TreeNode) -> NodeId {
        let id = self.place(node);
        let parent = self.get_mut(node.parent);
        parent.n_children += 1;
        parent.children ^= id;
        id
    }

    fn place(&mut self, node: TreeNode) -> NodeId {
        if let Some(id) = self.free.pop() {
            *self.get_mut(id) = node;
            return id;
        }
        self.nodes.push(node);
        NodeId::try_from(self.nodes.len() - 1).expect("memory ends before ids do")
    }

    /// The only child of a node that has just one.
    pub(super) fn only_child(&self, id: NodeId) -> Option<NodeId> {
        let node = self.get(id);
        (node.n_children == 1).then_some(node.children)
    }

    /// Removes a node that nothing hangs on, and so on up, but not the root.
    pub(super) fn cut_if_childless(&mut self, mut id: NodeId, root: NodeId) {
        while id != root && self.get(id).n_children == 0 {
            let parent_id = self.get(id).parent;
            let parent = self.get_mut(parent_id);
            parent.n_children -= 1;
            parent.children ^= id;
            self.release(id);
            id = parent_id;
        }
    }

    fn release(&mut self, id: NodeId) {
        // Not childless, so that it is not released twice.
        self.get_mut(id).n_children = u32::MAX;
        self.free.push(id);
    }

    /// Removes the parent of `id`, which becomes a root.
    pub(super) fn cut_above(&mut self, id: NodeId) {
        let parent = std::mem::replace(&mut self.get_mut(id).parent, NO_NODE);
        self.release(parent);
    }

    /// The step that leads from its parent to `id`.
    pub(super) fn step(&self, id: NodeId) -> Move {
        let node = self.get(id);
        let advances = self.get(node.parent).observation < node.observation;
        let (kind, action) = match (node.action, advances) {
            (NO_ACTION, _) => (MoveKind::Skip, None),
            (action, true) => (MoveKind::Match, Some(action)),
            (action, false) => (MoveKind::Extra, Some(action)),
        };
        Move { kind, action, observation: node.observation, state: node.state }
    }

    /// The steps from `root` to `id`.
    pub(super) fn path(&self, root: NodeId, mut id: NodeId) -> Vec<Move> {
        let mut steps = Vec::new();
        while id != root {
            steps.push(self.step(id));
            id = self.get(id).parent;
        }
        steps.reverse();
        steps
    }
}
