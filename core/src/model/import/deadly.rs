//! States that must never be entered, by an expression over their values.

use super::{Edits, ImportError};
use crate::attribute::Schema;
use crate::interrupt::Meter;
use crate::model::{Start, StateIdx, States};

/// The states for which one of the expressions of `edits` holds, ascending. The body starts in none of them.
pub(super) fn unsafe_states(
    edits: &Edits,
    schema: &Schema,
    states: &States,
    start: &Start,
    meter: &mut Meter<'_>,
) -> Result<Vec<StateIdx>, ImportError> {
    if edits.unsafe_if.is_empty() {
        return Ok(Vec::new());
    }
    let found = evaluated(&edits.unsafe_if, schema, states, meter)?;
    let starts = match start {
        Start::State(state) => std::slice::from_ref(state),
        Start::Candidates(states) => states,
        Start::Any => &[],
    };
    if let Some(state) = starts.iter().find(|state| found.binary_search(state).is_ok()) {
        return Err(ImportError::Unfit(format!("unsafe: state {state} is, where the body starts")));
    }
    if found.len() == states.len() as usize {
        return Err(ImportError::Unfit("unsafe: every state is".to_owned()));
    }
    Ok(found)
}

#[cfg(not(feature = "rules"))]
fn evaluated(_: &[String], _: &Schema, _: &States, _: &mut Meter<'_>) -> Result<Vec<StateIdx>, ImportError> {
    Err(ImportError::Unfit("unsafe: expressions are read with the feature `rules` alone".to_owned()))
}

#[cfg(feature = "rules")]
fn evaluated(
    texts: &[String],
    schema: &Schema,
    states: &States,
    meter: &mut Meter<'_>,
) -> Result<Vec<StateIdx>, ImportError> {
    use crate::document::Quoted;
    use crate::expression::{Datum, Scope, Type, read_all};
    use std::collections::HashMap;

    let wrong = |text: &str, detail: &str| ImportError::Unfit(format!("unsafe {}: {detail}", Quoted(text)));
    let domains: Vec<(Type, Vec<Datum<'static>>)> = (0..schema.len()).map(|at| data_of(schema, states, at)).collect();
    let variables = schema.attributes().iter().zip(&domains);
    let variables = variables.map(|(attribute, (kind, _))| (attribute.name.clone(), kind.clone()));
    let scope = Scope::declared(variables, HashMap::new());
    let written: Vec<&str> = texts.iter().map(String::as_str).collect();
    let read = read_all(&written, &scope, &mut Vec::new())
        .ok_or_else(|| wrong(&texts[0], "there is no thread to read it on"))?;
    let mut expressions = Vec::with_capacity(read.len());
    for (text, read) in texts.iter().zip(read) {
        let expression = read.map_err(|flaws| wrong(text, &flaws.join("; ")))?;
        if !matches!(expression.result(), Type::Bool | Type::Any) {
            return Err(wrong(text, &format!("expected bool, found {}", expression.result())));
        }
        expressions.push((text, expression));
    }
    let mut found = Vec::new();
    let mut row: Vec<Datum<'_>> = Vec::with_capacity(schema.len());
    for state in 0..states.len() {
        meter.spend_or_stop(schema.len() as u64)?;
        row.clear();
        row.extend(domains.iter().zip(states.row(state)).map(|((_, data), value)| data[*value as usize].borrowed()));
        for (text, expression) in &expressions {
            match expression.evaluate(&row) {
                Ok(Datum::Bool(holds)) => {
                    if holds {
                        found.push(state);
                        break;
                    }
                }
                Ok(other) => {
                    return Err(wrong(text, &format!("in state {state}: expected bool, found {}", other.type_name())));
                }
                Err(failure) => return Err(wrong(text, &format!("in state {state}: {}", failure.detail))),
            }
        }
    }
    Ok(found)
}

/// The values of an attribute as expressions see them, and their type.
#[cfg(feature = "rules")]
fn data_of(
    schema: &Schema,
    states: &States,
    at: usize,
) -> (crate::expression::Type, Vec<crate::expression::Datum<'static>>) {
    use crate::attribute::{Scalar, Value};
    use crate::document::whole;
    use crate::expression::{Datum, Type};

    let (attribute, domain) = (&schema.attributes()[at], states.domain(at));
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
