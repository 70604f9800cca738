//! `index.json`: what an archive has.

use std::collections::{BTreeMap, HashMap};

use serde::Deserialize;

use crate::document::Quoted;
use crate::model::reading::Raw;

/// What there is, as far as it is needed here.
#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) struct Index {
    pub(super) format_version: u64,
    pub(super) transition_system: System,
    #[serde(default)]
    pub(super) annotations: Annotations,
    #[serde(default)]
    pub(super) valuations: HashMap<String, Valuations>,
}

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) struct System {
    pub(super) time: String,
    #[serde(rename = "#players")]
    pub(super) n_players: u64,
    #[serde(rename = "#states")]
    pub(super) n_states: u64,
    #[serde(rename = "#initial-states")]
    pub(super) n_initial: u64,
    #[serde(rename = "#choices")]
    pub(super) n_choices: u64,
    #[serde(rename = "#branches")]
    pub(super) n_branches: u64,
    pub(super) branch_probability_type: Option<Type>,
}

#[derive(Default, Deserialize)]
pub(super) struct Annotations {
    #[serde(default)]
    pub(super) rewards: BTreeMap<String, Annotation>,
    #[serde(default)]
    pub(super) aps: BTreeMap<String, Annotation>,
}

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) struct Annotation {
    pub(super) alias: Option<String>,
    #[serde(default)]
    pub(super) applies_to: Vec<String>,
    pub(super) r#type: Type,
}

#[derive(Deserialize)]
pub(super) struct Type {
    pub(super) r#type: String,
    pub(super) size: Option<u32>,
}

#[derive(Deserialize)]
pub(super) struct Valuations {
    pub(super) classes: Vec<Class>,
}

#[derive(Deserialize)]
pub(super) struct Class {
    pub(super) variables: Vec<Field>,
}

#[derive(Deserialize)]
#[serde(untagged, rename_all = "kebab-case")]
pub(super) enum Field {
    Padding { padding: u32 },
    Variable(Variable),
}

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) struct Variable {
    pub(super) name: String,
    pub(super) r#type: Type,
    #[serde(default)]
    pub(super) is_optional: bool,
    /// What is added to what is stored.
    pub(super) offset: Option<i64>,
}

/// How many bits a variable has, if it is of a type that is read here.
pub(super) fn field_size(variable: &Variable) -> Result<u32, String> {
    let Type { r#type, size } = &variable.r#type;
    let size = size.unwrap_or(if r#type == "bool" { 1 } else { 64 });
    let fits = match r#type.as_str() {
        "bool" => size == 1,
        "int" | "uint" => (1..=64).contains(&size),
        "double" => size == 64,
        _ => false,
    };
    if fits && !variable.is_optional {
        return Ok(size);
    }
    let optional = if variable.is_optional { "optional " } else { "" };
    Err(format!(
        "{} has {optional}values of the type {} and {size} bits, which are not read",
        Quoted(&variable.name),
        r#type
    ))
}

pub(super) fn value_of(variable: &Variable, bits: u64, size: u32) -> Raw<&'static str> {
    #[expect(clippy::cast_possible_wrap, reason = "these are the bits of a number with a sign")]
    let signed = (bits << (64 - size)) as i64 >> (64 - size);
    let whole = match variable.r#type.r#type.as_str() {
        "bool" => return Raw::Boolean(bits == 1),
        "double" => return Raw::float(f64::from_bits(bits)),
        "int" => i128::from(signed),
        _ => i128::from(bits),
    };
    let whole = whole + i128::from(variable.offset.unwrap_or_default());
    match (u64::try_from(whole), i64::try_from(whole)) {
        (Ok(whole), _) => Raw::Whole(whole),
        (_, Ok(negative)) => Raw::Negative(negative),
        #[expect(clippy::cast_precision_loss, reason = "it is beyond what is told apart")]
        _ => Raw::float(whole as f64),
    }
}
