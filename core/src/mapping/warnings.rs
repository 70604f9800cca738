//! What a request says and can hardly mean: an answer with it is right, and of little use.
//!
//! Every kind of warning is told once for each attribute, with the first observation and how often. Warnings change nothing.
//!
//! | kind | is told of |
//! |---|---|
//! | strange | a category or a label that no state has |
//! | far | a number all of whose observed values lie outside what the states have |
//! | swallowing | an attribute whose distance is the same for every state, and so large that others are lost in rounding |
//! | dear | actions that cost more than all distances together could ever shrink by |
//!
//! An attribute that weighs nothing, or was not observed, is told nothing of.

use serde::{Deserialize, Serialize};

use super::Problem;
use crate::attribute::{Attribute, Cycle, Kind, Value, Weights};
use crate::document::{Path, Quoted};
use crate::model::Model;

/// Something that can hardly be meant, and where it stands.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Warning {
    /// JSON pointer (RFC 6901) to the first value that it is about.
    #[cfg_attr(feature = "openapi", schema(example = "/demonstration/0/door"))]
    pub pointer: String,
    /// What is unlikely about it, and what may be meant.
    #[cfg_attr(feature = "openapi", schema(example = "no state has \"Open\"; is \"open\" meant? (in 3 observations)"))]
    pub detail: String,
}

/// The kinds of warnings that are told of an attribute.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
enum About {
    Strange,
    Far,
    Swallowing,
}

/// What was seen so far of what warnings are about. As it is stored, floats must keep their bits.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Watch {
    /// Of the attributes that weigh something, in schema order.
    watched: Vec<Watched>,
    /// What was told already.
    told: Vec<(usize, About)>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Watched {
    position: usize,
    weight: f64,
    /// How often it was observed.
    n_seen: usize,
    /// Of a number: the observation that saw it first, and the least and the greatest value seen.
    first: usize,
    seen: (f64, f64),
    /// Whether one of the numbers lies among those of the states.
    is_within: bool,
    strange: Option<Strange>,
    /// Distances that are the same for every state.
    same: Same,
}

/// Values that no state has.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Strange {
    first: usize,
    value: Value,
    n: usize,
    /// Whether there are others than the first.
    are_several: bool,
}

#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
struct Same {
    first: usize,
    n: usize,
    sum: f64,
}

/// Of a sum, the part that is lost in rounding.
const ROUNDING: f64 = f64::EPSILON / 2.0;

impl Watch {
    /// Nothing seen yet.
    #[must_use]
    pub fn new(weights: &Weights) -> Self {
        let weighted = weights.as_slice().iter().enumerate().filter(|(_, weight)| **weight > 0.0);
        let watched = weighted.map(|(position, weight)| Watched {
            position,
            weight: *weight,
            n_seen: 0,
            first: 0,
            seen: (f64::INFINITY, f64::NEG_INFINITY),
            is_within: false,
            strange: None,
            same: Same::default(),
        });
        Self { watched: watched.collect(), told: Vec::new() }
    }

    /// Takes in an observation: that at `index`, of shape `[n_attributes]`.
    pub fn observe(&mut self, model: &Model, index: usize, observation: &[Option<Value>]) {
        for watched in &mut self.watched {
            if let Some(value) = &observation[watched.position] {
                watched.observe(model, index, value);
            }
        }
    }

    /// All there is to warn of, the places of which are within the observations at `path`.
    #[must_use]
    pub fn warnings(&self, model: &Model, path: &Path<'_>) -> Vec<Warning> {
        self.about(model).map(|about| self.tell(model, about, |index| index, path)).collect()
    }

    /// What there is to warn of that was not told before. The first of the observations at `path` is that at `first`.
    pub fn news(&mut self, model: &Model, first: usize, path: &Path<'_>) -> Vec<Warning> {
        let new: Vec<_> = self.about(model).filter(|about| !self.told.contains(about)).collect();
        // What was a trifle in earlier observations has become more by these.
        let within = |index: usize| index.saturating_sub(first);
        let warnings = new.iter().map(|about| self.tell(model, *about, within, path)).collect();
        self.told.extend(new);
        warnings
    }

    /// What there is to warn of: attributes and kinds, by the numbers of the watched.
    fn about(&self, model: &Model) -> impl Iterator<Item = (usize, About)> {
        let kinds = move |(n, watched): (usize, &Watched)| {
            let is_far = watched.n_seen > 0 && !watched.is_within && model.range(watched.position).is_some();
            let is_swallowing =
                watched.same.n > 0 && watched.same.sum * ROUNDING > self.least_to_tell(model, n) / 1000.0;
            let kinds =
                [(watched.strange.is_some(), About::Strange), (is_far, About::Far), (is_swallowing, About::Swallowing)];
            kinds.into_iter().filter(|(is_so, _)| *is_so).map(move |(_, about)| (n, about))
        };
        self.watched.iter().enumerate().flat_map(kinds)
    }

    /// What the cheapest action costs, or a difference of 1 in another attribute, whichever is less. Infinite without either.
    fn least_to_tell(&self, model: &Model, n: usize) -> f64 {
        let actions = model.actions().iter().map(|action| action.cost).filter(|cost| *cost > 0.0);
        let others = self.watched.iter().enumerate().filter(|(other, watched)| *other != n && watched.n_seen > 0);
        actions.chain(others.map(|(_, watched)| watched.weight)).fold(f64::INFINITY, f64::min)
    }

    fn tell(
        &self,
        model: &Model,
        (n, about): (usize, About),
        within: impl Fn(usize) -> usize,
        path: &Path<'_>,
    ) -> Warning {
        let Watched { position, n_seen, first, seen, strange, same, .. } = &self.watched[n];
        let attribute = &model.schema().attributes()[*position];
        let (first, detail, n) = match (about, strange) {
            (About::Strange, Some(strange)) => (strange.first, strange.detail(attribute, model, *position), strange.n),
            (About::Swallowing, _) => {
                let detail = format!(
                    "the distance in this attribute is the same for every state, and so large ({:e} in all) that what actions and \
                     other attributes cost is lost in rounding: leave it out, or give it weight 0",
                    same.sum
                );
                (same.first, detail, same.n)
            }
            (About::Strange | About::Far, _) => {
                let (least, greatest) = model.range(*position).unwrap_or_default();
                let detail = format!(
                    "all observed values lie outside those of the states: observed are {}, states have {}; are they in other units?",
                    Span(seen.0, seen.1),
                    Span(least, greatest)
                );
                (*first, detail, *n_seen)
            }
        };
        let observation = Path::Item(path, within(first));
        let pointer = Path::Member(&observation, &attribute.name).to_string();
        let times = if n == 1 { "1 observation".to_owned() } else { format!("{n} observations") };
        Warning { pointer, detail: format!("{detail} (in {times})") }
    }
}

impl Watched {
    #[inline]
    fn observe(&mut self, model: &Model, index: usize, value: &Value) {
        let attribute = &model.schema().attributes()[self.position];
        if self.n_seen == 0 {
            self.first = index;
        }
        self.n_seen += 1;
        match (&attribute.kind, value) {
            (Kind::Number { .. }, Value::Number(number)) => {
                let Some((least, greatest)) = model.range(self.position) else { return };
                self.seen = (self.seen.0.min(*number), self.seen.1.max(*number));
                if (least..=greatest).contains(number) {
                    self.is_within = true;
                    return;
                }
                let [low, high] = [least, greatest].map(|own| attribute.term(self.weight, value, &Value::Number(own)));
                if (low - high).abs() <= low.max(high) * f64::EPSILON {
                    self.same = Same {
                        first: if self.same.n == 0 { index } else { self.same.first },
                        n: self.same.n + 1,
                        sum: self.same.sum + low,
                    };
                }
            }
            (Kind::Category | Kind::Cyclic { cycle: Cycle::Labels(_), .. }, value)
                if !model.has_value(self.position, value) =>
            {
                match &mut self.strange {
                    Some(strange) => {
                        strange.n += 1;
                        strange.are_several |= strange.value != *value;
                    }
                    None => {
                        self.strange = Some(Strange { first: index, value: value.clone(), n: 1, are_several: false });
                    }
                }
            }
            _ => {}
        }
    }
}

impl Strange {
    fn detail(&self, attribute: &Attribute, model: &Model, position: usize) -> String {
        /// A near match is looked for among so many values.
        const MAX_LOOKED_AT: usize = 10_000;
        const MAX_SHOWN: usize = 8;
        let domain = model.states().domain(position);
        let found = shown(attribute, &self.value);
        let several = if self.are_several { ", nor others that were observed" } else { "" };
        let forms = forms(&self.value);
        let resembles = |own: &&Value| self::forms(own).iter().any(|form| forms.contains(form));
        let differs = format!("no state has {found}{several}: it differs from all of them alike");
        if let Some(near) = domain.iter().take(MAX_LOOKED_AT).find(resembles) {
            return format!("{differs}; is {} meant?", shown(attribute, near));
        }
        let mut known: Vec<_> = domain.iter().take(MAX_SHOWN).map(|own| shown(attribute, own)).collect();
        if domain.len() > MAX_SHOWN {
            known.push("..".to_owned());
        }
        format!("{differs}; they have {}", known.join(", "))
    }
}

/// A value as a warning shows it.
fn shown(attribute: &Attribute, value: &Value) -> String {
    match attribute.write_value(value) {
        crate::attribute::Scalar::Text(text) => Quoted(&text).to_string(),
        scalar => scalar.to_string(),
    }
}

/// What else a value may be written as, by those who do not mind.
fn forms(value: &Value) -> Vec<String> {
    match value {
        Value::Text(text) => vec![text.trim().to_lowercase()],
        Value::Integer(integer @ (0 | 1)) => vec![integer.to_string(), (*integer == 1).to_string()],
        Value::Integer(integer) => vec![integer.to_string()],
        Value::Boolean(flag) => vec![flag.to_string(), u8::from(*flag).to_string()],
        Value::Number(_) | Value::Label(_) => Vec::new(),
    }
}

/// From one number to another.
struct Span(f64, f64);

impl std::fmt::Display for Span {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self(least, greatest) = self;
        if least == greatest { write!(f, "{least}") } else { write!(f, "{least} to {greatest}") }
    }
}

impl Problem<'_> {
    /// What the request says and can hardly mean, its demonstration being at `path`. `O(n_observations n_attributes)`.
    #[must_use]
    pub fn warnings(&self, path: &Path<'_>) -> Vec<Warning> {
        let mut watch = Watch::new(&self.weights);
        for (index, observation) in (0..).zip(self.demonstration.iter()) {
            watch.observe(self.model, self.number_of(index) as usize, observation);
        }
        let mut warnings = watch.warnings(self.model, path);
        warnings.extend(self.dear_actions(path));
        warnings
    }

    /// Warns of actions that cost more than all distances together could shrink by: to stay at the start is then always cheapest.
    fn dear_actions(&self, path: &Path<'_>) -> Option<Warning> {
        let least = self.body.least_cost();
        if least <= 0.0 || self.model.graph().has_own_costs() {
            return None;
        }
        // Whichever start it is of: what does not stay there pays an action, and the least distances at least.
        let closest = self.closest_start();
        let row = self.starts.iter(self.model).find(|(state, _)| *state == closest)?.1;
        let end_weight = self.conditions.end_weight;
        let mut gain =
            self.end_cost(row) - end_weight * self.least_distance(self.demonstration.observation(self.last()));
        for (index, observation) in self.demonstration.iter().enumerate() {
            let weight = self.conditions.observation_weight(index);
            gain += self.distances.distance(index, row) - weight * self.least_distance(observation);
            if gain >= least {
                return None;
            }
        }
        let detail = format!(
            "the cheapest action costs {least}, and all distances together could shrink by no more than {gain}: the body stays where \
             it starts; weigh attributes more, or let actions cost less"
        );
        (gain > 0.0).then(|| Warning { pointer: path.to_string(), detail })
    }

    /// No state is closer to this observation.
    fn least_distance(&self, observation: &[Option<Value>]) -> f64 {
        let attributes = self.model.schema().attributes().iter().zip(self.weights.as_slice()).zip(observation);
        let terms = attributes.enumerate().filter(|(_, ((_, weight), _))| **weight > 0.0);
        let least =
            terms.filter_map(|(position, ((attribute, weight), value))| match (&attribute.kind, value.as_ref()?) {
                (Kind::Number { .. }, value @ Value::Number(number)) => {
                    let (least, greatest) = self.model.range(position)?;
                    Some(attribute.term(*weight, value, &Value::Number(number.clamp(least, greatest))))
                }
                (Kind::Category, value) if !self.model.has_value(position, value) => Some(*weight),
                _ => None,
            });
        least.sum()
    }
}

#[cfg(test)]
mod tests;
