//! States that must never be entered, by an expression over their values.

use super::{Edits, ImportError};
use crate::attribute::{Schema, Value};
use crate::document::Quoted;
use crate::interrupt::Meter;
use crate::model::deadly::Deadly;
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

fn evaluated(
    texts: &[String],
    schema: &Schema,
    states: &States,
    meter: &mut Meter<'_>,
) -> Result<Vec<StateIdx>, ImportError> {
    let domains: Vec<&[Value]> = (0..schema.len()).map(|at| states.domain(at)).collect();
    let read = texts.iter().map(|text| Deadly::read(text, schema, &domains).map_err(|detail| wrong(text, &detail)));
    let read: Vec<Deadly> = read.collect::<Result<_, _>>()?;
    let mut found = Vec::new();
    for state in 0..states.len() {
        meter.spend_or_stop(schema.len() as u64)?;
        for deadly in &read {
            let holds = deadly.holds(states.row(state).iter().copied());
            if holds.map_err(|detail| wrong(deadly.text(), &format!("in state {state}: {detail}")))? {
                found.push(state);
                break;
            }
        }
    }
    Ok(found)
}

/// What is wrong with an expression.
pub(super) fn wrong(text: &str, detail: &str) -> ImportError {
    ImportError::Unfit(format!("unsafe {}: {detail}", Quoted(text)))
}
