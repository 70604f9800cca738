//! The rule by which a learner draws and learns.

use std::sync::Arc;

use rand_chacha::ChaCha12Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution as _, StandardNormal};

use super::Distribution;
use crate::attribute::{ByAttribute, MAX_COST, Schema, Weights};
use crate::document::list_known;

/// A learner as it was registered: checked, with defaults filled in. Outlives models.
#[derive(Clone, Debug, PartialEq)]
pub struct Learner {
    /// The attributes whose weights it learns, by name: at least one, all different. Shape `[n_attributes]`.
    pub(super) attributes: Vec<Arc<str>>,
    /// How it learns.
    pub(super) algorithm: Algorithm,
    /// The initial distribution: version 0 of its weights.
    pub(super) initial: Distribution,
    /// Scale of rewards: differences of rewards are divided by it. Above 0.
    pub(super) reward_scale: f64,
    /// Seed of its draws. A draw is keyed by the seed and the number of the trial.
    pub(super) seed: u64,
    /// Lease of a trial, in seconds: a trial that takes longer expires. At least 1.
    pub(super) lease_s: u64,
}

/// How a learner learns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Algorithm {
    /// The paper's rule.
    Srv {
        /// How far a trial moves the means. At least 0.
        alpha: f64,
        /// How far a trial moves the expected reward: 0 to 1.
        beta: f64,
        /// Factor by which a trial shrinks the deviations: 0 to 1.
        gamma: f64,
        /// Deviations do not fall below this. At least 0.
        sd_min: f64,
    },
}

impl Learner {
    /// Most attributes of a learner; as many as a model may have.
    pub const MAX_ATTRIBUTES: usize = Schema::MAX_ATTRIBUTES;
    /// Longest lease: a year.
    pub const MAX_LEASE_S: u64 = 31_536_000;

    /// The attributes whose weights it learns, in the order in which everything of this learner is written.
    #[must_use]
    pub fn attributes(&self) -> &[Arc<str>] {
        &self.attributes
    }

    /// The initial distribution.
    #[must_use]
    pub fn initial(&self) -> &Distribution {
        &self.initial
    }

    /// Lease of a trial, in seconds.
    #[must_use]
    pub fn lease_s(&self) -> u64 {
        self.lease_s
    }

    /// The same learner with `distribution` as its initial one, for example that of a learner which has learned already.
    #[must_use]
    pub fn starting_from(self, distribution: Distribution) -> Self {
        Self { initial: distribution, ..self }
    }

    /// Draws the weights of the trial `number` from `distribution`: `max(0, m_k + sigma_k z_k)`. Shape `[n_attributes]`, each
    /// finite and at least 0.
    ///
    /// The `z_k` are standard normal (the ziggurat of `rand_distr`), in the order of the attributes, from `ChaCha12` with the
    /// seed in the first eight bytes of its key (little endian, the rest 0) and the number as its stream. So they depend on seed
    /// and number alone, whatever else is drawn at the same time.
    #[must_use]
    pub fn draw(&self, distribution: &Distribution, number: u64) -> Vec<f64> {
        let mut key = [0; 32];
        key[..8].copy_from_slice(&self.seed.to_le_bytes());
        let mut random = ChaCha12Rng::from_seed(key);
        random.set_stream(number);
        let attributes = distribution.mean.iter().zip(&distribution.sd);
        let drawn = attributes.map(|(mean, sd)| {
            let z: f64 = StandardNormal.sample(&mut random);
            (mean + sd * z).clamp(0.0, MAX_COST)
        });
        drawn.collect()
    }

    /// Learns from a trial with the drawn `weights` and the `reward` that it earned (Gudla & Huber, stochastic
    /// real-valued units after Gullapalli 1990). All three use the old `E`:
    ///
    /// ```text
    /// m_k     <- max(0, m_k + alpha (R - E) / reward_scale (w_k - m_k))
    /// sigma_k <- max(sd_min, gamma sigma_k)
    /// E       <- E + beta (R - E)
    /// ```
    ///
    /// If there is no `E` yet, the reward becomes `E` first, so the means stay. Results stay finite where floats overflow: means end at
    /// [`MAX_COST`], `E` at the largest float.
    pub fn learn(&self, distribution: &mut Distribution, weights: &[f64], reward: f64) {
        let Algorithm::Srv { alpha, beta, gamma, sd_min } = self.algorithm;
        let expected = distribution.expected_reward.unwrap_or(reward);
        let surprise = reward - expected;
        for (mean, weight) in distribution.mean.iter_mut().zip(weights) {
            let moved = *mean + alpha * surprise / self.reward_scale * (weight - *mean);
            // Infinity times 0 is NaN: where the weight was the mean, the mean stays.
            *mean = if moved.is_nan() { *mean } else { moved.clamp(0.0, MAX_COST) };
        }
        for sd in &mut distribution.sd {
            *sd = (gamma * *sd).max(sd_min);
        }
        let moved = expected + beta * surprise;
        let moved = if moved.is_nan() { expected } else { moved.clamp(f64::MIN, f64::MAX) };
        distribution.expected_reward = Some(moved);
    }

    /// Names `items`, one per attribute of the learner.
    pub fn by_attribute<T>(&self, items: impl IntoIterator<Item = T>) -> ByAttribute<T> {
        self.attributes.iter().cloned().zip(items).collect()
    }

    /// The weights of a distance between states of `schema`: `weights`, one per attribute of the learner, and the schema's
    /// own for attributes that the learner does not know.
    ///
    /// # Errors
    ///
    /// [`MissingAttributes`] if the schema lacks some of the learner's.
    pub fn weights_for(&self, schema: &Schema, weights: &[f64]) -> Result<Weights, MissingAttributes> {
        let mut all = schema.weights();
        let mut missing = Vec::new();
        for (attribute, weight) in self.attributes.iter().zip(weights) {
            match schema.position(attribute) {
                Some(position) => all.set(position, *weight),
                None => missing.push(attribute.to_string()),
            }
        }
        if missing.is_empty() { Ok(all) } else { Err(MissingAttributes { missing }) }
    }
}

/// A model lacks attributes of a learner.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the model has no attribute {}, of which the learner knows the weight", list_known(missing))]
pub struct MissingAttributes {
    /// Their names.
    pub missing: Vec<String>,
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn learner(definition: &serde_json::Value) -> Learner {
        Learner::read(definition).unwrap()
    }

    fn example() -> Learner {
        learner(&json!({"attributes": ["x", "y", "heading", "gold", "arrows"], "seed": 7}))
    }

    /// A change of these is a change of what every seed gives: review it as one.
    #[test]
    fn draws_are_pinned() {
        let learner = example();
        let draw = |number| learner.draw(learner.initial(), number);
        assert_eq!(
            draw(1),
            [0.585_159_418_273_943_2, 0.825_112_406_379_791, 0.0, 2.737_117_010_981_416_7, 0.263_996_826_833_774_8]
        );
        assert_eq!(
            draw(2),
            [
                0.366_999_432_619_707_24,
                0.368_859_702_219_458_1,
                0.865_714_702_394_958,
                1.462_272_183_149_819_8,
                0.530_339_935_633_311_8
            ]
        );
        assert_eq!(draw(1), draw(1), "whatever was drawn in between");
    }

    #[test]
    fn a_first_reward_sets_what_is_expected_and_leaves_the_means() {
        let learner = example();
        let mut distribution = learner.initial().clone();
        learner.learn(&mut distribution, &[2.0, 0.0, 1.0, 3.0, 1.0], -19.0);
        assert_eq!(distribution.mean, learner.initial().mean);
        assert_eq!((distribution.sd[0], distribution.expected_reward), (0.99, Some(-19.0)));
    }

    #[test]
    fn a_better_reward_than_expected_pulls_the_means_and_a_worse_one_pushes_them() {
        let definition = json!({
            "attributes": ["a", "b"], "expected_reward": 100, "reward_scale": 10, "mean": {"a": 1, "b": 0.5}, "sd": 2,
            "algorithm": {"kind": "srv", "alpha": 0.5, "beta": 0.25, "gamma": 0.5, "sd_min": 0.75},
        });
        let learner = learner(&definition);
        let mut distribution = learner.initial().clone();
        learner.learn(&mut distribution, &[3.0, 0.0], 110.0);
        // m_a = 1 + 0.5 * 10 / 10 * 2, m_b = 0.5 + 0.5 * 10 / 10 * -0.5, E = 100 + 0.25 * 10
        let expected = Distribution { mean: vec![2.0, 0.25], sd: vec![1.0, 1.0], expected_reward: Some(102.5) };
        assert_eq!(distribution, expected);
        learner.learn(&mut distribution, &[2.5, 8.0], 92.5);
        // m_a = 2 - 0.5 * 0.5, m_b = 0.25 - 0.5 * 7.75 < 0, E = 102.5 - 0.25 * 10
        let expected = Distribution { mean: vec![1.75, 0.0], sd: vec![0.75, 0.75], expected_reward: Some(100.0) };
        assert_eq!(distribution, expected);
    }

    #[test]
    fn rewards_near_the_limit_of_floats_leave_the_distribution_finite() {
        let learner = example();
        let mut distribution = learner.initial().clone();
        for (number, reward) in [f64::MAX, f64::MIN, f64::MAX, 0.0, 1e-300].into_iter().enumerate() {
            let mut weights = learner.draw(&distribution, number as u64);
            // No difference, for an infinite surprise.
            weights[0] = distribution.mean[0];
            learner.learn(&mut distribution, &weights, reward);
            let Distribution { mean, sd, expected_reward } = &distribution;
            assert!(mean.iter().chain(sd).chain(expected_reward).all(|number| number.is_finite()), "{distribution:?}");
            assert!(mean.iter().all(|mean| (0.0..=MAX_COST).contains(mean)), "{distribution:?}");
        }
    }

    #[test]
    fn learned_weights_are_used_where_the_attributes_are_and_refused_where_they_are_not() {
        let schema = |attributes: &[&str]| {
            let attributes = attributes.iter().map(|name| crate::attribute::Attribute {
                name: (*name).to_owned(),
                kind: crate::attribute::Kind::Category,
                weight: 4.0,
                is_hidden: false,
            });
            Schema::of(attributes.collect())
        };
        let learner = learner(&json!({"attributes": ["a", "b"]}));
        let weights = learner.weights_for(&schema(&["b", "c", "a"]), &[0.5, 2.0]).unwrap();
        assert_eq!(weights.as_slice(), [2.0, 4.0, 0.5]);
        let missing = learner.weights_for(&schema(&["c"]), &[0.5, 2.0]).unwrap_err().missing;
        assert_eq!(missing, ["a", "b"]);
        let many: Vec<_> = (0..256).map(|n| format!("{n:0>64}")).collect();
        let missing =
            self::learner(&json!({"attributes": many})).weights_for(&schema(&["c"]), &[1.0; 256]).unwrap_err();
        assert!(missing.missing.len() == 256 && missing.to_string().len() < 1000, "{missing}");
    }
}
