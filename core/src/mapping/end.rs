//! The end of a mapping: did it succeed?

use serde::{Deserialize, Serialize};

use super::distances::plain_terms;
use crate::attribute::{ByAttribute, Value, Weights};
use crate::model::Model;

/// How a policy ends: the last state against the last observation, `D(o_n, s)`. Attributes that were not observed at last, or weigh
/// nothing, are not told apart.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PolicyEnd {
    /// The weighted distance, of which the weights of observations, extra steps and the end are no part. 0: it ends as the demonstration did.
    #[cfg_attr(feature = "openapi", schema(example = 1.0))]
    pub distance: f64,
    /// The distance's terms by attribute; those that are 0 are left out.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, f64>))]
    pub distance_by_attribute: ByAttribute<f64>,
}

impl PolicyEnd {
    /// The end in a state with this row, after this observation. Shapes `[n_attributes]`.
    pub(super) fn at(model: &Model, row: &[u32], observation: &[Option<Value>], weights: &Weights) -> Self {
        let mut by_attribute = vec![None; model.schema().len()];
        let mut distance = 0.0;
        let terms = plain_terms(model.schema(), model.states(), observation, weights, row);
        for (position, term) in terms.filter(|(_, term)| *term > 0.0) {
            distance += term;
            by_attribute[position] = Some(term);
        }
        Self { distance, distance_by_attribute: model.schema().by_some_attributes(by_attribute) }
    }
}
