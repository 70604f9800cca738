//! What a learner knows.

/// A normal distribution of the weight of each attribute, and the reward that is expected of a trial.
#[derive(Clone, Debug, PartialEq)]
pub struct Distribution {
    /// Mean weights, `m_k`. Shape `[n_attributes]`; each from 0 to [`MAX_COST`](crate::attribute::MAX_COST).
    pub mean: Vec<f64>,
    /// Standard deviations, `sigma_k`. Shape `[n_attributes]`; each finite and at least 0.
    pub sd: Vec<f64>,
    /// `E`; `None` until it is configured or a reward has set it. Finite.
    pub expected_reward: Option<f64>,
}

impl Distribution {
    /// Whether both have the same bits, as they must after the log was replayed.
    #[must_use]
    pub fn has_bits_of(&self, other: &Self) -> bool {
        let bits = |distribution: &Self| -> Vec<u64> {
            let Self { mean, sd, expected_reward } = distribution;
            mean.iter().chain(sd).chain(expected_reward).map(|number| number.to_bits()).collect()
        };
        self.mean.len() == other.mean.len()
            && self.expected_reward.is_some() == other.expected_reward.is_some()
            && bits(self) == bits(other)
    }
}
