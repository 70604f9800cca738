//! Nodes of expressions, with names looked up.

use std::collections::HashSet;
use std::sync::Arc;

use super::datum::Datum;

/// A part of an expression.
#[derive(Clone, Debug)]
pub(super) struct Node {
    /// Where it stands in the text: that many bytes come before it.
    pub(super) offset: u32,
    pub(super) kind: Kind,
}

/// What a node is.
#[derive(Clone, Debug)]
pub(super) enum Kind {
    Constant(Datum<'static>),
    /// The variable with this number.
    Variable(usize),
    /// What a macro goes through, or has so far: the outermost has the number 0.
    Local(usize),
    Not(Box<Node>),
    Negate(Box<Node>),
    And(Box<[Node; 2]>),
    Or(Box<[Node; 2]>),
    Conditional(Box<[Node; 3]>),
    Binary(Operation, Box<[Node; 2]>),
    /// Whether the value is one of many constants.
    OneOf(Box<Node>, Arc<HashSet<Datum<'static>>>),
    List(Box<[Node]>),
    Call(Function, Box<[Node]>),
    Fold(Box<Fold>),
}

/// An operator of two values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Operation {
    Add,
    Subtract,
    Multiply,
    Divide,
    Modulo,
    Equal,
    NotEqual,
    Less,
    LessOrEqual,
    Greater,
    GreaterOrEqual,
    In,
    Index,
}

/// A function.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Function {
    Size,
    Int,
    Double,
    Text,
    StartsWith,
    EndsWith,
    Contains,
    Greatest,
    Least,
    Abs,
    Sign,
    Floor,
    Ceil,
    Round,
    Trunc,
    /// What a macro asks before each item: whether there was an error, or it is true.
    NotStrictlyFalse,
}

/// What a macro is: something that changes with each item of a list.
#[derive(Clone, Debug)]
pub(super) struct Fold {
    /// The list.
    pub(super) range: Node,
    /// What there is before the first item.
    pub(super) first: Node,
    /// Whether to go on; there are two more locals, the item and what there is so far.
    pub(super) go_on: Node,
    /// What there is after the item.
    pub(super) step: Node,
    /// What is made of it in the end; the item is null.
    pub(super) result: Node,
}

impl Node {
    /// About how many nodes an evaluation comes to at most, where a list whose length is not known counts as one of a hundred.
    pub(super) fn work(&self) -> u64 {
        const UNKNOWN_LEN: u64 = 100;
        let len = |node: &Node| match &node.kind {
            Kind::Constant(Datum::List(list)) => list.len() as u64,
            Kind::List(items) => items.len() as u64,
            _ => UNKNOWN_LEN,
        };
        let sum = |nodes: &[Node]| nodes.iter().fold(1u64, |sum, node| sum.saturating_add(node.work()));
        match &self.kind {
            Kind::Constant(_) | Kind::Variable(_) | Kind::Local(_) => 1,
            Kind::Not(node) | Kind::Negate(node) | Kind::OneOf(node, _) => 1 + node.work(),
            Kind::Conditional(nodes) => sum(&**nodes),
            Kind::Binary(Operation::In, nodes) => sum(&**nodes).saturating_add(len(&nodes[1])),
            Kind::And(nodes) | Kind::Or(nodes) | Kind::Binary(_, nodes) => sum(&**nodes),
            Kind::List(nodes) | Kind::Call(_, nodes) => sum(nodes),
            Kind::Fold(fold) => {
                let once = fold.range.work().saturating_add(fold.first.work()).saturating_add(fold.result.work());
                let each = fold.go_on.work().saturating_add(fold.step.work());
                once.saturating_add(each.saturating_mul(len(&fold.range)))
            }
        }
    }

    /// How many nodes lie between this one and the furthest below it.
    pub(super) fn depth(&self) -> usize {
        1 + self.children().map(Node::depth).max().unwrap_or(0)
    }

    /// The numbers of the variables below it, as often as they stand there.
    pub(super) fn collect_reads(&self, reads: &mut Vec<usize>) {
        if let Kind::Variable(number) = self.kind {
            reads.push(number);
        }
        self.children().for_each(|node| node.collect_reads(reads));
    }

    /// The constants that it may give.
    pub(super) fn collect_results<'n>(&'n self, found: &mut Vec<(u32, &'n Datum<'static>)>) {
        match &self.kind {
            Kind::Constant(constant) => found.push((self.offset, constant)),
            Kind::Conditional(nodes) => nodes[1..].iter().for_each(|node| node.collect_results(found)),
            _ => {}
        }
    }

    fn children(&self) -> impl Iterator<Item = &Self> {
        let (nodes, fold): (&[Self], Option<&Fold>) = match &self.kind {
            Kind::Constant(_) | Kind::Variable(_) | Kind::Local(_) => (&[], None),
            Kind::Not(node) | Kind::Negate(node) | Kind::OneOf(node, _) => (std::slice::from_ref(&**node), None),
            Kind::And(nodes) | Kind::Or(nodes) | Kind::Binary(_, nodes) => (&**nodes, None),
            Kind::Conditional(nodes) => (&**nodes, None),
            Kind::List(nodes) | Kind::Call(_, nodes) => (nodes, None),
            Kind::Fold(fold) => (&[], Some(fold)),
        };
        let folded =
            fold.into_iter().flat_map(|fold| [&fold.range, &fold.first, &fold.go_on, &fold.step, &fold.result]);
        nodes.iter().chain(folded)
    }
}
