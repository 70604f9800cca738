//! Storm's explicit format, `.drn` (<https://www.stormchecker.org/documentation/background/languages.html>).
//!
//! ```text
//! @type: MDP
//! @reward_models
//! steps
//! @nr_states
//! 2
//! @model
//! state 0 [0.5] init
//! //[!open    & x=0]
//!     action right [1]
//!         0 : 0.1
//!         1 : 0.9
//! state 1 [0] goal
//! ```
//!
//! The values of states stand in comments, where they were exported; without them, a state's number and labels are its attributes. A `true`
//! is left out of such a comment where Storm writes it, so that its name is that which others have at its place.

use std::io::BufRead;

use super::choices::{Choices, Labels, rational, value};
use super::draft::{Draft, DraftAttribute};
use super::lines::{Lines, number};
use super::{Edits, ImportError, Spot};
use crate::document::Quoted;
use crate::interrupt::Meter;
use crate::model::reading::Raw;
use crate::model::{ActionIdx, Definition, Limits};

/// What Storm calls a choice that has no label.
const NO_LABEL: &str = "__NOLABEL__";

/// Reads a model.
pub(super) fn read(
    reader: impl BufRead,
    edits: &Edits,
    limits: Limits,
    meter: &mut Meter<'_>,
) -> Result<Definition, ImportError> {
    let mut lines = Lines::new(reader);
    let mut choices = Choices::new(Draft::new(limits));
    let Head { n_states, n_choices, cost } = read_head(&mut lines, &mut choices, edits)?;
    let mut body = Body {
        choices,
        n_states,
        n_rewards: cost.1,
        cost: cost.0,
        labels: Labels::default(),
        names: Vec::new(),
        next_state: 0,
        state_cost: None,
        choice: None,
        n_choices: 0,
    };
    while let Some(line) = lines.next()? {
        let (line, spot) = (line.to_owned(), lines.spot());
        body.read_line(&line, spot)?;
    }
    let spot = lines.spot();
    body.end_state(spot)?;
    if body.next_state != n_states {
        return Err(ImportError::at(spot, format!("expected {n_states} states, found {}", body.next_state)));
    }
    if let Some(expected) = n_choices.filter(|expected| *expected != body.n_choices) {
        return Err(ImportError::at(spot, format!("expected {expected} choices, found {}", body.n_choices)));
    }
    if body.names.is_empty() {
        body.choices.label_states(n_states, &body.labels)?;
    } else {
        let name = |(n, name): (usize, Option<String>)| name.unwrap_or_else(|| format!("attribute {n}"));
        let attributes = body.names.into_iter().enumerate().map(name).map(DraftAttribute::Named);
        body.choices.draft.set_attributes(attributes.collect());
    }
    body.choices.draft.finish(edits, meter)
}

struct Head {
    n_states: u64,
    n_choices: Option<u64>,
    /// Which reward is the cost, and how many there are.
    cost: (Option<usize>, usize),
}

fn read_head(lines: &mut Lines<impl BufRead>, choices: &mut Choices, edits: &Edits) -> Result<Head, ImportError> {
    let (mut n_states, mut n_choices, mut cost, mut has_type) = (None, None, (None, 0), false);
    loop {
        let line = lines.required("`@model`")?.trim().to_owned();
        let spot = lines.spot();
        let (keyword, rest) =
            line.split_once(':').map_or((line.as_str(), ""), |(keyword, rest)| (keyword, rest.trim()));
        match keyword {
            "" => {}
            _ if line.starts_with("//") => {}
            "@type" => {
                has_type = true;
                if !["MDP", "DTMC", "POMDP"].contains(&rest) {
                    let detail = format!("a model of the type {}; MDP, DTMC and POMDP are read here", Quoted(rest));
                    return Err(ImportError::at(spot, detail));
                }
            }
            "@value_type" if ["double", "rational"].contains(&rest) => {}
            "@value_type" => return Err(ImportError::at(spot, format!("values of the type {}", Quoted(rest)))),
            "@parameters" => {
                let names = lines.required("a line of parameters")?.trim().to_owned();
                if !names.is_empty() {
                    return Err(lines.wrong(format!("a model with parameters: {}", Quoted(&names))));
                }
            }
            "@reward_models" => {
                let names = reward_names(lines.required("the names of rewards")?);
                cost = (choices.choose_cost(&names, edits, lines.spot())?, names.len());
            }
            "@nr_states" => {
                let spot = lines.next_spot();
                let count = number(lines.required("how many states there are")?, "how many states there are", spot)?;
                choices.draft.expect_states(count, spot)?;
                n_states = Some(count);
            }
            "@nr_choices" => {
                let spot = lines.next_spot();
                let what = "how many choices there are";
                n_choices = Some(number(lines.required(what)?, what, spot)?);
            }
            "@model" => {
                let missing = |what: &str| ImportError::at(spot, format!("there is no `{what}` before this"));
                if !has_type {
                    return Err(missing("@type"));
                }
                let n_states = n_states.ok_or_else(|| missing("@nr_states"))?;
                return Ok(Head { n_states, n_choices, cost });
            }
            _ => return Err(ImportError::at(spot, format!("{} is not known here", Quoted(&line)))),
        }
    }
}

/// The names in a line of them, after each of which Storm writes a space. A reward without a name is called as in UMB.
fn reward_names(line: &str) -> Vec<String> {
    const UNNAMED: &str = "default";
    let name = |name: &str| if name.is_empty() { UNNAMED } else { name }.to_owned();
    let names = |line: &str| line.split(' ').map(name).collect();
    match line.strip_suffix(' ') {
        Some(line) => names(line),
        None if line.is_empty() => Vec::new(),
        None => names(line),
    }
}

/// The states, as they are read.
struct Body {
    choices: Choices,
    n_states: u64,
    n_rewards: usize,
    /// Which reward is the cost.
    cost: Option<usize>,
    labels: Labels,
    /// Names of values of states, by their place; `None` where it is not known yet.
    names: Vec<Option<String>>,
    next_state: u64,
    /// The reward of the state in hand.
    state_cost: Option<f64>,
    /// The choice in hand: its action, its reward, and where it begins.
    choice: Option<(ActionIdx, Option<f64>, Spot)>,
    n_choices: u64,
}

impl Body {
    fn read_line(&mut self, line: &str, spot: Spot) -> Result<(), ImportError> {
        let line = line.trim();
        if let Some(state) = line.strip_prefix("state ") {
            self.end_state(spot)?;
            self.begin_state(state, spot)
        } else if let Some(values) = line.strip_prefix("//") {
            match values.trim().strip_prefix('[').and_then(|values| values.strip_suffix(']')) {
                Some(values) if self.next_state > 0 && self.choice.is_none() => self.read_values(values, spot),
                _ => Ok(()),
            }
        } else if let Some(choice) = line.strip_prefix("action ") {
            if self.next_state == 0 {
                return Err(ImportError::at(spot, "an action before the first state"));
            }
            self.end_choice()?;
            self.begin_choice(choice, spot)
        } else if line.is_empty() {
            Ok(())
        } else {
            self.read_way(line, spot)
        }
    }

    fn begin_state(&mut self, text: &str, spot: Spot) -> Result<(), ImportError> {
        let (state, rest) = text.split_once(' ').unwrap_or((text, ""));
        let state: u64 = number(state, "a state", spot)?;
        if state != self.next_state {
            return Err(ImportError::at(spot, format!("expected state {}, found state {state}", self.next_state)));
        }
        if state >= self.n_states {
            return Err(ImportError::at(spot, format!("expected {} states, found more", self.n_states)));
        }
        self.next_state += 1;
        self.choices.begin_state();
        let mut rest = rest.trim_start();
        if rest.starts_with('!') || rest.starts_with('<') {
            return Err(ImportError::at(spot, "a state with a rate or a player, which are not read"));
        }
        if let Some(observation) = rest.strip_prefix('{') {
            rest = observation.split_once('}').map_or("", |(_, rest)| rest).trim_start();
        }
        self.state_cost = None;
        if let Some(rewards) = rest.strip_prefix('[') {
            let (rewards, labels) = cut(rewards, ']', spot)?;
            self.state_cost = self.reward(rewards, spot)?;
            rest = labels.trim_start();
        }
        while !rest.is_empty() {
            let (label, after) = match rest.strip_prefix('"') {
                Some(quoted) => cut(quoted, '"', spot)?,
                None => rest.split_once(' ').unwrap_or((rest, "")),
            };
            if self.labels.note(label, state) {
                self.choices.draft.start.push(u32::try_from(state).unwrap_or(u32::MAX));
            }
            rest = after.trim_start();
        }
        Ok(())
    }

    /// The reward that is the cost, of those in brackets.
    fn reward(&self, rewards: &str, spot: Spot) -> Result<Option<f64>, ImportError> {
        let all: Vec<&str> = rewards.split(',').map(str::trim).collect();
        if all.len() != self.n_rewards {
            return Err(ImportError::at(spot, format!("expected {} rewards, found {}", self.n_rewards, all.len())));
        }
        let Some(written) = self.cost.map(|cost| all[cost]) else { return Ok(None) };
        let reward = rational(written);
        reward.map(Some).ok_or_else(|| ImportError::at(spot, format!("expected a reward, found {}", Quoted(written))))
    }

    fn read_values(&mut self, text: &str, spot: Spot) -> Result<(), ImportError> {
        let parts: Vec<&str> = text.split('&').map(str::trim).collect();
        let n_rows = self.choices.draft.n_rows();
        if n_rows == 0 {
            self.names = vec![None; parts.len()];
            let unnamed = |_: &&str| DraftAttribute::Named(String::new());
            self.choices.draft.set_attributes(parts.iter().map(unnamed).collect());
        }
        if n_rows + 1 != self.next_state {
            return Err(ImportError::at(spot, "values of a state that has some, or of one after states without"));
        }
        if parts.len() != self.names.len() {
            let detail =
                format!("expected {} values, as of the states before, found {}", self.names.len(), parts.len());
            return Err(ImportError::at(spot, detail));
        }
        let mut row = Vec::with_capacity(parts.len());
        for (part, known) in parts.into_iter().zip(&mut self.names) {
            let (name, value) = match (part.split_once('='), part.strip_prefix('!')) {
                (Some((name, written)), _) => (name.trim(), value(written.trim())),
                (None, Some(name)) => (name.trim(), Raw::Boolean(false)),
                (None, None) => (part, Raw::Boolean(true)),
            };
            match known {
                Some(known) if !name.is_empty() && known != name => {
                    return Err(ImportError::at(
                        spot,
                        format!("expected a value of {}, found {}", Quoted(known), Quoted(part)),
                    ));
                }
                None if !name.is_empty() => *known = Some(name.to_owned()),
                _ => {}
            }
            row.push(value);
        }
        self.choices.draft.push_row(row, spot)
    }

    fn begin_choice(&mut self, text: &str, spot: Spot) -> Result<(), ImportError> {
        let (label, rewards) = match text.strip_suffix(']').and_then(|text| text.rsplit_once('[')) {
            Some((label, rewards)) => (label.trim(), self.reward(rewards, spot)?),
            None => (text.trim(), None),
        };
        self.n_choices += 1;
        let action = self.choices.action(Some(label).filter(|label| *label != NO_LABEL), spot)?;
        let reward = match (self.state_cost, rewards) {
            (None, None) => None,
            (state, choice) => Some(state.unwrap_or_default() + choice.unwrap_or_default()),
        };
        self.choice = Some((action, reward, spot));
        Ok(())
    }

    fn read_way(&mut self, line: &str, spot: Spot) -> Result<(), ImportError> {
        let Some((action, reward, _)) = self.choice else {
            return Err(ImportError::at(spot, format!("expected a state or an action, found {}", Quoted(line))));
        };
        let way = line.split_once(':');
        let way = way.and_then(|(to, probability)| Some((to.trim().parse().ok()?, rational(probability)?)));
        let way = way.ok_or_else(|| {
            ImportError::at(spot, format!("expected a state and a probability, `1 : 0.5`, found {}", Quoted(line)))
        })?;
        self.choices.push_way(action, way, reward, spot)
    }

    fn end_choice(&mut self) -> Result<(), ImportError> {
        match self.choice.take() {
            // Of the state in hand, the last that was begun.
            Some((action, _, spot)) => self.choices.draft.end_pair(self.next_state - 1, action, spot),
            None => Ok(()),
        }
    }

    fn end_state(&mut self, spot: Spot) -> Result<(), ImportError> {
        self.end_choice()?;
        let n_rows = self.choices.draft.n_rows();
        if n_rows > 0 && n_rows != self.next_state {
            return Err(ImportError::at(spot, format!("state {} has no values, but others have", self.next_state - 1)));
        }
        Ok(())
    }
}

/// What stands before and after `end`.
fn cut(text: &str, end: char, spot: Spot) -> Result<(&str, &str), ImportError> {
    text.split_once(end).ok_or_else(|| ImportError::at(spot, format!("expected a `{end}`")))
}
