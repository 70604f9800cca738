//! Where a body must never be, told by an expression over the values of a state.

use std::fmt::Debug;

use crate::attribute::{Schema, Value};
#[cfg(feature = "rules")]
use crate::expression::{Datum, Expression};

/// An expression that holds in states that must never be entered.
#[derive(Clone, Debug)]
pub(super) struct Deadly {
    text: String,
    #[cfg(feature = "rules")]
    expression: Expression,
    /// The values of each attribute, as the expression sees them; none of those that it does not read.
    #[cfg(feature = "rules")]
    data: Vec<Vec<Datum<'static>>>,
}

/// It follows from its text.
impl PartialEq for Deadly {
    fn eq(&self, other: &Self) -> bool {
        self.text == other.text
    }
}

impl Deadly {
    /// As it was written.
    pub(super) fn text(&self) -> &str {
        &self.text
    }
}

#[cfg(not(feature = "rules"))]
impl Deadly {
    /// Reads an expression.
    ///
    /// # Errors
    ///
    /// That there are none without the feature `rules`.
    pub(super) fn read<D: AsRef<[Value]>>(_: &str, _: &Schema, _: &[D]) -> Result<Self, String> {
        Err("expressions are read with the feature `rules` alone".to_owned())
    }

    /// Never: there is none.
    #[expect(clippy::unused_self, clippy::unnecessary_wraps, reason = "as with the feature")]
    pub(super) fn holds(&self, _: impl Iterator<Item = u32>) -> Result<bool, String> {
        Ok(false)
    }
}

#[cfg(feature = "rules")]
impl Deadly {
    /// Reads an expression over attributes with these values.
    ///
    /// # Errors
    ///
    /// What is wrong with it.
    pub(super) fn read<D: AsRef<[Value]>>(text: &str, schema: &Schema, domains: &[D]) -> Result<Self, String> {
        use crate::expression::{Scope, Type, read_all};

        let attributes = schema.attributes();
        let domains = attributes.iter().zip(domains);
        let (kinds, mut data): (Vec<Type>, Vec<_>) =
            domains.map(|(attribute, domain)| data_of(attribute, domain.as_ref())).unzip();
        let variables = attributes.iter().zip(kinds).map(|(attribute, kind)| (attribute.name.clone(), kind));
        let scope = Scope::declared(variables, std::collections::HashMap::new());
        let read = read_all(&[text], &scope, &mut Vec::new()).ok_or("there is no thread to read it on")?;
        let expression = read.into_iter().next().unwrap_or(Err(Vec::new())).map_err(|flaws| flaws.join("; "))?;
        if !matches!(expression.result(), Type::Bool | Type::Any) {
            return Err(format!("expected bool, found {}", expression.result()));
        }
        for (at, data) in data.iter_mut().enumerate() {
            if !expression.reads().contains(&at) {
                *data = Vec::new();
            }
        }
        Ok(Self { text: text.to_owned(), expression, data })
    }

    /// Whether it holds where attributes have the values with these indices.
    ///
    /// # Errors
    ///
    /// Why it has no value there.
    pub(super) fn holds(&self, row: impl Iterator<Item = u32>) -> Result<bool, String> {
        let values = self.data.iter().zip(row);
        let variables: Vec<Datum<'_>> =
            values.map(|(data, index)| data.get(index as usize).map_or(Datum::Null, Datum::borrowed)).collect();
        match self.expression.evaluate(&variables) {
            Ok(Datum::Bool(holds)) => Ok(holds),
            Ok(other) => Err(format!("expected bool, found {}", other.type_name())),
            Err(failure) => Err(failure.detail),
        }
    }
}

/// The values of an attribute as expressions see them, and their type.
#[cfg(feature = "rules")]
fn data_of(
    attribute: &crate::attribute::Attribute,
    domain: &[Value],
) -> (crate::expression::Type, Vec<Datum<'static>>) {
    use crate::attribute::Scalar;
    use crate::document::whole;
    use crate::expression::Type;

    let are_whole = domain.iter().all(|value| !matches!(value, Value::Number(number) if whole(*number).is_none()));
    let datum = |value: &Value| match attribute.write_value(value) {
        Scalar::Boolean(flag) => (Type::Bool, Datum::Bool(flag)),
        #[expect(clippy::cast_precision_loss, reason = "it was a float")]
        Scalar::Integer(number) if !are_whole => (Type::Double, Datum::Double(number as f64)),
        Scalar::Integer(number) => (Type::Int, Datum::Int(number)),
        Scalar::Number(number) => (Type::Double, Datum::Double(number)),
        Scalar::Text(text) => (Type::Text, Datum::text(&text)),
    };
    let (kinds, data): (Vec<Type>, Vec<Datum<'static>>) = domain.iter().map(datum).unzip();
    let kind = match kinds.split_first() {
        Some((first, others)) if others.iter().all(|other| other == first) => first.clone(),
        _ => Type::Any,
    };
    (kind, data)
}
