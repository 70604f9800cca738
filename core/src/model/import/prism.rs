//! PRISM's explicit files (<https://www.prismmodelchecker.org/manual/Appendices/ExplicitModelFiles>).
//!
//! | file | has |
//! |---|---|
//! | `.tra` | `16 39 48`: states, choices, transitions; then `0 1 2 0.9 right`: state, choice, next state, probability, action. Of a Markov chain, no choices |
//! | `.sta` | `(x,door)`: names of variables; then `0:(0,false)` |
//! | `.lab` | `0="init" 1="deadlock"`: numbers of labels; then `0: 0` |
//! | `.srew`, `.trew` | what states and transitions earn, which is the cost; written as `.tra`, without actions |
//!
//! Only the first must be there. Without `.sta`, a state's number and labels are its attributes.

use std::io::BufRead;

use super::choices::{Choices, Labels, rational, value};
use super::draft::{Draft, DraftAttribute, check_state};
use super::lines::{Lines, number};
use super::tar::read_archive;
use super::{Edits, ImportError, Spot, extension};
use crate::document::Quoted;
use crate::interrupt::Meter;
use crate::model::reading::Raw;
use crate::model::{Definition, Limits};

/// What the names of the files end in; the first must be there.
pub(super) const PARTS: [&str; 5] = ["tra", "sta", "lab", "srew", "trew"];

/// Reads the model in these files, or in the files of an archive, if it is one that is called otherwise.
pub(super) fn read_files<R: BufRead>(
    mut files: Vec<(String, R)>,
    edits: &Edits,
    limits: Limits,
    meter: &mut Meter<'_>,
) -> Result<Definition, ImportError> {
    let is_archive = |files: &[(String, R)]| matches!(files, [(name, _)] if !PARTS.contains(&extension(name)));
    if is_archive(&files)
        && let Some((name, archive)) = files.pop()
    {
        let unpacked = read_archive(archive, limits.max_bytes as u64).map_err(|error| error.in_file(&name))?;
        return read(
            unpacked.iter().map(|(name, content)| (name.clone(), content.as_slice())).collect(),
            edits,
            limits,
            meter,
        );
    }
    read(files, edits, limits, meter)
}

fn read<R: BufRead>(
    mut files: Vec<(String, R)>,
    edits: &Edits,
    limits: Limits,
    meter: &mut Meter<'_>,
) -> Result<Definition, ImportError> {
    if let Some((name, _)) = files.iter().find(|(name, _)| !PARTS.contains(&extension(name))) {
        return Err(ImportError::Unfit(format!("{} is none of PRISM's files: {}", Quoted(name), PARTS.join(", "))));
    }
    let mut take = |part: &str| {
        let position = files.iter().position(|(name, _)| extension(name) == part);
        position.map(|position| files.remove(position))
    };
    let [transitions, states, labels, state_rewards, transition_rewards] = PARTS.map(&mut take);
    let Some((name, transitions)) = transitions else {
        return Err(ImportError::Unfit("there is no file of transitions: .tra".to_owned()));
    };
    if let Some((name, _)) = files.first() {
        return Err(ImportError::Unfit(format!("{}: there is another such file", Quoted(name))));
    }
    let mut choices = Choices::new(Draft::new(limits));
    if let Some((name, reader)) = states {
        read_states(Lines::new(reader), &mut choices.draft).map_err(|error| error.in_file(&name))?;
    }
    let mut known = Labels::default();
    let mut last_labelled = None;
    if let Some((name, reader)) = labels {
        let last = read_labels(Lines::new(reader), &mut known, &mut choices.draft);
        last_labelled = last.map_err(|error| error.in_file(&name))?.map(|(state, spot)| (name, state, spot));
    }
    let mut rewards = Rewards::default();
    if let Some((name, reader)) = state_rewards {
        rewards.read_states(&name, Lines::new(reader)).map_err(|error| error.in_file(&name))?;
    }
    if let Some((name, reader)) = transition_rewards {
        rewards.read_transitions(&name, Lines::new(reader)).map_err(|error| error.in_file(&name))?;
    }
    let finish = || {
        let n_states = read_transitions(Lines::new(transitions), &mut choices, &mut rewards)?;
        if choices.draft.n_rows() == 0 {
            choices.label_states(n_states, &known)?;
        }
        Ok(n_states)
    };
    let n_states = finish().map_err(|error: ImportError| error.in_file(&name))?;
    if let Some((name, state, spot)) = last_labelled {
        check_state(state, n_states, spot).map_err(|error| error.in_file(&name))?;
    }
    choices.draft.finish(edits, meter).map_err(|error| error.in_file(&name))
}

/// The next line that is neither empty nor a comment.
fn next_line<R: BufRead>(lines: &mut Lines<R>) -> Result<Option<String>, ImportError> {
    while let Some(line) = lines.next()? {
        let line = line.trim();
        if !line.is_empty() && !line.starts_with('#') {
            return Ok(Some(line.to_owned()));
        }
    }
    Ok(None)
}

fn first_line<R: BufRead>(lines: &mut Lines<R>) -> Result<String, ImportError> {
    next_line(lines)?.ok_or_else(|| ImportError::at(Spot::Whole, "the file is empty"))
}

/// The numbers of the first line: states, choices if there are any, and entries.
fn read_counts<R: BufRead>(lines: &mut Lines<R>) -> Result<Vec<u64>, ImportError> {
    let line = first_line(lines)?;
    let counts: Vec<u64> =
        line.split_ascii_whitespace().map(|part| number(part, "a count", lines.spot())).collect::<Result<_, _>>()?;
    if (2..=3).contains(&counts.len()) {
        return Ok(counts);
    }
    Err(lines.wrong(format!("expected how many states, choices and transitions there are, found {}", Quoted(&line))))
}

fn read_states<R: BufRead>(mut lines: Lines<R>, draft: &mut Draft) -> Result<(), ImportError> {
    let header = first_line(&mut lines)?;
    let names = header.strip_prefix('(').and_then(|names| names.strip_suffix(')'));
    let names = names.ok_or_else(|| lines.wrong(format!("expected names, `(x,y)`, found {}", Quoted(&header))))?;
    let names = names.split(',').map(|name| DraftAttribute::Named(name.trim().to_owned()));
    draft.set_attributes(names.collect());
    while let Some(line) = next_line(&mut lines)? {
        let parts = line.split_once(':').and_then(|(state, values)| {
            let values = values.trim().strip_prefix('(')?.strip_suffix(')')?;
            Some((state.trim().parse::<u64>().ok()?, values))
        });
        let (state, values) =
            parts.ok_or_else(|| lines.wrong(format!("expected a state, `0:(0,1)`, found {}", Quoted(&line))))?;
        if state != draft.n_rows() {
            return Err(lines.wrong(format!("expected state {}, found state {state}", draft.n_rows())));
        }
        let row: Vec<Raw<&str>> = values.split(',').map(|written| value(written.trim())).collect();
        if row.len() != draft.n_attributes() {
            let detail = format!("expected {} values, found {}", draft.n_attributes(), row.len());
            return Err(lines.wrong(detail));
        }
        draft.push_row(row, lines.spot())?;
    }
    Ok(())
}

/// Reads the labels of states, and where it starts. Gives the last state that is named, and where.
fn read_labels<R: BufRead>(
    mut lines: Lines<R>,
    labels: &mut Labels,
    draft: &mut Draft,
) -> Result<Option<(u64, Spot)>, ImportError> {
    let header = first_line(&mut lines)?;
    let mut names: Vec<(u64, String)> = Vec::new();
    let mut rest = header.as_str();
    while !rest.is_empty() {
        let part = rest.split_once("=\"").and_then(|(number, rest)| {
            let (name, rest) = rest.split_once('"')?;
            Some((number.trim().parse().ok()?, name, rest))
        });
        let (number, name, after) =
            part.ok_or_else(|| lines.wrong(format!("expected labels, `0=\"init\"`, found {}", Quoted(rest))))?;
        names.push((number, name.to_owned()));
        rest = after.trim_start();
    }
    let mut last = None;
    while let Some(line) = next_line(&mut lines)? {
        let parts =
            line.split_once(':').and_then(|(state, numbers)| Some((state.trim().parse::<u64>().ok()?, numbers)));
        let (state, numbers) =
            parts.ok_or_else(|| lines.wrong(format!("expected a state's labels, `0: 1`, found {}", Quoted(&line))))?;
        if last.replace((state, lines.spot())).is_some_and(|(last, _)| last >= state) {
            return Err(lines.wrong("states are not in their order"));
        }
        for written in numbers.split_ascii_whitespace() {
            let label: u64 = number(written, "the number of a label", lines.spot())?;
            let known = names.iter().find(|(known, _)| *known == label);
            let (_, name) = known.ok_or_else(|| lines.wrong(format!("there is no label {label}")))?;
            if labels.note(name, state) {
                let start = u32::try_from(state).map_err(|_| lines.wrong(format!("there is no state {state}")))?;
                draft.start.push(start);
            }
        }
    }
    Ok(last)
}

/// What states and transitions earn, ascending.
#[derive(Default)]
struct Rewards {
    is_there: bool,
    of_states: Vec<(u64, f64)>,
    /// Each with where it stands, until a transition has it.
    of_transitions: Vec<([u64; 3], f64, Spot)>,
    /// Of each file: its name, how many states and choices it says that there are, and where.
    heads: Vec<(String, Vec<u64>, Spot)>,
}

impl Rewards {
    fn read_states<R: BufRead>(&mut self, file: &str, mut lines: Lines<R>) -> Result<(), ImportError> {
        let counts = self.read_head(file, &mut lines)?;
        while let Some(line) = next_line(&mut lines)? {
            let ([state], reward, _) = entry::<1>(&line, lines.spot())?;
            check_state(state, counts[0], lines.spot())?;
            self.of_states.push((state, reward));
        }
        check_count(&lines, "rewards", counts.last().copied(), self.of_states.len() as u64)?;
        self.of_states.sort_by_key(|(state, _)| *state);
        Ok(())
    }

    fn read_transitions<R: BufRead>(&mut self, file: &str, mut lines: Lines<R>) -> Result<(), ImportError> {
        let counts = self.read_head(file, &mut lines)?;
        while let Some(line) = next_line(&mut lines)? {
            let (key, reward) = if counts.len() == 3 {
                let (key, reward, _) = entry::<3>(&line, lines.spot())?;
                (key, reward)
            } else {
                let ([from, to], reward, _) = entry::<2>(&line, lines.spot())?;
                ([from, 0, to], reward)
            };
            self.of_transitions.push((key, reward, lines.spot()));
        }
        check_count(&lines, "rewards", counts.last().copied(), self.of_transitions.len() as u64)?;
        self.of_transitions.sort_by_key(|(key, ..)| *key);
        Ok(())
    }

    fn read_head<R: BufRead>(&mut self, file: &str, lines: &mut Lines<R>) -> Result<Vec<u64>, ImportError> {
        self.is_there = true;
        let counts = read_counts(lines)?;
        self.heads.push((file.to_owned(), counts[..counts.len() - 1].to_vec(), lines.spot()));
        Ok(counts)
    }

    /// Checks that they are of a model of so many states and choices.
    fn check_heads(&self, counts: &[u64]) -> Result<(), ImportError> {
        for (file, found, spot) in &self.heads {
            let mut pairs = ["states", "choices"].into_iter().zip(found.iter().zip(counts));
            if let Some((what, (found, expected))) = pairs.find(|(_, (found, expected))| found != expected) {
                let detail = format!("{found} {what}, but the transitions have {expected}");
                return Err(ImportError::at(*spot, detail).in_file(file));
            }
        }
        Ok(())
    }

    /// Checks that every transition that earns something is there.
    fn check_all_used(&self) -> Result<(), ImportError> {
        let unused = self.of_transitions.iter().find(|(.., spot)| *spot != Spot::Whole);
        let Some(([from, choice, to], _, spot)) = unused else { return Ok(()) };
        let file = self.heads.last().map_or("", |(file, ..)| file);
        let detail =
            format!("there is no transition from {from} to {to} by choice {choice}, or it has a reward already");
        Err(ImportError::at(*spot, detail).in_file(file))
    }

    /// What a transition earns, with the state that it leaves.
    fn of(&mut self, key: [u64; 3]) -> Option<f64> {
        let of_state = self.of_states.binary_search_by_key(&key[0], |(state, _)| *state);
        let of_transition = self.of_transitions.binary_search_by_key(&key, |(key, ..)| *key);
        if let Ok(at) = of_transition {
            self.of_transitions[at].2 = Spot::Whole;
        }
        let [state, transition] = [
            of_state.map_or(0.0, |at| self.of_states[at].1),
            of_transition.map_or(0.0, |at| self.of_transitions[at].1),
        ];
        self.is_there.then_some(state + transition)
    }
}

fn check_count<R: BufRead>(lines: &Lines<R>, what: &str, expected: Option<u64>, found: u64) -> Result<(), ImportError> {
    match expected.filter(|expected| *expected != found) {
        Some(expected) => Err(lines.wrong(format!("expected {expected} {what}, found {found}"))),
        None => Ok(()),
    }
}

/// `N` indices, a number, and what stands after it.
fn entry<const N: usize>(line: &str, spot: Spot) -> Result<([u64; N], f64, Option<&str>), ImportError> {
    let mut parts = line.splitn(N + 2, ' ').map(str::trim);
    let mut indices = [0; N];
    for index in &mut indices {
        *index = number(parts.next().unwrap_or_default(), "an index", spot)?;
    }
    let written = parts.next().unwrap_or_default();
    let number = rational(written)
        .ok_or_else(|| ImportError::at(spot, format!("expected a number, found {}", Quoted(written))))?;
    Ok((indices, number, parts.next().filter(|rest| !rest.is_empty())))
}

/// How many states there are.
fn read_transitions<R: BufRead>(
    mut lines: Lines<R>,
    choices: &mut Choices,
    rewards: &mut Rewards,
) -> Result<u64, ImportError> {
    let counts = read_counts(&mut lines)?;
    let (n_states, has_choices) = (counts[0], counts.len() == 3);
    choices.draft.expect_states(n_states, lines.spot())?;
    let n_rows = choices.draft.n_rows();
    if n_rows != n_states && n_rows != 0 {
        return Err(lines.wrong(format!("{n_states} states, but {n_rows} have values")));
    }
    let (mut n_choices, mut n_transitions) = (0_u64, 0_u64);
    // The state, the number of the choice, the action, and where they begin.
    let mut pair = None;
    while let Some(line) = next_line(&mut lines)? {
        let spot = lines.spot();
        let ([from, choice, to], probability, label) = if has_choices {
            entry::<3>(&line, spot)?
        } else {
            let ([from, to], probability, label) = entry::<2>(&line, spot)?;
            ([from, 0, to], probability, label)
        };
        check_state(from, n_states, spot)?;
        let action = match pair {
            Some((state, number, action, _)) if (state, number) == (from, choice) => action,
            before => {
                let follows = before.is_none_or(|(state, number, ..)| (state, number) < (from, choice));
                if !follows {
                    return Err(ImportError::at(spot, "states and their choices are not in their order"));
                }
                if let Some((state, _, action, spot)) = before {
                    choices.draft.end_pair(state, action, spot)?;
                }
                if before.is_none_or(|(state, ..)| state != from) {
                    choices.begin_state();
                }
                n_choices += 1;
                let action = choices.action(label, spot)?;
                pair = Some((from, choice, action, spot));
                action
            }
        };
        n_transitions += 1;
        choices.push_way(action, (to, probability), rewards.of([from, choice, to]), spot)?;
    }
    if let Some((state, _, action, spot)) = pair {
        choices.draft.end_pair(state, action, spot)?;
    }
    check_count(&lines, "choices", Some(counts[1]).filter(|_| has_choices), n_choices)?;
    check_count(&lines, "transitions", counts.last().copied(), n_transitions)?;
    rewards.check_heads(&counts[..counts.len() - 1])?;
    rewards.check_all_used()?;
    Ok(n_states)
}
