//! Weights of attributes in the distance.

/// One weight per attribute, in schema order. Shape `[n_attributes]`; each finite and at least 0. However large a
/// weight is, a term of a distance is at most [`MAX_COST`](super::MAX_COST).
#[derive(Clone, Debug, PartialEq)]
pub struct Weights(Vec<f64>);

impl Weights {
    /// Weights that the caller knows to be finite and at least 0.
    pub fn of(weights: impl IntoIterator<Item = f64>) -> Self {
        let weights: Vec<f64> = weights.into_iter().collect();
        debug_assert!(weights.iter().all(|weight| weight.is_finite() && *weight >= 0.0), "{weights:?}");
        Self(weights)
    }

    pub(crate) fn set(&mut self, position: usize, weight: f64) {
        self.0[position] = weight;
    }

    /// The weights, in schema order.
    #[must_use]
    pub fn as_slice(&self) -> &[f64] {
        &self.0
    }
}
