//! Policies as they are answered, and as they are stored.
//!
//! As it is answered, a step names all attributes, though little of its state has changed since the step before. So what is stored
//! is the summary, which has all names already, and beside it the steps in short, which take less than a tenth of the space. The
//! answer is written from the same two, now and whenever it is asked for again.
//!
//! This file is longer than 400 lines because what writes the stored form and what reads it again are kept side by side.
//!
//! ```text
//! Mapping --> summary, ShortSteps --> store
//!                 |         |           |
//!                 +--answer-+      read again: the same bytes
//! ```

use std::borrow::Cow;
use std::ops::Range;

use rustc_hash::FxHashMap;
use serde::de::Error as _;
use serde::{Deserialize, Serialize};

use super::cost::CostSum;
use super::policy::{Coverage, Policy, PolicySummary, SearchReport, Stamp};
use super::{Mapping, MoveKind, Problem};
use crate::attribute::ByAttribute;

/// A policy as it is stored, from which its answer is written.
#[derive(Clone, Debug, PartialEq)]
pub struct WrittenPolicy<'a> {
    /// JSON: what a [`PolicySummary`] is written as.
    summary: Cow<'a, str>,
    /// How many bytes of the summary an answer has before the actions and the steps.
    n_before: usize,
    /// Their names are those that the steps refer to, in this order.
    weights: ByAttribute<f64>,
    /// The steps in short. In them, attributes are numbered as they stand in the summary's weights.
    short: ShortSteps<'a>,
}

/// The members that follow the steps, in their order.
#[derive(Serialize)]
struct End<'a> {
    coverage: Coverage,
    search: SearchReport,
    refines: Option<&'a str>,
    /// What is stored has no link yet.
    refined_by: (),
}

impl End<'_> {
    /// How many bytes of `summary` are before these members.
    fn find(&self, summary: &str) -> Result<usize, WriteError> {
        let end = serde_json::to_string(self)?;
        let before = summary.strip_suffix(&end["{".len()..]).ok_or(WriteError::Summary)?;
        Ok(before.len())
    }
}

impl<'a> WrittenPolicy<'a> {
    /// The policy of `mapping`, which must be of `problem`.
    ///
    /// # Errors
    ///
    /// Never: all of it can be written.
    pub fn new(stamp: &Stamp, problem: &Problem<'a>, mapping: &Mapping) -> Result<Self, WriteError> {
        /// About what a summary takes, and each of its weights.
        const SUMMARY_BYTES: usize = 512;
        const WEIGHT_BYTES: usize = 24;
        let weights = problem.named_weights();
        let (short, coverage) = ShortSteps::of(problem, mapping)?;
        let search = SearchReport {
            expanded: mapping.n_expanded,
            generated: mapping.n_generated,
            elapsed_us: stamp.elapsed_us,
            stopped_by: mapping.stopped_by,
        };
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
            end: &mapping.end,
            warnings: &stamp.warnings,
            coverage,
            search,
            refines: stamp.refines.as_deref(),
            refined_by: None,
        };
        let mut text = Vec::with_capacity(SUMMARY_BYTES + weights.iter().count() * WEIGHT_BYTES);
        serde_json::to_writer(&mut text, &summary)?;
        let summary = String::from_utf8(text).map_err(serde_json::Error::custom)?;
        let n_before = End { coverage, search, refines: stamp.refines.as_deref(), refined_by: () }.find(&summary)?;
        Ok(Self { summary: summary.into(), n_before, weights, short })
    }

    /// The policy that was stored with this summary and these steps in short.
    ///
    /// # Errors
    ///
    /// If one of the two is not what this program writes.
    pub fn read(summary: &'a str, steps: ShortSteps<'a>) -> Result<Self, WriteError> {
        #[derive(Deserialize)]
        struct Summary {
            weights: ByAttribute<f64>,
            coverage: Coverage,
            search: SearchReport,
            refines: Option<String>,
        }
        let Summary { weights, coverage, search, refines } = serde_json::from_str(summary)?;
        let n_before = End { coverage, search, refines: refines.as_deref(), refined_by: () }.find(summary)?;
        Ok(Self { summary: summary.into(), n_before, weights, short: steps })
    }

    /// What is stored: the summary, JSON as that of a [`PolicySummary`], and the steps in short.
    #[must_use]
    pub fn into_stored(self) -> (String, ShortSteps<'a>) {
        (self.summary.into_owned(), self.short)
    }

    fn names(&self) -> impl Iterator<Item = &str> {
        self.weights.iter().map(|(name, _)| name)
    }

    /// Most bytes of its answer, with what a link to another policy needs: hardly more than there are.
    ///
    /// # Errors
    ///
    /// If what is stored is not what this program writes.
    pub fn answer_bytes(&self) -> Result<usize, WriteError> {
        /// The names of members, and numbers at their longest.
        const STEP_BYTES: usize = 240;
        const NUMBER_BYTES: usize = 25;
        /// What is between the summary and the steps, and a link.
        const OTHER_BYTES: usize = 256;
        let pieces = Pieces::of(self.names(), &self.short.actions)?;
        let mut value_bytes = vec![0; pieces.names.len()];
        let mut state_bytes: usize = pieces.names.iter().map(|name| name.len() + 1).sum();
        let (mut changed, mut terms) = (self.short.changed.iter(), self.short.terms.iter());
        let (mut term_bytes, mut n_bytes) = (0, self.summary.len() + OTHER_BYTES);
        for step in &self.short.steps {
            for (position, n_bytes) in changed.by_ref().take(step.n_changed as usize) {
                let value = value_bytes.get_mut(*position as usize).ok_or(WriteError::Missing("an attribute"))?;
                let before = std::mem::replace(value, *n_bytes as usize);
                state_bytes = state_bytes - before + *value;
            }
            if let Some(n_terms) = step.n_terms {
                term_bytes = 0;
                for term in terms.by_ref().take(n_terms as usize) {
                    term_bytes += pieces.name(term.attribute as usize)?.len() + NUMBER_BYTES;
                }
            }
            let action = step.action.map(|place| pieces.action(place)).transpose()?;
            // Once in its step, and once among the actions.
            let action_bytes = action.map_or(0, |action| 2 * action.name.len() + action.cost.len());
            n_bytes = n_bytes.saturating_add(STEP_BYTES + state_bytes + term_bytes + action_bytes);
        }
        Ok(n_bytes)
    }

    /// The policy as it is answered (JSON): what a [`Policy`] is written as. Begins with room for `n_bytes`, or for about
    /// as many as it takes.
    ///
    /// # Errors
    ///
    /// If it was stored, and that is not what this program writes.
    pub fn answer(&self, n_bytes: Option<usize>) -> Result<String, WriteError> {
        let Self { summary, n_before, short, .. } = self;
        let (before, end) = summary.split_at(*n_before);
        let pieces = Pieces::of(self.names(), &short.actions)?;
        let mut writer = AnswerWriter::new(&pieces, summary.len(), short.steps.len(), n_bytes)?;
        writer.raw(before);
        writer.raw(r#""actions":["#);
        for (n, place) in short.steps.iter().filter_map(|step| step.action).enumerate() {
            writer.raw(if n == 0 { "" } else { "," });
            writer.raw(pieces.action(place)?.name);
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
            writer.step(step, kind)?;
        }
        writer.raw("],");
        writer.raw(end);
        Ok(String::from_utf8(writer.text).map_err(serde_json::Error::custom)?)
    }
}

impl Policy {
    /// The policy of `mapping`, which must be of `problem`: what its answer tells.
    ///
    /// # Errors
    ///
    /// Only for costs beyond what JSON can hold.
    pub fn new(stamp: &Stamp, problem: &Problem<'_>, mapping: &Mapping) -> Result<Self, WriteError> {
        Ok(serde_json::from_str(&WrittenPolicy::new(stamp, problem, mapping)?.answer(None)?)?)
    }
}

/// Why a policy could not be written, or read again: a defect, or something stored that this program does not write.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// In its JSON.
    #[error("a policy is not what JSON can hold")]
    Json(#[from] serde_json::Error),
    /// In its steps in short, something is referred to that is not there.
    #[error("the steps of a policy refer to {0} that is not there")]
    Missing(&'static str),
    /// Its summary has other members, or in another order.
    #[error("the summary of a policy does not end with its coverage, its search and its links")]
    Summary,
}

/// The steps of a policy, in short. What some steps have more of than others stands together, in the order of the steps.
///
/// There to be serialized, in whatever format, and to be read as a [`WrittenPolicy`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShortSteps<'a> {
    /// Names and costs of the actions that are taken: an action has one entry for each cost of its transitions.
    #[serde(borrow)]
    actions: Vec<(&'a str, f64)>,
    steps: Vec<ShortStep>,
    /// What of the state has changed since the step before, all of it for the first one: attributes, and the bytes that their values
    /// take in `values`.
    changed: Vec<(u32, u32)>,
    /// JSON, one after the other.
    values: String,
    /// The terms of the distance that are not 0.
    terms: Vec<Term>,
}

/// What an attribute adds to the distance of a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Term {
    attribute: u32,
    #[serde(with = "short_float")]
    paid: f64,
}

/// A float as an integer with its bytes in reverse order. The last bytes of a round float are zero; so the integer is small, and takes two or
/// three bytes where small integers take few.
mod short_float {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "so serde calls it")]
    pub(super) fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        value.to_bits().swap_bytes().serialize(serializer)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        Ok(f64::from_bits(u64::deserialize(deserializer)?.swap_bytes()))
    }
}

/// A step. It has its number and its move from those before it, and its cost from all their action costs and terms.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct ShortStep {
    observation: u32,
    /// Its place among the actions.
    action: Option<u32>,
    state_index: u32,
    n_changed: u32,
    /// `None` if the terms are those of the step before.
    n_terms: Option<u32>,
}

impl<'a> ShortSteps<'a> {
    /// The steps of `mapping`, and how much of the demonstration they meet.
    fn of(problem: &Problem<'a>, mapping: &Mapping) -> Result<(Self, Coverage), WriteError> {
        let (model, recurrence) = (problem.model, problem.recurrence());
        let attributes = model.schema().attributes();
        let states = mapping.states.as_ref().unwrap_or(model.states());
        let n_steps = mapping.moves.len();
        // Most steps change a value or two, and differ from what was observed in one.
        let n_changed = attributes.len() + 2 * n_steps;
        let mut short = Self {
            actions: Vec::with_capacity(model.actions().len().min(n_steps)),
            steps: Vec::with_capacity(n_steps),
            changed: Vec::with_capacity(n_changed),
            values: String::new(),
            terms: Vec::with_capacity(n_steps),
        };
        let mut values = Vec::with_capacity(n_changed * VALUE_BYTES);
        let mut is_exact = vec![false; problem.demonstration.len()];
        let mut places = FxHashMap::default();
        // Of the step before: its row, and where its terms stand.
        let (mut row, mut terms): (&[u32], _) = (&[], 0..0);
        for (step, action_cost) in mapping.moves.iter().zip(&mapping.action_costs) {
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
            let i = step.observation as usize;
            let own_terms = problem.distances.terms(i, row).map(|(position, term)| {
                let paid = recurrence.paid(step.kind, term);
                Term { attribute: count(position), paid }
            });
            short.terms.extend(own_terms.filter(|term| term.paid > 0.0));
            is_exact[i] |= short.terms.len() == from && (problem.pays_at(step) || problem.is_met(i, states, row));
            let n_terms = if short.terms[from..] == short.terms[terms.clone()] {
                short.terms.truncate(from);
                None
            } else {
                terms = from..short.terms.len();
                Some(count(terms.len()))
            };
            let action = step.action.map(|action| {
                *places.entry((action, action_cost.to_bits())).or_insert_with(|| {
                    short.actions.push((&model.action(action).name, *action_cost));
                    count(short.actions.len() - 1)
                })
            });
            short.steps.push(ShortStep {
                observation: problem.number_of(step.observation),
                action,
                state_index: step.state,
                n_changed: count(short.changed.len() - n_before),
                n_terms,
            });
        }
        short.values = String::from_utf8(values).map_err(serde_json::Error::custom)?;
        let n_exact = is_exact.iter().filter(|is_exact| **is_exact).count();
        Ok((short, Coverage { observed: count(is_exact.len()), exact: count(n_exact) }))
    }

    /// About how many bytes they take in a format in which small numbers take one.
    #[must_use]
    pub fn n_bytes(&self) -> usize {
        /// Most numbers take one.
        const STEP_BYTES: usize = 8;
        const ACTION_BYTES: usize = 24;
        /// At most.
        const TERM_BYTES: usize = 11;
        self.actions.len() * ACTION_BYTES
            + self.steps.len() * STEP_BYTES
            + self.changed.len() * 2
            + self.values.len()
            + self.terms.len() * TERM_BYTES
            + STEP_BYTES
    }
}

/// A number of things of which a policy has far fewer than 2^32.
fn count(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// About how many bytes a value of a state takes.
const VALUE_BYTES: usize = 6;

/// JSON that an answer has more than once.
struct Pieces {
    /// One after the other.
    text: Vec<u8>,
    /// By attribute, where its name is, as that of a member of an object.
    names: Vec<Range<usize>>,
    /// By action, where its name and its cost are, and that cost.
    actions: Vec<(Range<usize>, Range<usize>, f64)>,
}

/// An action that was taken.
struct ActionPiece<'p> {
    /// JSON, as is the next.
    name: &'p [u8],
    cost: &'p [u8],
    paid: f64,
}

impl ActionPiece<'_> {
    /// What stands for one in a step without any.
    const NONE: Self = Self { name: b"null", cost: b"0.0", paid: 0.0 };
}

impl Pieces {
    fn of<'n>(names: impl Iterator<Item = &'n str>, actions: &[(&str, f64)]) -> serde_json::Result<Self> {
        /// About what a name takes, or a cost.
        const PIECE_BYTES: usize = 16;
        let n_names = names.size_hint().0;
        let mut pieces = Self {
            text: Vec::with_capacity((n_names + 2 * actions.len()) * PIECE_BYTES),
            names: Vec::with_capacity(n_names),
            actions: Vec::with_capacity(actions.len()),
        };
        for name in names {
            let name = pieces.add(name)?;
            pieces.text.push(b':');
            pieces.names.push(name.start..name.end + 1);
        }
        for (name, cost) in actions {
            let action = (pieces.add(name)?, pieces.add(cost)?, *cost);
            pieces.actions.push(action);
        }
        Ok(pieces)
    }

    fn add(&mut self, piece: &(impl Serialize + ?Sized)) -> serde_json::Result<Range<usize>> {
        let from = self.text.len();
        serde_json::to_writer(&mut self.text, piece)?;
        Ok(from..self.text.len())
    }

    /// The name of the attribute at `position`.
    fn name(&self, position: usize) -> Result<&[u8], WriteError> {
        let name = self.names.get(position).ok_or(WriteError::Missing("an attribute"))?;
        Ok(&self.text[name.clone()])
    }

    /// The action at `place`.
    fn action(&self, place: u32) -> Result<ActionPiece<'_>, WriteError> {
        let (name, cost, paid) = self.actions.get(place as usize).ok_or(WriteError::Missing("an action"))?;
        Ok(ActionPiece { name: &self.text[name.clone()], cost: &self.text[cost.clone()], paid: *paid })
    }
}

/// Writes the steps of a policy as they are answered. What a step has in common with the one before is kept as text.
struct AnswerWriter<'p> {
    text: Vec<u8>,
    pieces: &'p Pieces,
    /// By attribute.
    values: Vec<StateValue<'p>>,
    /// The members of the state; empty where they are to be written anew.
    state: Vec<u8>,
    /// The distance, and the members that tell it.
    distance: f64,
    distance_text: Vec<u8>,
    /// Of the steps so far.
    cost: CostSum,
    n_steps: u32,
}

/// A value of the state.
#[derive(Clone, Default)]
struct StateValue<'p> {
    /// JSON.
    text: &'p str,
    /// Where it begins among the members of the state.
    at: usize,
}

impl<'p> AnswerWriter<'p> {
    /// A writer of so many steps, with `n_around` bytes around them, which are `n_bytes` in all if that is known.
    fn new(pieces: &'p Pieces, n_around: usize, n_steps: usize, n_bytes: Option<usize>) -> Result<Self, WriteError> {
        /// About what a step takes, beside its state.
        const STEP_BYTES: usize = 192;
        let state_bytes: usize = pieces.names.iter().map(|name| name.len() + VALUE_BYTES).sum();
        let mut writer = Self {
            text: Vec::with_capacity(n_bytes.unwrap_or(n_around + n_steps * (STEP_BYTES + state_bytes))),
            pieces,
            values: vec![StateValue::default(); pieces.names.len()],
            state: Vec::with_capacity(state_bytes),
            distance: 0.0,
            distance_text: Vec::with_capacity(STEP_BYTES),
            cost: CostSum::default(),
            n_steps: 0,
        };
        writer.set_terms(&[])?;
        Ok(writer)
    }

    /// Writes what is JSON already, or a part of it.
    fn raw(&mut self, text: impl AsRef<[u8]>) {
        self.text.extend_from_slice(text.as_ref());
    }

    /// Writes a member of an object, whose name is given with what stands around it.
    fn member(&mut self, name: &str, value: impl Serialize) -> serde_json::Result<()> {
        self.raw(name);
        serde_json::to_writer(&mut self.text, &value)
    }

    /// From the next step on, the attribute at `position` has this value: JSON.
    fn set_value(&mut self, position: u32, text: &'p str) -> Result<(), WriteError> {
        let value = self.values.get_mut(position as usize).ok_or(WriteError::Missing("an attribute"))?;
        match self.state.get_mut(value.at..value.at + text.len()) {
            Some(before) if value.text.len() == text.len() => before.copy_from_slice(text.as_bytes()),
            _ => self.state.clear(),
        }
        value.text = text;
        Ok(())
    }

    /// Writes the members of the state anew.
    fn write_state(&mut self) -> Result<(), WriteError> {
        for (position, value) in self.values.iter_mut().enumerate() {
            if position > 0 {
                self.state.push(b',');
            }
            self.state.extend_from_slice(self.pieces.name(position)?);
            value.at = self.state.len();
            self.state.extend_from_slice(value.text.as_bytes());
        }
        Ok(())
    }

    /// From the next step on, these are the terms of the distance.
    fn set_terms(&mut self, terms: &[Term]) -> Result<(), WriteError> {
        // Not `sum`, of which nothing is -0.
        self.distance = terms.iter().fold(0.0, |sum, term| sum + term.paid);
        let text = &mut self.distance_text;
        text.clear();
        text.extend_from_slice(br#""distance":"#);
        serde_json::to_writer(&mut *text, &self.distance)?;
        text.extend_from_slice(br#","distance_by_attribute":{"#);
        for (n, term) in terms.iter().enumerate() {
            if n > 0 {
                text.push(b',');
            }
            text.extend_from_slice(self.pieces.name(term.attribute as usize)?);
            serde_json::to_writer(&mut *text, &term.paid)?;
        }
        text.push(b'}');
        Ok(())
    }

    /// Writes the next step.
    fn step(&mut self, step: &ShortStep, kind: MoveKind) -> Result<(), WriteError> {
        let action = step.action.map(|place| self.pieces.action(place)).transpose()?;
        let action = action.unwrap_or(ActionPiece::NONE);
        self.cost.add(action.paid, self.distance);
        if self.state.is_empty() {
            self.write_state()?;
        }
        self.member(r#"{"step":"#, self.n_steps)?;
        self.member(r#","observation":"#, step.observation)?;
        self.raw(match kind {
            MoveKind::Start => r#","move":"start","action":"#,
            MoveKind::Match => r#","move":"match","action":"#,
            MoveKind::Extra => r#","move":"extra","action":"#,
            MoveKind::Skip => r#","move":"skip","action":"#,
        });
        self.raw(action.name);
        self.raw(r#","state":{"#);
        self.text.extend_from_slice(&self.state);
        self.member(r#"},"state_index":"#, step.state_index)?;
        self.raw(r#","action_cost":"#);
        self.raw(action.cost);
        self.raw(",");
        self.text.extend_from_slice(&self.distance_text);
        self.member(r#","cost":"#, self.cost.total())?;
        self.raw("}");
        self.n_steps += 1;
        Ok(())
    }
}
