//! What a client registers as a learner.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{Algorithm, Distribution, Learner};
use crate::attribute::{Attribute, MAX_COST};
use crate::document::{Faults, Object, Path, Place, Quoted, Range, list_known, normal};

const DEFAULT_ALPHA: f64 = 0.5;
const DEFAULT_BETA: f64 = 0.1;
const DEFAULT_GAMMA: f64 = 0.99;
const DEFAULT_SD_MIN: f64 = 0.0;
const DEFAULT_MEAN: f64 = 1.0;
const DEFAULT_SD: f64 = 1.0;
const DEFAULT_REWARD_SCALE: f64 = 1000.0;
const DEFAULT_LEASE_S: u64 = 600;

impl Learner {
    /// Every field of a learner.
    const FIELDS: [&'static str; 8] =
        ["attributes", "algorithm", "mean", "sd", "expected_reward", "reward_scale", "seed", "lease_s"];

    /// Reads a learner.
    ///
    /// # Errors
    ///
    /// All faults of the document.
    pub fn read(document: &serde_json::Value) -> Result<Self, Faults> {
        let mut faults = Faults::default();
        let learner = read_learner(&Place::root(document), &mut faults);
        faults.check(learner)
    }

    /// The definition as a document in canonical form: defaults filled in. Reading it gives the same learner.
    #[must_use]
    pub fn document(&self) -> LearnerDocument {
        let Algorithm::Srv { alpha, beta, gamma, sd_min } = self.algorithm;
        LearnerDocument {
            attributes: self.attributes.clone(),
            algorithm: Some(AlgorithmDocument::Srv {
                alpha: Some(alpha),
                beta: Some(beta),
                gamma: Some(gamma),
                sd_min: Some(sd_min),
            }),
            mean: Some(self.per_attribute(&self.initial.mean)),
            sd: Some(self.per_attribute(&self.initial.sd)),
            expected_reward: self.initial.expected_reward,
            reward_scale: Some(self.reward_scale),
            seed: Some(self.seed),
            lease_s: Some(self.lease_s),
        }
    }

    /// One number if it is the same for all attributes.
    fn per_attribute(&self, numbers: &[f64]) -> PerAttributeDocument {
        match numbers {
            [first, rest @ ..] if rest.iter().all(|number| number == first) => PerAttributeDocument::All(*first),
            _ => {
                let named = self.attributes.iter().map(ToString::to_string).zip(numbers.iter().copied());
                PerAttributeDocument::ByName(named.collect())
            }
        }
    }
}

impl LearnerDocument {
    /// The document as JSON text. Of [`Learner::document`]: the canonical text, equal for equal content.
    ///
    /// # Panics
    ///
    /// Never: a document has no keys but strings.
    #[must_use]
    pub fn text(&self) -> String {
        serde_json::to_string(self).expect("a document has no keys but strings")
    }
}

fn read_learner(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Learner> {
    let object = place.object(&Learner::FIELDS, faults)?;
    let attributes = object.required("attributes", faults).and_then(|place| read_attributes(&place, faults));
    let names = attributes.as_deref();
    let algorithm = match object.optional("algorithm") {
        Some(place) => read_algorithm(&place, faults),
        None => Some(Algorithm::Srv {
            alpha: DEFAULT_ALPHA,
            beta: DEFAULT_BETA,
            gamma: DEFAULT_GAMMA,
            sd_min: DEFAULT_SD_MIN,
        }),
    };
    let mean = read_per_attribute(&object, "mean", DEFAULT_MEAN, names, faults);
    let sd = read_per_attribute(&object, "sd", DEFAULT_SD, names, faults);
    let expected_reward = match object.optional("expected_reward") {
        Some(place) => place.number(Range::Finite, faults).map(Some),
        None => Some(None),
    };
    let reward_scale = number(&object, "reward_scale", DEFAULT_REWARD_SCALE, Range::Positive, faults);
    let seed = integer(&object, "seed", 0, (0, u64::MAX), faults);
    let lease_s = integer(&object, "lease_s", DEFAULT_LEASE_S, (1, Learner::MAX_LEASE_S), faults);
    Some(Learner {
        attributes: attributes?,
        algorithm: algorithm?,
        initial: Distribution { mean: mean?, sd: sd?, expected_reward: expected_reward? },
        reward_scale: reward_scale?,
        seed: seed?,
        lease_s: lease_s?,
    })
}

fn read_attributes(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Arc<str>>> {
    let items = place.array(faults)?;
    if items.is_empty() || items.len() > Learner::MAX_ATTRIBUTES {
        let detail = format!("expected 1 to {} attributes, found {}", Learner::MAX_ATTRIBUTES, items.len());
        faults.note(place, detail);
        return None;
    }
    let mut names: Vec<Arc<str>> = Vec::with_capacity(items.len());
    for (n, item) in items.iter().enumerate() {
        let item = place.item(n, item);
        let Some(name) = item.string(faults).map(normal) else { continue };
        if !(1..=Attribute::MAX_NAME_CHARS).contains(&name.chars().count()) {
            item.mismatch::<()>(&format!("a name of 1 to {} characters", Attribute::MAX_NAME_CHARS), faults);
        }
        if names.iter().any(|other| **other == *name) {
            faults.note(&item, format!("the attribute {} stands twice", Quoted(&name)));
        }
        names.push(name.into());
    }
    (names.len() == items.len()).then_some(names)
}

fn read_algorithm(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Algorithm> {
    let object = place.object(&["kind", "alpha", "beta", "gamma", "sd_min"], faults)?;
    let kind = object.required("kind", faults).and_then(|place| match place.value.as_str() {
        Some("srv") => Some(()),
        _ => place.mismatch("\"srv\"", faults),
    });
    let alpha = number(&object, "alpha", DEFAULT_ALPHA, Range::NonNegative, faults);
    let beta = number(&object, "beta", DEFAULT_BETA, Range::UpTo(1.0), faults);
    let gamma = number(&object, "gamma", DEFAULT_GAMMA, Range::UpTo(1.0), faults);
    let sd_min = number(&object, "sd_min", DEFAULT_SD_MIN, Range::UpTo(MAX_COST), faults);
    kind?;
    Some(Algorithm::Srv { alpha: alpha?, beta: beta?, gamma: gamma?, sd_min: sd_min? })
}

/// Reads a number for each attribute: one for all, or an object by name, in which those left out keep `default`. Without
/// `names`, which then have a fault of their own, names are not checked.
fn read_per_attribute(
    object: &Object<'_, '_>,
    field: &str,
    default: f64,
    names: Option<&[Arc<str>]>,
    faults: &mut Faults,
) -> Option<Vec<f64>> {
    let mut numbers = vec![default; names.map_or(0, <[_]>::len)];
    let Some(place) = object.optional(field) else { return Some(numbers) };
    if !place.value.is_object() {
        if !place.value.is_number() {
            return place.mismatch("a number of at least 0, or an object of them by attribute", faults);
        }
        numbers.fill(place.number(Range::UpTo(MAX_COST), faults)?);
        return Some(numbers);
    }
    for (name, member) in place.open_object(faults)?.iter() {
        let number = member.number(Range::UpTo(MAX_COST), faults);
        let Some(names) = names else { continue };
        if let Some(position) = names.iter().position(|other| **other == *normal(name)) {
            numbers[position] = number.unwrap_or(default);
        } else {
            let detail = format!("unknown attribute {}; the learner has {}", Quoted(name), list_known(names));
            faults.note_at(&Path::Member(&place.path, name), detail);
        }
    }
    Some(numbers)
}

fn number(object: &Object<'_, '_>, field: &str, default: f64, range: Range, faults: &mut Faults) -> Option<f64> {
    object.optional(field).map_or(Some(default), |place| place.number(range, faults))
}

fn integer(
    object: &Object<'_, '_>,
    field: &str,
    default: u64,
    (least, most): (u64, u64),
    faults: &mut Faults,
) -> Option<u64> {
    object.optional(field).map_or(Some(default), |place| place.integer(least, most, faults))
}

/// A learner, as it is written in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = LearnerDefinition))]
pub struct LearnerDocument {
    /// Names of the attributes whose weights are learned: 1 to 256, all different. A model that it is used with must have
    /// them all; further attributes of a model keep the model's weights.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<String>, example = json!(["x", "y", "heading", "gold", "arrows"])))]
    pub attributes: Vec<Arc<str>>,
    /// How it learns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub algorithm: Option<AlgorithmDocument>,
    /// Mean weights at first, each 0 to 1e150; 1 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean: Option<PerAttributeDocument>,
    /// Standard deviations at first, each 0 to 1e150; 1 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sd: Option<PerAttributeDocument>,
    /// The reward that is expected of the first trial; `null`: the first reward sets it.
    #[serde(default)]
    pub expected_reward: Option<f64>,
    /// What counts as a large difference of rewards. Above 0; 1000 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0.0, example = 1000))]
    pub reward_scale: Option<f64>,
    /// Together with a trial's number, what its draw is keyed by; 0 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(example = 7))]
    pub seed: Option<u64>,
    /// How long a trial may take before it expires, in seconds; 600 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 31_536_000, example = 600))]
    pub lease_s: Option<u64>,
}

/// How a learner learns.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "kind", rename_all = "lowercase")]
#[cfg_attr(feature = "openapi", schema(as = Algorithm))]
pub enum AlgorithmDocument {
    /// The paper's rule; see `srv` in the README.
    #[cfg_attr(feature = "openapi", schema(title = "SrvAlgorithm"))]
    Srv {
        /// How far a trial moves the means. At least 0; 0.5 if left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "openapi", schema(minimum = 0.0))]
        alpha: Option<f64>,
        /// How far a trial moves the expected reward; 0.1 if left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "openapi", schema(minimum = 0.0, maximum = 1.0))]
        beta: Option<f64>,
        /// What is left of the deviations after a trial; 0.99 if left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "openapi", schema(minimum = 0.0, maximum = 1.0))]
        gamma: Option<f64>,
        /// Deviations do not fall below this; 0 if left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "openapi", schema(minimum = 0.0))]
        sd_min: Option<f64>,
    },
}

/// A number for each attribute: one for all of them, or an object by attribute name; those left out keep the default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = PerAttribute))]
pub enum PerAttributeDocument {
    /// The same for all.
    All(f64),
    /// By attribute name.
    ByName(BTreeMap<String, f64>),
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn the_canonical_text_is_the_same_however_a_learner_was_written() {
        let short = json!({"attributes": ["x", "gold"], "mean": {"gold": 3}});
        let long = json!({
            "attributes": ["x", "gold"], "algorithm": {"kind": "srv", "alpha": 0.5, "beta": 0.1, "gamma": 0.99, "sd_min": 0},
            "mean": {"x": 1.0, "gold": 3.0}, "sd": {"x": 1, "gold": 1}, "expected_reward": null, "reward_scale": 1e3,
            "seed": 0, "lease_s": 600,
        });
        let text = |document: &Value| Learner::read(document).unwrap().document().text();
        assert_eq!(text(&short), text(&long));
        let canonical: Value = serde_json::from_str(&text(&short)).unwrap();
        assert_eq!(text(&canonical), text(&short));
        assert_eq!((&canonical["sd"], &canonical["mean"]["x"]), (&json!(1.0), &json!(1.0)));
    }

    #[test]
    fn all_faults_of_a_learner_are_told_at_once() {
        let document = json!({
            "attributes": ["x", "x", "", 3], "algorithm": {"kind": "sarsa", "alpha": -1, "beta": 2, "gamma": 1.5, "sd_min": -1},
            "mean": {"x": -1}, "sd": -1, "expected_reward": "high", "reward_scale": 0, "seed": 0.5, "lease_s": 0, "hurry": 1,
        });
        let faults = Learner::read(&document).unwrap_err();
        let mut pointers: Vec<_> = faults.listed().iter().map(|fault| fault.pointer.as_str()).collect();
        pointers.sort_unstable();
        assert_eq!(
            pointers,
            [
                "/algorithm/alpha",
                "/algorithm/beta",
                "/algorithm/gamma",
                "/algorithm/kind",
                "/algorithm/sd_min",
                "/attributes/1",
                "/attributes/2",
                "/attributes/3",
                "/expected_reward",
                "/hurry",
                "/lease_s",
                "/mean/x",
                "/reward_scale",
                "/sd",
                "/seed",
            ]
        );
        let unknown = json!({"attributes": ["x"], "mean": {"y": 1}, "sd": {"z": -1}});
        let faults = Learner::read(&unknown).unwrap_err();
        let pointers: Vec<_> = faults.listed().iter().map(|fault| fault.pointer.as_str()).collect();
        assert_eq!(pointers, ["/mean/y", "/sd/z", "/sd/z"]);
    }

    #[test]
    fn faults_of_a_learner_stay_short_however_many_and_long_its_names_are() {
        let names: Vec<_> = (0..255).map(|n| format!("{n:0>64}")).chain(["x".repeat(10_000)]).collect();
        let twice: Vec<_> = names.iter().skip(1).chain(names.last()).collect();
        let mean: Value = (0..1000).map(|n| (format!("m{n}"), json!(1))).collect();
        for document in [json!({"attributes": names, "mean": mean}), json!({"attributes": twice})] {
            let faults = Learner::read(&document).unwrap_err();
            let longest = faults.listed().iter().map(|fault| fault.detail.len()).max().unwrap();
            assert!(longest < 1000, "{longest}");
        }
    }
}
