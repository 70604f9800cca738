//! Evaluating expressions.

use std::cmp::Ordering;
use std::sync::Arc;

use super::datum::{Datum, List, Text};
use super::node::{Fold, Function, Kind, Node, Operation};
use crate::document::whole;

/// Why an expression has no value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Failure {
    /// Where it failed: that many bytes of the text come before it.
    pub(crate) offset: u32,
    /// Why.
    pub(crate) detail: String,
}

/// Most steps of one evaluation: of macros, and of making and comparing texts and lists. About a tenth of a millisecond.
const MAX_STEPS: usize = 10_000;
/// Bytes of texts that are made or looked at in a step.
const STEP_BYTES: usize = 64;
/// Items of lists, likewise.
const STEP_ITEMS: usize = 16;

/// The value of `node` where the variables have these values, by their numbers.
pub(super) fn evaluate<'a>(node: &'a Node, variables: &'a [Datum<'a>]) -> Result<Datum<'a>, Failure> {
    Evaluation { variables, locals: Vec::new(), steps_left: MAX_STEPS }.value(node)
}

struct Evaluation<'a> {
    variables: &'a [Datum<'a>],
    locals: Vec<Datum<'a>>,
    steps_left: usize,
}

impl<'a> Evaluation<'a> {
    fn value(&mut self, node: &'a Node) -> Result<Datum<'a>, Failure> {
        match &node.kind {
            Kind::Constant(constant) => Ok(constant.borrowed()),
            Kind::Variable(number) => Ok(self.variables[*number].borrowed()),
            Kind::Local(number) => Ok(self.locals[*number].clone()),
            Kind::Not(operand) => match self.value(operand)? {
                Datum::Bool(flag) => Ok(Datum::Bool(!flag)),
                Datum::Null => Ok(Datum::Null),
                other => Err(unfit(node, &[&other])),
            },
            Kind::Negate(operand) => match self.value(operand)? {
                Datum::Int(number) => number.checked_neg().map(Datum::Int).ok_or_else(|| overflow(node)),
                Datum::Double(number) => Ok(Datum::Double(-number)),
                Datum::Null => Ok(Datum::Null),
                other => Err(unfit(node, &[&other])),
            },
            Kind::And(operands) => self.connected(node, operands, false),
            Kind::Or(operands) => self.connected(node, operands, true),
            Kind::Conditional(parts) => match self.value(&parts[0])? {
                Datum::Bool(true) => self.value(&parts[1]),
                Datum::Bool(false) => self.value(&parts[2]),
                Datum::Null => Ok(Datum::Null),
                other => Err(unfit(&parts[0], &[&other])),
            },
            // Whether something is null is known, and what null equals is not.
            Kind::Binary(Operation::Equal, operands) if is_null(&operands[0]) || is_null(&operands[1]) => {
                Ok(Datum::Bool(self.value(&operands[0])? == self.value(&operands[1])?))
            }
            Kind::Binary(Operation::NotEqual, operands) if is_null(&operands[0]) || is_null(&operands[1]) => {
                Ok(Datum::Bool(self.value(&operands[0])? != self.value(&operands[1])?))
            }
            Kind::Binary(operation, operands) => {
                let (a, b) = (self.value(&operands[0])?, self.value(&operands[1])?);
                if let (Datum::Text(_) | Datum::List(_), _) | (_, Datum::Text(_) | Datum::List(_)) = (&a, &b) {
                    self.spend(node, length_of(&a) + length_of(&b))?;
                }
                operate(node, *operation, &a, &b)
            }
            Kind::OneOf(operand, known) => match self.value(operand)? {
                value if value.is_unknown() => Ok(Datum::Null),
                value => Ok(Datum::Bool(known.contains(&value))),
            },
            Kind::List(items) => {
                self.spend(node, items.len() / STEP_ITEMS)?;
                let items: Vec<_> = items.iter().map(|item| self.value(item)).collect::<Result<_, _>>()?;
                Ok(Datum::List(List::Owned(items.into())))
            }
            Kind::Call(Function::NotStrictlyFalse, operands) => {
                Ok(Datum::Bool(!matches!(self.value(&operands[0]), Ok(Datum::Bool(false)))))
            }
            Kind::Call(function, operands) => {
                let arguments: Vec<_> = operands.iter().map(|operand| self.value(operand)).collect::<Result<_, _>>()?;
                self.spend(node, arguments.iter().map(length_of).sum())?;
                call(node, *function, &arguments)
            }
            Kind::Fold(fold) => self.folded(node, fold),
        }
    }

    /// Counts steps.
    #[inline]
    fn spend(&mut self, node: &Node, n_steps: usize) -> Result<(), Failure> {
        let left = self.steps_left.checked_sub(n_steps);
        self.steps_left = left.ok_or_else(|| failure(node, format!("it takes more than {MAX_STEPS} steps")))?;
        Ok(())
    }

    /// `a && b` or `a || b`, of which one that is `decisive` decides, also where the other has no value.
    fn connected(&mut self, node: &'a Node, operands: &'a [Node; 2], decisive: bool) -> Result<Datum<'a>, Failure> {
        let first = self.value(&operands[0]);
        if matches!(first, Ok(Datum::Bool(flag)) if flag == decisive) {
            return first;
        }
        let second = self.value(&operands[1]);
        if matches!(second, Ok(Datum::Bool(flag)) if flag == decisive) {
            return second;
        }
        match (first?, second?) {
            (Datum::Bool(_), Datum::Bool(_)) => Ok(Datum::Bool(!decisive)),
            (Datum::Bool(_) | Datum::Null, Datum::Bool(_) | Datum::Null) => Ok(Datum::Null),
            (a, b) => Err(unfit(node, &[&a, &b])),
        }
    }

    fn folded(&mut self, node: &'a Node, fold: &'a Fold) -> Result<Datum<'a>, Failure> {
        let list = match self.value(&fold.range)? {
            Datum::List(list) => list,
            Datum::Null => return Ok(Datum::Null),
            other => return Err(unfit(&fold.range, &[&other])),
        };
        let item = self.locals.len();
        let first = self.value(&fold.first)?;
        self.locals.extend([Datum::Null, first]);
        let result = self.folded_in(node, fold, &list, item);
        self.locals.truncate(item);
        result
    }

    fn folded_in(
        &mut self,
        node: &'a Node,
        fold: &'a Fold,
        list: &List<'a>,
        item: usize,
    ) -> Result<Datum<'a>, Failure> {
        for value in list.iter() {
            self.spend(node, 1)?;
            self.locals[item] = value.clone();
            if matches!(self.value(&fold.go_on)?, Datum::Bool(false)) {
                break;
            }
            self.locals[item + 1] = self.value(&fold.step)?;
        }
        self.locals[item] = Datum::Null;
        self.value(&fold.result)
    }
}

/// In how many steps a text or a list is looked at.
#[inline]
fn length_of(datum: &Datum<'_>) -> usize {
    match datum {
        Datum::Text(text) => text.len() / STEP_BYTES,
        Datum::List(list) => list.len() / STEP_ITEMS,
        _ => 0,
    }
}

fn is_null(node: &Node) -> bool {
    matches!(node.kind, Kind::Constant(Datum::Null))
}

fn failure(node: &Node, detail: impl Into<String>) -> Failure {
    Failure { offset: node.offset, detail: detail.into() }
}

fn overflow(node: &Node) -> Failure {
    failure(node, "a whole number that is larger than 64 bits hold")
}

fn unfit(node: &Node, found: &[&Datum<'_>]) -> Failure {
    let found: Vec<_> = found.iter().map(|found| format!("{} ({found})", found.type_name())).collect();
    failure(node, format!("this cannot be done with {}", found.join(" and ")))
}

fn operate<'a>(node: &Node, operation: Operation, a: &Datum<'a>, b: &Datum<'a>) -> Result<Datum<'a>, Failure> {
    use Operation as O;
    let ordered = |holds: fn(Ordering) -> bool| match (a, b) {
        (Datum::Null, _) | (_, Datum::Null) => Ok(Datum::Null),
        // NaN compares with nothing.
        (Datum::Double(_), Datum::Double(_) | Datum::Int(_)) | (Datum::Int(_), Datum::Double(_)) => {
            Ok(Datum::Bool(a.order(b).is_some_and(holds)))
        }
        _ => a.order(b).map(|order| Datum::Bool(holds(order))).ok_or_else(|| unfit(node, &[a, b])),
    };
    match operation {
        O::Equal | O::NotEqual if a.is_unknown() || b.is_unknown() => Ok(Datum::Null),
        O::Equal => Ok(Datum::Bool(a == b)),
        O::NotEqual => Ok(Datum::Bool(a != b)),
        O::Less => ordered(Ordering::is_lt),
        O::LessOrEqual => ordered(Ordering::is_le),
        O::Greater => ordered(Ordering::is_gt),
        O::GreaterOrEqual => ordered(Ordering::is_ge),
        O::In => match b {
            Datum::List(_) if a.is_unknown() => Ok(Datum::Null),
            Datum::List(list) if list.contains(a) => Ok(Datum::Bool(true)),
            Datum::List(_) if b.is_unknown() => Ok(Datum::Null),
            Datum::List(_) => Ok(Datum::Bool(false)),
            Datum::Null => Ok(Datum::Null),
            _ => Err(unfit(node, &[a, b])),
        },
        O::Index => match (a, b) {
            (Datum::Null, _) | (_, Datum::Null) => Ok(Datum::Null),
            (Datum::List(list), _) => {
                let index = match b {
                    Datum::Int(index) => Some(*index),
                    Datum::Double(index) => whole(*index),
                    _ => None,
                };
                let index = index.and_then(|index| usize::try_from(index).ok());
                let item = index.and_then(|index| list.get(index));
                item.cloned().ok_or_else(|| failure(node, format!("a list of {} has no item {b}", list.len())))
            }
            _ => Err(unfit(node, &[a, b])),
        },
        O::Add | O::Subtract | O::Multiply | O::Divide | O::Modulo => calculate(node, operation, a, b),
    }
}

#[expect(clippy::cast_precision_loss, reason = "as where a whole number is written as a double")]
fn calculate<'a>(node: &Node, operation: Operation, a: &Datum<'a>, b: &Datum<'a>) -> Result<Datum<'a>, Failure> {
    use Operation as O;
    let doubles = |a: f64, b: f64| match operation {
        O::Add => Ok(Datum::Double(a + b)),
        O::Subtract => Ok(Datum::Double(a - b)),
        O::Multiply => Ok(Datum::Double(a * b)),
        O::Divide => Ok(Datum::Double(a / b)),
        _ => Ok(Datum::Double(a % b)),
    };
    match (a, b) {
        (Datum::Int(a), Datum::Int(b)) => {
            if *b == 0 && matches!(operation, O::Divide | O::Modulo) {
                return Err(failure(node, "a division by zero"));
            }
            let result = match operation {
                O::Add => a.checked_add(*b),
                O::Subtract => a.checked_sub(*b),
                O::Multiply => a.checked_mul(*b),
                O::Divide => a.checked_div(*b),
                _ => a.checked_rem(*b),
            };
            result.map(Datum::Int).ok_or_else(|| overflow(node))
        }
        (Datum::Double(a), Datum::Double(b)) => doubles(*a, *b),
        // Only where the types of variables are not declared.
        (Datum::Int(a), Datum::Double(b)) => doubles(*a as f64, *b),
        (Datum::Double(a), Datum::Int(b)) => doubles(*a, *b as f64),
        (Datum::Text(a), Datum::Text(b)) if operation == O::Add => {
            Ok(Datum::Text(Text::Owned(format!("{}{}", &**a, &**b).into())))
        }
        (Datum::List(a), Datum::List(b)) if operation == O::Add => {
            let items: Arc<[Datum<'a>]> = a.iter().chain(b.iter()).cloned().collect();
            Ok(Datum::List(List::Owned(items)))
        }
        (Datum::Null, _) | (_, Datum::Null) => Ok(Datum::Null),
        _ => Err(unfit(node, &[a, b])),
    }
}

fn call<'a>(node: &Node, function: Function, arguments: &[Datum<'a>]) -> Result<Datum<'a>, Failure> {
    use Function as F;
    // How many items a list has is known, also where some are null.
    if arguments
        .iter()
        .any(|argument| matches!(argument, Datum::Null) || (function != F::Size && argument.is_unknown()))
    {
        return Ok(Datum::Null);
    }
    let counted = |n: usize| Ok(Datum::Int(i64::try_from(n).unwrap_or(i64::MAX)));
    match (function, arguments) {
        (F::Size, [Datum::Text(text)]) => counted(text.chars().count()),
        (F::Size, [Datum::List(list)]) => counted(list.len()),
        (F::Int, [value]) => to_int(value).map(Datum::Int).ok_or_else(|| failure(node, format!("{value} is no int"))),
        (F::Double, [value]) => {
            to_double(value).map(Datum::Double).ok_or_else(|| failure(node, format!("{value} is no double")))
        }
        (F::Text, [value]) => match value {
            Datum::Text(text) => Ok(Datum::Text(text.clone())),
            Datum::List(_) => Err(unfit(node, &[value])),
            _ => Ok(Datum::Text(Text::Owned(value.to_string().into()))),
        },
        (F::StartsWith, [Datum::Text(text), Datum::Text(part)]) => Ok(Datum::Bool(text.starts_with(&**part))),
        (F::EndsWith, [Datum::Text(text), Datum::Text(part)]) => Ok(Datum::Bool(text.ends_with(&**part))),
        (F::Contains, [Datum::Text(text), Datum::Text(part)]) => Ok(Datum::Bool(text.contains(&**part))),
        (F::Greatest, [Datum::List(list)]) => best(node, list, Ordering::is_gt),
        (F::Least, [Datum::List(list)]) => best(node, list, Ordering::is_lt),
        (F::Greatest, _) => best(node, arguments, Ordering::is_gt),
        (F::Least, _) => best(node, arguments, Ordering::is_lt),
        (F::Abs, [Datum::Int(number)]) => number.checked_abs().map(Datum::Int).ok_or_else(|| overflow(node)),
        (F::Sign, [Datum::Int(number)]) => Ok(Datum::Int(number.signum())),
        (F::Abs, [Datum::Double(number)]) => Ok(Datum::Double(number.abs())),
        (F::Sign, [Datum::Double(number)]) => Ok(Datum::Double(if *number == 0.0 { 0.0 } else { number.signum() })),
        (F::Floor, [Datum::Double(number)]) => Ok(Datum::Double(number.floor())),
        (F::Ceil, [Datum::Double(number)]) => Ok(Datum::Double(number.ceil())),
        (F::Round, [Datum::Double(number)]) => Ok(Datum::Double(number.round())),
        (F::Trunc, [Datum::Double(number)]) => Ok(Datum::Double(number.trunc())),
        // Only where the types of variables are not declared.
        (F::Floor | F::Ceil | F::Round | F::Trunc, [Datum::Int(number)]) => Ok(Datum::Int(*number)),
        _ => Err(unfit(node, &arguments.iter().collect::<Vec<_>>())),
    }
}

fn best<'a>(node: &Node, numbers: &[Datum<'a>], is_better: fn(Ordering) -> bool) -> Result<Datum<'a>, Failure> {
    let is_number = |datum: &Datum<'_>| matches!(datum, Datum::Int(_) | Datum::Double(_));
    if let Some(other) = numbers.iter().find(|datum| !is_number(datum)) {
        return Err(unfit(node, &[other]));
    }
    let better = |a: &Datum<'a>, b: &Datum<'a>| b.order(a).is_some_and(is_better);
    let best = numbers.iter().cloned().reduce(|a, b| if better(&a, &b) { b } else { a });
    best.ok_or_else(|| failure(node, "an empty list"))
}

fn to_int(value: &Datum<'_>) -> Option<i64> {
    match value {
        Datum::Int(number) => Some(*number),
        Datum::Double(number) => whole(number.trunc()),
        Datum::Text(text) => text.parse().ok(),
        _ => None,
    }
}

fn to_double(value: &Datum<'_>) -> Option<f64> {
    match value {
        #[expect(clippy::cast_precision_loss, reason = "as CEL says")]
        Datum::Int(number) => Some(*number as f64),
        Datum::Double(number) => Some(*number),
        Datum::Text(text) => text.parse().ok(),
        _ => None,
    }
}
