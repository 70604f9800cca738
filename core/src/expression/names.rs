//! What operators and functions are called.

use cel::common::ast::operators;

use super::node::{Function, Operation};

const OPERATIONS: [(&str, Operation, &str); 13] = [
    (operators::ADD, Operation::Add, "+"),
    (operators::SUBSTRACT, Operation::Subtract, "-"),
    (operators::MULTIPLY, Operation::Multiply, "*"),
    (operators::DIVIDE, Operation::Divide, "/"),
    (operators::MODULO, Operation::Modulo, "%"),
    (operators::EQUALS, Operation::Equal, "=="),
    (operators::NOT_EQUALS, Operation::NotEqual, "!="),
    (operators::LESS, Operation::Less, "<"),
    (operators::LESS_EQUALS, Operation::LessOrEqual, "<="),
    (operators::GREATER, Operation::Greater, ">"),
    (operators::GREATER_EQUALS, Operation::GreaterOrEqual, ">="),
    (operators::IN, Operation::In, "in"),
    (operators::INDEX, Operation::Index, "[]"),
];

/// The operator of two values that the parser calls so.
pub(super) fn operation(name: &str) -> Option<Operation> {
    OPERATIONS.into_iter().find(|(known, _, _)| *known == name).map(|(_, operation, _)| operation)
}

/// How an operator is written.
pub(super) fn sign(operation: Operation) -> &'static str {
    OPERATIONS.into_iter().find(|(_, known, _)| *known == operation).map_or("", |(_, _, sign)| sign)
}

/// The functions by their names, and whether they are of the library `math`.
const FUNCTIONS: [(&str, Function, bool); 15] = [
    ("size", Function::Size, false),
    ("int", Function::Int, false),
    ("double", Function::Double, false),
    ("string", Function::Text, false),
    ("startsWith", Function::StartsWith, false),
    ("endsWith", Function::EndsWith, false),
    ("contains", Function::Contains, false),
    ("greatest", Function::Greatest, true),
    ("least", Function::Least, true),
    ("abs", Function::Abs, true),
    ("sign", Function::Sign, true),
    ("floor", Function::Floor, true),
    ("ceil", Function::Ceil, true),
    ("round", Function::Round, true),
    ("trunc", Function::Trunc, true),
];

/// The function with this name, and whether it is of the library `math`.
pub(super) fn function(name: &str) -> Option<(Function, bool)> {
    if name == operators::NOT_STRICTLY_FALSE {
        return Some((Function::NotStrictlyFalse, false));
    }
    FUNCTIONS.into_iter().find(|(known, _, _)| *known == name).map(|(_, function, of_math)| (function, of_math))
}

/// The names of all functions.
pub(super) fn known_functions() -> String {
    let names = FUNCTIONS.map(|(name, _, of_math)| format!("{}{name}", if of_math { "math." } else { "" }));
    names.join(", ")
}
