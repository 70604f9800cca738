//! UMB, the binary format that Storm, PRISM and Modest share (<https://pmc-tools.github.io/umb/>): a tar archive of `index.json`, which says what there is, and of
//! columns of little-endian numbers.
//!
//! | column | has |
//! |---|---|
//! | `state-to-choices`, `choice-to-branches` | where the choices of each state begin, and the branches of each choice; one more than there are |
//! | `branch-to-target`, `branch-to-probability` | where each leads |
//! | `state-is-initial` | a bit for each state |
//! | `actions/choices/..` | the action of each choice, and the names of actions |
//! | `annotations/rewards/NAME/{states,choices,branches}/values` | rewards |
//! | `valuations/states/valuations` | values of states: bits in the order of variables, from the lowest |
//!
//! Version 1 with one player, discrete time and probabilities as floats is read.

mod columns;
mod index;

use std::io::BufRead;

use self::columns::{Bits, Ranges, Words};
use self::index::{Class, Field, Index, Valuations, field_size, value_of};
use super::choices::{Choices, Labels};
use super::draft::{Draft, DraftAttribute};
use super::tar::read_archive;
use super::{Edits, ImportError, Spot};
use crate::document::Quoted;
use crate::interrupt::Meter;
use crate::model::{Definition, Limits};

const VERSION: u64 = 1;

/// Reads a model.
pub(super) fn read(
    reader: impl BufRead,
    edits: &Edits,
    limits: Limits,
    meter: &mut Meter<'_>,
) -> Result<Definition, ImportError> {
    let archive = Archive(read_archive(reader, limits.max_bytes as u64)?);
    let index = archive.index()?;
    let system = &index.transition_system;
    let in_index = |detail: String| ImportError::at(Spot::Whole, detail).in_file(INDEX);
    if index.format_version != VERSION {
        return Err(in_index(format!("version {}; version {VERSION} is read here", index.format_version)));
    }
    if system.time != "discrete" || system.n_players > 1 {
        let detail =
            format!("{} players and {} time; one player and discrete time are read", system.n_players, system.time);
        return Err(in_index(detail));
    }
    let mut choices = Choices::new(Draft::new(limits));
    choices.draft.expect_states(system.n_states, Spot::Whole).map_err(|error| error.in_file(INDEX))?;
    if let Some(valuations) = index.valuations.get("states") {
        archive.read_values(valuations, system.n_states, &mut choices.draft)?;
    } else {
        let mut labels = Labels::default();
        for (id, annotation) in &index.annotations.aps {
            if annotation.applies_to.iter().any(|to| to == "states") {
                let bits = archive.bits(&format!("annotations/aps/{id}/states/values.bin"), system.n_states)?;
                let name = annotation.alias.as_ref().unwrap_or(id);
                let labelled = (0..system.n_states).filter(|state| bits.has(*state));
                labelled.for_each(|state| {
                    labels.note(name, state);
                });
            }
        }
        choices.label_states(system.n_states, &labels)?;
    }
    if system.n_initial > 0 {
        let bits = archive.bits("state-is-initial.bin", system.n_states)?;
        let initial =
            (0..system.n_states).filter(|state| bits.has(*state)).filter_map(|state| u32::try_from(state).ok());
        choices.draft.start.extend(initial);
    }
    archive.read_choices(&index, &mut choices, edits, meter)?;
    choices.draft.finish(edits, meter)
}

const INDEX: &str = "index.json";

/// The files of an archive.
struct Archive(Vec<(String, Vec<u8>)>);

impl Archive {
    fn file(&self, name: &str) -> Option<&[u8]> {
        self.0.iter().find(|(known, _)| known == name).map(|(_, content)| content.as_slice())
    }

    fn required(&self, name: &str) -> Result<&[u8], ImportError> {
        self.file(name)
            .ok_or_else(|| ImportError::at(Spot::Whole, format!("{} is missing in the archive", Quoted(name))))
    }

    fn index(&self) -> Result<Index, ImportError> {
        let read = serde_json::from_slice(self.required(INDEX)?);
        read.map_err(|error| {
            let spot = Spot::Line(error.line() as u64);
            let detail = error.to_string();
            ImportError::at(spot, detail.split(" at line ").next().unwrap_or_default()).in_file(INDEX)
        })
    }

    fn bits(&self, name: &str, n_bits: u64) -> Result<Bits<'_>, ImportError> {
        let bytes = self.required(name)?;
        let is_whole = bytes.len() as u64 >= n_bits.div_ceil(8);
        let detail = || format!("{} bytes, too few for {n_bits} bits", bytes.len());
        is_whole.then_some(Bits(bytes)).ok_or_else(|| ImportError::at(Spot::Whole, detail()).in_file(name))
    }

    fn words(&self, name: String, n_words: u64) -> Result<Option<Words<'_>>, ImportError> {
        let Some(content) = self.file(&name) else { return Ok(None) };
        let (bytes, rest) = content.as_chunks::<8>();
        if bytes.len() as u64 == n_words && rest.is_empty() {
            return Ok(Some(Words { name, bytes }));
        }
        let detail = format!("expected {n_words} numbers of 8 bytes, found {} bytes", content.len());
        Err(ImportError::at(Spot::Whole, detail).in_file(&name))
    }

    fn read_choices(
        &self,
        index: &Index,
        choices: &mut Choices,
        edits: &Edits,
        meter: &mut Meter<'_>,
    ) -> Result<(), ImportError> {
        let system = &index.transition_system;
        let (n_states, n_choices, n_branches) = (system.n_states, system.n_choices, system.n_branches);
        let of_states = Ranges(self.words("state-to-choices.bin".to_owned(), n_states.saturating_add(1))?);
        let of_choices = Ranges(self.words("choice-to-branches.bin".to_owned(), n_choices.saturating_add(1))?);
        let targets = self.words("branch-to-target.bin".to_owned(), n_branches)?;
        let targets =
            targets.ok_or_else(|| ImportError::at(Spot::Whole, "branch-to-target.bin is missing in the archive"))?;
        let probabilities = match &system.branch_probability_type {
            Some(of) if of.r#type != "double" || of.size.is_some_and(|size| size != 64) => {
                let detail = format!("probabilities of the type {}; double is read here", Quoted(&of.r#type));
                return Err(ImportError::at(Spot::Whole, detail).in_file(INDEX));
            }
            Some(_) => self.words("branch-to-probability.bin".to_owned(), n_branches)?,
            None => None,
        };
        let labels = self.action_names()?;
        let action_of = self.file("actions/choices/values.bin").map(<[u8]>::as_chunks::<4>);
        let rewards = self.rewards(index, choices, edits)?;
        let reward = |column: usize, n: u64| rewards.as_ref()?[column].as_ref().map(|words| words.float(n));
        for state in 0..n_states {
            choices.begin_state();
            let (first, end) = of_states.of(state, n_choices)?;
            for choice in first..end {
                let spot = Spot::Byte(choice.saturating_mul(8));
                let label =
                    match (action_of, labels.is_empty()) {
                        (Some((actions, [])), false) => {
                            let action = usize::try_from(choice).ok().and_then(|choice| actions.get(choice));
                            let label = action.and_then(|action| labels.get(u32::from_le_bytes(*action) as usize));
                            let missing = || format!("choice {choice} has no action, of {}", labels.len());
                            Some(label.ok_or_else(|| {
                                ImportError::at(spot, missing()).in_file("actions/choices/values.bin")
                            })?)
                        }
                        _ => None,
                    };
                let action = choices.action(label.map(String::as_str).filter(|label| !label.is_empty()), spot)?;
                let (first, end) = of_choices.of(choice, n_branches)?;
                meter.spend_or_stop(1 + (end - first))?;
                for branch in first..end {
                    let probability = probabilities.as_ref().map_or(1.0, |words| words.float(branch));
                    let parts = [reward(0, state), reward(1, choice), reward(2, branch)];
                    let reward = rewards.as_ref().map(|_| parts.into_iter().flatten().sum());
                    let way = (targets.whole(branch), probability);
                    let pushed = choices.push_way(action, way, reward, Spot::Byte(branch.saturating_mul(8)));
                    pushed.map_err(|error| error.in_file(&targets.name))?;
                }
                choices.draft.end_pair(state, action, spot).map_err(|error| error.in_file("choice-to-branches.bin"))?;
            }
        }
        Ok(())
    }

    /// The names of actions; none if they have none.
    fn action_names(&self) -> Result<Vec<String>, ImportError> {
        const MAPPING: &str = "actions/choices/string-mapping.bin";
        let Some(mapping) = self.file(MAPPING) else { return Ok(Vec::new()) };
        let strings = self.required("actions/choices/strings.bin")?;
        let (begins, rest) = mapping.as_chunks::<8>();
        if !rest.is_empty() {
            return Err(ImportError::at(Spot::Whole, "expected numbers of 8 bytes").in_file(MAPPING));
        }
        let begins: Vec<usize> =
            begins.iter().map(|begin| usize::try_from(u64::from_le_bytes(*begin)).unwrap_or(usize::MAX)).collect();
        let names = begins.windows(2).zip(0_u64..).map(|(pair, n)| {
            let name = strings.get(pair[0]..pair[1]).and_then(|name| std::str::from_utf8(name).ok());
            let wrong = || ImportError::at(Spot::Byte(8 * n), "there is no such text").in_file(MAPPING);
            name.map(str::to_owned).ok_or_else(wrong)
        });
        names.collect()
    }

    /// The columns of the reward that is the cost: of states, of choices, of branches.
    fn rewards(
        &self,
        index: &Index,
        choices: &mut Choices,
        edits: &Edits,
    ) -> Result<Option<[Option<Words<'_>>; 3]>, ImportError> {
        let rewards: Vec<_> = index.annotations.rewards.iter().collect();
        let names: Vec<&str> = rewards.iter().map(|(id, reward)| reward.alias.as_deref().unwrap_or(id)).collect();
        let Some(chosen) = choices.choose_cost(&names, edits, Spot::Whole)? else { return Ok(None) };
        let (id, reward) = rewards[chosen];
        if reward.r#type.r#type != "double" {
            let detail = format!("rewards of the type {}; double is read here", Quoted(&reward.r#type.r#type));
            return Err(ImportError::at(Spot::Whole, detail).in_file(INDEX));
        }
        let system = &index.transition_system;
        let column = |of: &str, n: u64| {
            if !reward.applies_to.iter().any(|to| to == of) {
                return Ok(None);
            }
            let name = format!("annotations/rewards/{id}/{of}/values.bin");
            self.required(&name)?;
            self.words(name, n)
        };
        Ok(Some([
            column("states", system.n_states)?,
            column("choices", system.n_choices)?,
            column("branches", system.n_branches)?,
        ]))
    }

    fn read_values(&self, valuations: &Valuations, n_states: u64, draft: &mut Draft) -> Result<(), ImportError> {
        const VALUES: &str = "valuations/states/valuations.bin";
        let in_index = |detail: String| ImportError::at(Spot::Whole, detail).in_file(INDEX);
        let [Class { variables }] = valuations.classes.as_slice() else {
            return Err(in_index(format!("{} classes of values; one is read", valuations.classes.len())));
        };
        let mut fields = Vec::new();
        let mut n_bits = 0_u32;
        for field in variables {
            let size = match field {
                Field::Padding { padding } => *padding,
                Field::Variable(variable) => {
                    let size = field_size(variable).map_err(in_index)?;
                    fields.push((variable, n_bits, size));
                    size
                }
            };
            n_bits = n_bits
                .checked_add(size)
                .filter(|n_bits| *n_bits <= 1 << 20)
                .ok_or_else(|| in_index("values of too many bits".to_owned()))?;
        }
        if !n_bits.is_multiple_of(8) || fields.is_empty() {
            return Err(in_index(format!("values of states have {n_bits} bits, which are no whole bytes")));
        }
        let n_bytes = (n_bits / 8) as usize;
        let content = self.required(VALUES)?;
        if content.len() as u64 != n_states.saturating_mul(n_bytes as u64) {
            let detail = format!("expected {n_bytes} bytes for each of {n_states} states, found {}", content.len());
            return Err(ImportError::at(Spot::Whole, detail).in_file(VALUES));
        }
        let names = fields.iter().map(|(variable, _, _)| DraftAttribute::Named(variable.name.clone()));
        draft.set_attributes(names.collect());
        for (state, bytes) in (0_u64..).zip(content.chunks(n_bytes)) {
            let row = fields.iter().map(|(variable, begin, size)| {
                // What is at most 64 bits long, in no more than nine bytes.
                let first = (begin / 8) as usize;
                let window =
                    bytes[first..].iter().take(9).rev().fold(0_u128, |word, byte| word << 8 | u128::from(*byte));
                let mask = (1_u128 << size) - 1;
                let bits = u64::try_from(window >> (begin % 8) & mask).unwrap_or_default();
                value_of(variable, bits, *size)
            });
            let spot = Spot::Byte(state * n_bytes as u64);
            draft.push_row(row, spot).map_err(|error| error.in_file(VALUES))?;
        }
        Ok(())
    }
}
