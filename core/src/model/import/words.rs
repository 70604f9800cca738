//! Names and values of files, in the form in which models have them.

use std::collections::HashSet;

use super::{ImportError, Spot};
use crate::attribute::{Attribute, Cycle, Kind, Scalar, Value, check_name};
use crate::document::{Quoted, normal};
use crate::model::reading::{Distinct, Raw};

/// Checks that names may be those of a model, and differ.
pub(super) fn check_names<'n>(
    what: &str,
    names: impl Iterator<Item = &'n str>,
    max_chars: usize,
) -> Result<(), ImportError> {
    let mut seen = HashSet::new();
    for name in names {
        if check_name(name, max_chars).is_err() {
            let detail = format!("the {what} {} needs a name of 1 to {max_chars} characters: rename it", Quoted(name));
            return Err(ImportError::Unfit(detail));
        }
        if !seen.insert(normal(name)) {
            return Err(ImportError::Unfit(format!("two {what}s are called {}: rename one", Quoted(name))));
        }
    }
    Ok(())
}

/// The values of an attribute, in the form in which they are compared.
pub(super) fn domain(distinct: Distinct, attribute: &Attribute) -> Result<Vec<Value>, ImportError> {
    let read = |value: Raw| {
        let scalar = match &value {
            Raw::Boolean(flag) => Some(Scalar::Boolean(*flag)),
            Raw::Whole(number) => i64::try_from(*number).ok().map(Scalar::Integer),
            Raw::Negative(number) => Some(Scalar::Integer(*number)),
            Raw::Float(bits) => Some(Scalar::Number(f64::from_bits(*bits))),
            Raw::Text(text) => Some(Scalar::Text(text.clone())),
            Raw::Null | Raw::Array(_) | Raw::Object => None,
        };
        scalar.and_then(|scalar| attribute.value(scalar).ok()).ok_or_else(|| {
            let name = Quoted(&attribute.name);
            let expected = match &attribute.kind {
                Kind::Cyclic { cycle: Cycle::Labels(_), .. } => "one of its labels".to_owned(),
                _ => attribute.expected(),
            };
            ImportError::at(Spot::Whole, format!("attribute {name}: expected {expected}, found {value}"))
        })
    };
    distinct.into_values().into_iter().map(read).collect()
}

/// A number in the form in which equal ones are equal.
pub(super) fn as_whole(number: f64) -> Raw<&'static str> {
    match Scalar::number(number) {
        Scalar::Integer(whole) => u64::try_from(whole).map_or(Raw::Negative(whole), Raw::Whole),
        _ => Raw::float(number + 0.0),
    }
}
