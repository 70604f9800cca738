//! What stands in a request, as it is written in JSON: observations and states.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::attribute::Scalar;
use crate::model::StateIdx;

/// An observed state: an object by attribute name, or an array of values in attribute order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = Observation))]
pub enum ObservationDocument {
    /// By attribute name; those left out were not observed.
    ByName(BTreeMap<String, ObservedDocument>),
    /// In attribute order.
    InOrder(Vec<ObservedDocument>),
}

/// An observed value; `null` was not observed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObservedDocument(pub Option<Scalar>);

// Derived, it would be one of a reference and null, of which generators of clients make a class without members.
#[cfg(feature = "openapi")]
impl utoipa::PartialSchema for ObservedDocument {
    fn schema() -> utoipa::openapi::RefOr<utoipa::openapi::Schema> {
        use utoipa::openapi::RefOr;
        use utoipa::openapi::schema::{ObjectBuilder, Schema, Type};
        let mut schema = Scalar::schema();
        if let RefOr::T(Schema::AnyOf(any)) = &mut schema {
            any.description = Some("An observed value; `null` was not observed.".to_owned());
            any.items.push(ObjectBuilder::new().schema_type(Type::Null).into());
        }
        schema
    }
}

#[cfg(feature = "openapi")]
impl utoipa::ToSchema for ObservedDocument {
    fn name() -> std::borrow::Cow<'static, str> {
        "Observed".into()
    }
}

/// A state, or a list of states: an index, or attribute values that exactly one state has. In a world that is searched lazily, all
/// attribute values, also those of hidden attributes, but that of `gold` in a wumpus world, which may be left out; there, only the start
/// has an index, 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
pub enum StartReference {
    /// The state's index.
    #[cfg_attr(feature = "openapi", schema(value_type = u32))]
    Index(StateIdx),
    /// Values by attribute name.
    Values(BTreeMap<String, Scalar>),
    /// Several states, at least one.
    Several(Vec<StateReference>),
}

/// A state: its index, or attribute values that exactly one state has.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
pub enum StateReference {
    /// The state's index.
    #[cfg_attr(feature = "openapi", schema(value_type = u32))]
    Index(StateIdx),
    /// Values by attribute name.
    Values(BTreeMap<String, Scalar>),
}
