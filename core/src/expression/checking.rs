//! Which types go together.

use std::fmt;

use super::datum::Datum;
use super::node::{Function, Operation};

/// The type of an expression's values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Type {
    /// Not known before there is a value.
    Any,
    /// Whole numbers.
    Int,
    /// Numbers.
    Double,
    /// True or false.
    Bool,
    /// Texts.
    Text,
    /// Lists of values of a type.
    List(Box<Type>),
}

impl fmt::Display for Type {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Any => "any value",
            Self::Int => "int",
            Self::Double => "double",
            Self::Bool => "bool",
            Self::Text => "string",
            Self::List(_) => "list",
        })
    }
}

impl Type {
    /// The type of a constant.
    pub(super) fn of(constant: &Datum<'_>) -> Self {
        match constant {
            Datum::Null => Self::Any,
            Datum::Int(_) => Self::Int,
            Datum::Double(_) => Self::Double,
            Datum::Bool(_) => Self::Bool,
            Datum::Text(_) => Self::Text,
            Datum::List(list) => Self::list_of(list.iter().map(Self::of)),
        }
    }

    /// The type of a list whose items have these types.
    pub(super) fn list_of(mut items: impl Iterator<Item = Self>) -> Self {
        let first = items.next().unwrap_or(Self::Any);
        let item = items.fold(first, |all, item| all.joined(item).unwrap_or(Self::Any));
        Self::List(Box::new(item))
    }

    /// The type of a list's items.
    pub(super) fn item(self) -> Option<Self> {
        match self {
            Self::List(item) => Some(*item),
            Self::Any => Some(Self::Any),
            _ => None,
        }
    }

    /// The type of what is of one of two types, if they go together.
    pub(super) fn joined(self, other: Self) -> Option<Self> {
        match (self, other) {
            (a, b) if a == b => Some(a),
            (Self::Any, _) | (_, Self::Any) => Some(Self::Any),
            // Of an empty list, nothing is known.
            (Self::List(a), Self::List(b)) => {
                let item = match (*a, *b) {
                    (Self::Any, item) | (item, Self::Any) => item,
                    (a, b) => a.joined(b)?,
                };
                Some(Self::List(Box::new(item)))
            }
            _ => None,
        }
    }

    fn is_number(&self) -> bool {
        matches!(self, Self::Int | Self::Double | Self::Any)
    }

    /// Whether a value of this type may equal one of the other.
    fn may_equal(&self, other: &Self) -> bool {
        self.clone().joined(other.clone()).is_some() || (self.is_number() && other.is_number())
    }
}

/// The type of what an operator makes of two values, if it takes them. `is_lenient`: an `int` may stand for a `double`.
pub(super) fn operated(operation: Operation, a: &Type, b: &Type, is_lenient: bool) -> Option<Type> {
    use Operation as O;
    match operation {
        O::Equal | O::NotEqual => a.may_equal(b).then_some(Type::Bool),
        O::Less | O::LessOrEqual | O::Greater | O::GreaterOrEqual => {
            let is_ordered = |kind: &Type| !matches!(kind, Type::List(_));
            (is_ordered(a) && is_ordered(b) && a.may_equal(b)).then_some(Type::Bool)
        }
        O::In => b.clone().item().filter(|item| a.may_equal(item)).map(|_| Type::Bool),
        O::Index => a.clone().item().filter(|_| matches!(b, Type::Int | Type::Any)),
        O::Add | O::Subtract | O::Multiply | O::Divide | O::Modulo => match (a, b) {
            (Type::Int, Type::Int) => Some(Type::Int),
            (Type::Double, Type::Double) if is_lenient || operation != O::Modulo => Some(Type::Double),
            (Type::Int, Type::Double) | (Type::Double, Type::Int) if is_lenient => Some(Type::Double),
            (Type::Text | Type::Any, Type::Text) | (Type::Text, Type::Any) if operation == O::Add => Some(Type::Text),
            (Type::List(_) | Type::Any, Type::List(_)) | (Type::List(_), Type::Any) if operation == O::Add => {
                a.clone().joined(b.clone())
            }
            (Type::Any, other) | (other, Type::Any) => other.is_number().then_some(Type::Any),
            _ => None,
        },
    }
}

/// The type of what a function makes of its arguments, if it takes them.
pub(super) fn called(function: Function, arguments: &[Type]) -> Option<Type> {
    use Function as F;
    let is_text = |kind: &Type| matches!(kind, Type::Text | Type::Any);
    match (function, arguments) {
        (F::Size, [Type::Text | Type::List(_) | Type::Any])
        | (F::Int, [Type::Int | Type::Double | Type::Text | Type::Any]) => Some(Type::Int),
        (F::Double, [Type::Int | Type::Double | Type::Text | Type::Any])
        | (F::Floor | F::Ceil | F::Round | F::Trunc, [Type::Double | Type::Any]) => Some(Type::Double),
        (F::Text, [Type::List(_)]) => None,
        (F::Text, [_]) => Some(Type::Text),
        (F::StartsWith | F::EndsWith | F::Contains, [a, b]) => (is_text(a) && is_text(b)).then_some(Type::Bool),
        (F::Greatest | F::Least, [Type::List(item)]) => item.is_number().then(|| (**item).clone()),
        (F::Greatest | F::Least, [_, ..]) => {
            let are_numbers = arguments.iter().all(Type::is_number);
            let joined = arguments.iter().cloned().reduce(|a, b| a.joined(b).unwrap_or(Type::Any))?;
            are_numbers.then_some(joined)
        }
        (F::Abs | F::Sign, [kind]) => kind.is_number().then(|| kind.clone()),
        (F::NotStrictlyFalse, [Type::Bool | Type::Any]) => Some(Type::Bool),
        _ => None,
    }
}
