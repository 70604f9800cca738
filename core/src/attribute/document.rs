//! Attributes as they are written in JSON.

use serde::{Deserialize, Serialize};

use super::{Attribute, Cycle, Kind, Scalar};

/// How the values of an attribute are compared: as numbers, as numbers or labels on a circle, or as equal or not.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum KindName {
    /// `delta = |o - s| / scale`.
    Number,
    /// `delta = min(d mod p, p - d mod p) / scale`, `d = |o - s|`, `p` the period or the number of labels.
    Cyclic,
    /// `delta = 0` if equal, else 1. Strings have at most 1024 bytes.
    Category,
}

/// An attribute, as it is written in JSON.
///
/// The distance between an observation `o` and a state `s` is the sum of `weight * delta^2` over all attributes, where `delta` is
///
/// - of a `number`: `|o - s| / scale`;
/// - of a `cyclic`: `min(d mod p, p - d mod p) / scale`, where `d = |o - s|` and `p` is the `period`, or how many `labels` there are, which
///   count as 0, 1, 2, .. in their order;
/// - of a `category`: 0 if they are equal, else 1.
///
/// What was not observed adds nothing. An example: `x` is a `number` of `scale` 2, `heading` a `cyclic` with the `labels` east, north, west and
/// south, and `door` a `category` of `weight` 5. Between the observation x = 0, east, open and the state x = 3, south, shut, the distance is
/// `1 * (3 / 2)^2 + 1 * 1^2 + 5 * 1^2 = 8.25`: from east to south it is one step around the circle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = Attribute))]
pub struct AttributeDocument {
    /// Unique within the model; 1 to 64 characters.
    #[cfg_attr(feature = "openapi", schema(example = "heading"))]
    pub name: String,
    /// How its values are compared.
    pub kind: KindName,
    /// `number` and `cyclic`: what counts as a difference of 1. Above 0; 1 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0.0))]
    pub scale: Option<f64>,
    /// `cyclic`: the circumference of the circle that values (numbers) lie on. Above 0. Either this or `labels`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0.0))]
    pub period: Option<f64>,
    /// `cyclic`: the values, in order around the circle: 1 to 65,536, each of at most 1024 bytes. All different.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub labels: Option<Vec<String>>,
    /// Default weight `w` in the distance, to which the attribute adds `w * delta^2`, at most 1e150. At least 0; 1 if left
    /// out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 0.0))]
    pub weight: Option<f64>,
    /// Whether it is part of the state, but never observed nor compared: demonstrations do not have it, and its weight is 0. `false` if left
    /// out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hidden: Option<bool>,
    /// The values that states may have, where these follow from `rules`; elsewhere left out. Required there, but where there are
    /// `labels`, which are the values.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub values: Option<ValuesDocument>,
}

/// The values that states may have of an attribute. If they are numbers and all are whole, expressions have them as `int`, else as
/// `double`; labels as `string`; those of a category are all strings, all integers or all booleans.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = Values))]
pub enum ValuesDocument {
    /// Numbers, evenly apart.
    #[cfg_attr(feature = "openapi", schema(title = "ValueRange"))]
    Range {
        /// The least.
        from: f64,
        /// The greatest: a whole number of steps above the least.
        to: f64,
        /// How far each is from the next. Above 0; 1 if left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0.0))]
        step: Option<f64>,
    },
    /// Each of them. All different.
    List(Vec<Scalar>),
}

impl From<&Attribute> for AttributeDocument {
    fn from(attribute: &Attribute) -> Self {
        let (kind, scale, period, labels) = match &attribute.kind {
            Kind::Number { scale } => (KindName::Number, Some(*scale), None, None),
            Kind::Cyclic { scale, cycle: Cycle::Period(period) } => {
                (KindName::Cyclic, Some(*scale), Some(*period), None)
            }
            Kind::Cyclic { scale, cycle: Cycle::Labels(labels) } => {
                (KindName::Cyclic, Some(*scale), None, Some(labels.names().iter().map(ToString::to_string).collect()))
            }
            Kind::Category => (KindName::Category, None, None, None),
        };
        Self {
            name: attribute.name.clone(),
            kind,
            scale,
            period,
            labels,
            weight: Some(attribute.weight),
            hidden: attribute.is_hidden.then_some(true),
            values: None,
        }
    }
}
