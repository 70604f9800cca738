//! Policies as they are answered, and as they are stored.
//!
//! As it is answered, a step names all attributes, though little of its state has changed since the step before. So what is stored
//! is the summary, which has all names already, and beside it the steps in short, which take less than a tenth of the space. The
//! answer is written from the same two, now and whenever it is asked for again.
//!
//! ```text
//! Mapping --> summary, ShortSteps --> answer
//!                |         |
//!              store     store --> read_answer: the same bytes
//! ```

use std::sync::Arc;

use serde::de::{Error as _, IgnoredAny};
use serde::{Deserialize, Serialize};

use super::cost::CostSum;
use super::policy::{Coverage, PolicySummary, SearchReport, Stamp};
use super::{Mapping, MoveKind, Problem};
use crate::attribute::ByAttribute;

/// A policy, as it is answered and as it is stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrittenPolicy {
    /// JSON: what a [`Policy`](super::Policy) is written as.
    pub answer: String,
    /// JSON: what a [`PolicySummary`] is written as.
    pub summary: String,
    /// The steps in short (postcard). In them, attributes are numbered as they stand in the summary's weights.
    pub steps: Vec<u8>,
}

impl WrittenPolicy {
    /// The policy of `mapping`, which must be of `problem`.
    ///
    /// # Errors
    ///
    /// Never: all of it can be written.
    pub fn new(stamp: &Stamp, problem: &Problem<'_>, mapping: &Mapping) -> Result<Self, WriteError> {
        let weights = problem.named_weights();
        let short = ShortSteps::of(problem, mapping)?;
        let mut is_exact = vec![false; problem.demonstration.len()];
        let mut n_terms = 0;
        for step in &short.steps {
            n_terms = step.n_terms.unwrap_or(n_terms);
            is_exact[step.observation as usize] |= n_terms == 0;
        }
        let summary = PolicySummary {
            id: stamp.id.as_deref(),
            model: &stamp.model,
            model_hash: &stamp.model_hash,
            learner: stamp.learner.as_deref(),
            weights_version: stamp.weights_version,
            weights: &weights,
            lookahead: stamp.lookahead,
            status: mapping.status,
            cost: mapping.cost,
            lower_bound: mapping.lower_bound,
            coverage: Coverage::of(&is_exact),
            search: SearchReport {
                expanded: mapping.n_expanded,
                generated: mapping.n_generated,
                elapsed_us: stamp.elapsed_us,
            },
            refines: stamp.refines.as_deref(),
            refined_by: None,
        };
        let summary = serde_json::to_string(&summary)?;
        let answer = answer(&summary, weights.iter().map(|(name, _)| name), &short)?;
        Ok(Self { answer, steps: postcard::to_allocvec(&short)?, summary })
    }
}

/// Why a policy could not be written, or read again: a defect, or something stored that this program does not write.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// In its JSON.
    #[error("a policy is not what JSON can hold")]
    Json(#[from] serde_json::Error),
    /// In its steps in short.
    #[error("the steps of a policy cannot be told")]
    Short(#[from] postcard::Error),
    /// In its steps in short, something is referred to that is not there.
    #[error("the steps of a policy refer to {0} that is not there")]
    Missing(&'static str),
}

/// The policy with this summary and these steps in short, as it was answered: JSON.
///
/// # Errors
///
/// If one of the two is not what this program writes.
pub(crate) fn read_answer(summary: &str, steps: &[u8]) -> Result<String, WriteError> {
    #[derive(Deserialize)]
    struct Weights {
        weights: ByAttribute<IgnoredAny>,
    }
    let Weights { weights } = serde_json::from_str(summary)?;
    answer(summary, weights.iter().map(|(name, _)| name), &postcard::from_bytes(steps)?)
}

/// The steps of a policy, in short. What some steps have more of than others stands together, in the order of the steps.
#[derive(Default, Serialize, Deserialize)]
struct ShortSteps {
    /// Names and costs of the actions that are taken.
    actions: Vec<(Arc<str>, f64)>,
    steps: Vec<ShortStep>,
    /// What of the state has changed since the step before, all of it for the first one: attributes, and the bytes that their values
    /// take in `values`.
    changed: Vec<(u32, u32)>,
    /// JSON, one after the other.
    values: String,
    /// Attributes, and the terms of the distance that are not 0.
    terms: Vec<(u32, f64)>,
}

/// A step. It has its number and its move from those before it.
#[derive(Serialize, Deserialize)]
struct ShortStep {
    observation: u32,
    /// Its place among the actions.
    action: Option<u32>,
    state_index: u32,
    /// Of the steps up to and including this one.
    cost: f64,
    n_changed: u32,
    /// `None` if the terms are those of the step before.
    n_terms: Option<u32>,
}

impl ShortSteps {
    fn of(problem: &Problem<'_>, mapping: &Mapping) -> Result<Self, WriteError> {
        let model = problem.model;
        let attributes = model.schema().attributes();
        let states = mapping.states.as_ref().unwrap_or(model.states());
        let mut short = Self { steps: Vec::with_capacity(mapping.moves.len()), ..Self::default() };
        let mut values = Vec::new();
        let mut sum = CostSum::default();
        // Of the step before: its row, and where its terms stand.
        let (mut row, mut terms): (&[u32], _) = (&[], 0..0);
        for step in &mapping.moves {
            let before = std::mem::replace(&mut row, states.row(step.state));
            let n_before = short.changed.len();
            for (position, (attribute, value)) in attributes.iter().zip(row).enumerate() {
                if before.get(position) != Some(value) {
                    let from = values.len();
                    let value = attribute.written(&states.domain(position)[*value as usize]);
                    serde_json::to_writer(&mut values, &value)?;
                    short.changed.push((count(position), count(values.len() - from)));
                }
            }
            let from = short.terms.len();
            let own_terms = problem.distances.terms(step.observation as usize, row);
            short
                .terms
                .extend(own_terms.filter(|(_, term)| *term > 0.0).map(|(position, term)| (count(position), term)));
            let n_terms = if short.terms[from..] == short.terms[terms.clone()] {
                short.terms.truncate(from);
                None
            } else {
                terms = from..short.terms.len();
                Some(count(terms.len()))
            };
            let action = step.action.map(|action| model.action(action));
            let action_cost = action.map_or(0.0, |action| action.cost);
            sum.add(action_cost, distance(&short.terms[terms.clone()]));
            let action = action.map(|action| short.place_of(&action.name, action_cost));
            short.steps.push(ShortStep {
                observation: step.observation,
                action,
                state_index: step.state,
                cost: sum.total(),
                n_changed: count(short.changed.len() - n_before),
                n_terms,
            });
        }
        short.values = String::from_utf8(values).map_err(serde_json::Error::custom)?;
        Ok(short)
    }

    /// The place of the action called `name`.
    fn place_of(&mut self, name: &Arc<str>, cost: f64) -> u32 {
        let known = self.actions.iter().position(|(known, _)| known == name);
        count(known.unwrap_or_else(|| {
            self.actions.push((Arc::clone(name), cost));
            self.actions.len() - 1
        }))
    }
}

/// The sum of the terms of a distance, in their order.
fn distance(terms: &[(u32, f64)]) -> f64 {
    // Not `sum`, of which nothing is -0.
    terms.iter().fold(0.0, |sum, (_, term)| sum + term)
}

/// A number of things of which a policy has far fewer than 2^32.
fn count(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// Writes a policy as it is answered: its summary, with the actions and the steps before the coverage. `names` are those of the
/// attributes.
fn answer<'n>(summary: &str, names: impl Iterator<Item = &'n str>, short: &ShortSteps) -> Result<String, WriteError> {
    /// What comes after the steps. No string in JSON has a quote that is not escaped, and no weight is an object.
    const AFTER: &str = r#""coverage":{"#;
    let (before, after) = summary.split_at(summary.rfind(AFTER).ok_or(WriteError::Missing("a coverage"))?);
    let actions = short.actions.iter().map(|(name, cost)| Ok((serde_json::to_string(name)?, *cost)));
    let actions = actions.collect::<Result<Vec<_>, WriteError>>()?;
    let action_at = |place: u32| actions.get(place as usize).ok_or(WriteError::Missing("an action"));

    let mut writer = AnswerWriter::new(names, summary.len(), short.steps.len())?;
    writer.raw(before);
    writer.raw(r#""actions":["#);
    for (n, place) in short.steps.iter().filter_map(|step| step.action).enumerate() {
        writer.raw(if n == 0 { "" } else { "," });
        writer.raw(&action_at(place)?.0);
    }
    writer.raw(r#"],"steps":["#);
    let (mut changed, mut values) = (short.changed.iter(), short.values.as_str());
    let mut terms = short.terms.as_slice();
    let mut before = None;
    for step in &short.steps {
        for (position, n_bytes) in changed.by_ref().take(step.n_changed as usize) {
            let (value, rest) = values.split_at_checked(*n_bytes as usize).ok_or(WriteError::Missing("a value"))?;
            writer.set_value(*position, value)?;
            values = rest;
        }
        if let Some(n_terms) = step.n_terms {
            let (own, rest) = terms.split_at_checked(n_terms as usize).ok_or(WriteError::Missing("a term"))?;
            writer.set_terms(own)?;
            terms = rest;
        }
        writer.raw(if before.is_none() { "" } else { "," });
        let kind = match (before.replace(step.observation), step.action) {
            (None, _) => MoveKind::Start,
            (Some(_), None) => MoveKind::Skip,
            (Some(before), Some(_)) if before == step.observation => MoveKind::Extra,
            (Some(_), Some(_)) => MoveKind::Match,
        };
        writer.step(step, kind, step.action.map(action_at).transpose()?)?;
    }
    writer.raw("],");
    writer.raw(after);
    Ok(String::from_utf8(writer.text).map_err(serde_json::Error::custom)?)
}

/// Writes the steps of a policy as they are answered. What a step has in common with the one before is kept as text.
struct AnswerWriter {
    text: Vec<u8>,
    /// By attribute, its name as that of a member of an object.
    names: Vec<String>,
    /// By attribute, the member of the state, with the comma before it.
    state: Vec<String>,
    /// The members of the distance by attribute.
    terms: Vec<u8>,
    distance: f64,
    n_steps: u32,
}

impl AnswerWriter {
    fn new<'n>(names: impl Iterator<Item = &'n str>, n_bytes: usize, n_steps: usize) -> serde_json::Result<Self> {
        /// About what a step takes, beside its state, and what each value of that takes, beside its name.
        const STEP_BYTES: usize = 192;
        const VALUE_BYTES: usize = 6;
        let names = names.map(|name| Ok(serde_json::to_string(name)? + ":"));
        let names = names.collect::<serde_json::Result<Vec<_>>>()?;
        let state_bytes: usize = names.iter().map(|name| name.len() + VALUE_BYTES).sum();
        let text = Vec::with_capacity(n_bytes + n_steps * (STEP_BYTES + state_bytes));
        Ok(Self { text, state: vec![String::new(); names.len()], names, terms: Vec::new(), distance: 0.0, n_steps: 0 })
    }

    /// Writes what is JSON already, or a part of it.
    fn raw(&mut self, text: &str) {
        self.text.extend_from_slice(text.as_bytes());
    }

    /// Writes a member of an object, whose name is given with what stands around it.
    fn member(&mut self, name: &str, value: impl Serialize) -> serde_json::Result<()> {
        self.raw(name);
        serde_json::to_writer(&mut self.text, &value)
    }

    /// From the next step on, the attribute at `position` has this value: JSON.
    fn set_value(&mut self, position: u32, value: &str) -> Result<(), WriteError> {
        let position = position as usize;
        let member = self.state.get_mut(position).ok_or(WriteError::Missing("an attribute"))?;
        member.clear();
        if position > 0 {
            member.push(',');
        }
        member.push_str(&self.names[position]);
        member.push_str(value);
        Ok(())
    }

    /// From the next step on, these are the terms of the distance.
    fn set_terms(&mut self, terms: &[(u32, f64)]) -> Result<(), WriteError> {
        self.distance = distance(terms);
        self.terms.clear();
        for (position, term) in terms {
            if !self.terms.is_empty() {
                self.terms.push(b',');
            }
            let name = self.names.get(*position as usize).ok_or(WriteError::Missing("an attribute"))?;
            self.terms.extend_from_slice(name.as_bytes());
            serde_json::to_writer(&mut self.terms, term)?;
        }
        Ok(())
    }

    /// Writes the next step. Its `action` is the name, as JSON, and the cost.
    fn step(&mut self, step: &ShortStep, kind: MoveKind, action: Option<&(String, f64)>) -> serde_json::Result<()> {
        self.member(r#"{"step":"#, self.n_steps)?;
        self.member(r#","observation":"#, step.observation)?;
        self.member(r#","move":"#, kind)?;
        self.raw(r#","action":"#);
        self.raw(action.map_or("null", |(name, _)| name));
        self.raw(r#","state":{"#);
        for member in &self.state {
            self.text.extend_from_slice(member.as_bytes());
        }
        self.member(r#"},"state_index":"#, step.state_index)?;
        self.member(r#","action_cost":"#, action.map_or(0.0, |(_, cost)| *cost))?;
        self.member(r#","distance":"#, self.distance)?;
        self.raw(r#","distance_by_attribute":{"#);
        self.text.extend_from_slice(&self.terms);
        self.member(r#"},"cost":"#, step.cost)?;
        self.raw("}");
        self.n_steps += 1;
        Ok(())
    }
}
