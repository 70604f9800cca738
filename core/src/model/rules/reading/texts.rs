//! The expressions of rules, which are read together.

use std::collections::HashMap;
use std::sync::OnceLock;

use super::super::{Placed, cost_of};
use super::declared::ReadAttributes;
use crate::document::{Faults, Place, Quoted};
use crate::expression::{Datum, Scope, Type, read_all};
use crate::interrupt::{Interrupted, Meter};

/// What an expression is for.
#[derive(Clone, Copy)]
pub(super) enum Wanted {
    /// Whether something holds.
    Flag,
    /// A cost.
    Cost,
    /// A value of the attribute at this position.
    Value(usize),
}

/// The expressions of a document.
#[derive(Default)]
pub(super) struct Texts<'v> {
    texts: Vec<Written<'v>>,
}

struct Written<'v> {
    text: &'v str,
    pointer: String,
    line: Option<u64>,
    rule: Option<usize>,
    wanted: Wanted,
}

impl<'v> Texts<'v> {
    /// The number of the expression at `place`, if there is a text.
    pub(super) fn add(
        &mut self,
        place: &Place<'v, '_>,
        rule: Option<usize>,
        wanted: Wanted,
        faults: &mut Faults,
    ) -> Option<usize> {
        let Some(text) = place.value.as_str() else { return place.mismatch("an expression: a string", faults) };
        self.texts.push(Written { text, pointer: place.path.to_string(), line: place.path.line(), rule, wanted });
        Some(self.texts.len() - 1)
    }

    /// Reads them all, and notes what is wrong with each.
    pub(super) fn read(
        self,
        attributes: &ReadAttributes,
        constants: &HashMap<String, Datum<'static>>,
        meter: &mut Meter<'_>,
        faults: &mut Faults,
    ) -> Result<Vec<Option<Placed>>, Interrupted> {
        /// How many are read between two looks at the interrupt: a few milliseconds.
        const CHUNK_LEN: usize = 64;
        /// What each of them counts as.
        const READING: u64 = 1000;
        let scope = Scope::declared(attributes.variables(), constants.clone());
        let mut placed = Vec::with_capacity(self.texts.len());
        for chunk in self.texts.chunks(CHUNK_LEN) {
            meter.spend_or_stop(chunk.len() as u64 * READING)?;
            let texts: Vec<&str> = chunk.iter().map(|written| written.text).collect();
            let Some(read) = read_all(&texts, &scope, &mut Vec::new()) else {
                faults.note_in(chunk[0].line, chunk[0].pointer.clone(), "there is no thread to read expressions on");
                return Ok(Vec::new());
            };
            for (written, read) in chunk.iter().zip(read) {
                let Written { pointer, line, rule, wanted, .. } = written;
                let (pointer, line, rule) = (pointer.clone(), *line, *rule);
                let prefix = rule.map_or(String::new(), |rule| format!("rule {rule}, "));
                match read {
                    Ok(expression) => {
                        let read = Placed { expression, pointer, line, rule, trouble: OnceLock::new() };
                        check(&read, *wanted, attributes, faults);
                        placed.push(Some(read));
                    }
                    Err(flaws) => {
                        for flaw in flaws {
                            faults.note_in(line, pointer.clone(), format!("{prefix}{flaw}"));
                        }
                        placed.push(None);
                    }
                }
            }
        }
        Ok(placed)
    }
}

/// Notes that an expression gives what is not wanted, as far as it can be told without evaluating it.
fn check(placed: &Placed, wanted: Wanted, attributes: &ReadAttributes, faults: &mut Faults) {
    let mut note = |offset: u32, detail: String| {
        faults.note_in(placed.line, placed.pointer.clone(), format!("{}: {detail}", placed.place(offset)));
    };
    let found = placed.expression.result();
    let mismatch = |wanted: &str| format!("expected {wanted}, found {found}");
    match wanted {
        Wanted::Flag if !matches!(found, Type::Bool | Type::Any) => note(0, mismatch("bool")),
        Wanted::Cost if !matches!(found, Type::Int | Type::Double | Type::Any) => note(0, mismatch("int or double")),
        Wanted::Flag => {}
        Wanted::Cost => {
            let constants = placed.expression.constant_results().into_iter();
            for (offset, constant) in constants.filter(|(_, constant)| cost_of(constant).is_none()) {
                note(offset, format!("{constant} is no cost, which is a number of at least 0"));
            }
        }
        Wanted::Value(at) => {
            let Some((attribute, domain)) = attributes.of(at) else { return };
            // A whole number is a number.
            let is_fit = found == domain.kind() || *found == Type::Any;
            if !is_fit && (found, domain.kind()) != (&Type::Int, &Type::Double) {
                note(0, format!("{}, the type of {}", mismatch(&domain.kind().to_string()), Quoted(&attribute.name)));
                return;
            }
            let constants = placed.expression.constant_results().into_iter();
            for (offset, constant) in constants.filter(|(_, constant)| domain.position(constant).is_none()) {
                note(offset, domain.refusal(constant, &attribute.name));
            }
        }
    }
}
