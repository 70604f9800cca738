//! The flags that `map` and `stream` share, and how faults of a request are reported at the flag or file that they come from.

use std::num::NonZeroU32;
use std::str::FromStr;

use clap::Args;
use serde_json::{Map as Members, Value, json};

use super::CliError;
use super::input::{Cells, Column, Source, Spot, parse_json};
use etude_core::document::{Fault, Faults};
use etude_core::mapping::Demonstration;

/// Flags that are options of a request.
#[derive(Args, Debug)]
pub(super) struct OptionFlags {
    /// Weight of an attribute; may be given for several.
    #[arg(long = "weight", value_name = "ATTRIBUTE=WEIGHT", value_parser = parse_weight)]
    weights: Vec<(String, f64)>,
    /// Where the imitator may start: a state's index, a JSON object of attribute values, or a JSON array of these.
    #[arg(long, value_name = "STATE", value_parser = parse_start)]
    start: Option<Value>,
    /// The weight of each observation, in order: a JSON array of numbers; 1 where it is null.
    #[arg(long, value_name = "WEIGHTS", value_parser = parse_json)]
    observation_weights: Option<Value>,
    /// The part of the distance, 0 to 1, that an action pays that does not meet the next observation; 1 unless said.
    #[arg(long, value_name = "PART")]
    extra_weight: Option<f64>,
    /// The weight of the end: the distance between the last state and the last observation is paid once more, multiplied by it; 0
    /// unless said.
    #[arg(long, value_name = "WEIGHT")]
    end_weight: Option<f64>,
    /// An action that the body lacks; may be given for several.
    #[arg(long, value_name = "ACTION")]
    without: Vec<String>,
    /// What an action costs instead of what the model says; may be given for several.
    #[arg(long = "action-cost", value_name = "ACTION=COST", value_parser = parse_action_cost)]
    action_costs: Vec<(String, f64)>,
    /// What is observed as an attribute, of a demonstrator with attributes of its own: an expression of CEL over these, such as `x=east_m/0.25`; may
    /// be given for several.
    #[arg(long, value_name = "ATTRIBUTE=EXPRESSION", value_parser = parse_observed)]
    observe: Vec<(String, String)>,
}

impl OptionFlags {
    /// Adds what they say to `request`, over what it says itself.
    pub(super) fn add_to(&self, request: &mut FlaggedRequest) -> Result<(), CliError> {
        for (attribute, weight) in &self.weights {
            request.set(&format!("--weight {attribute}={weight}"), &["weights", attribute], json!(weight))?;
        }
        request.set_some("--start", "start", self.start.clone())?;
        request.set_some("--observation-weights", "observation_weights", self.observation_weights.clone())?;
        request.set_some("--extra-weight", "extra_weight", self.extra_weight.map(|weight| json!(weight)))?;
        request.set_some("--end-weight", "end_weight", self.end_weight.map(|weight| json!(weight)))?;
        request.set_each("--without", "without", &self.without);
        for (action, cost) in &self.action_costs {
            request.set(&format!("--action-cost {action}={cost}"), &["action_costs", action], json!(cost))?;
        }
        for (attribute, expression) in &self.observe {
            request.set(&format!("--observe {attribute}={expression}"), &["observe", attribute], json!(expression))?;
        }
        Ok(())
    }

    /// How cells of a table become values: those `of_model`, unless they are a demonstrator's own.
    pub(super) fn cells(&self, of_model: impl FnOnce() -> Cells) -> Cells {
        if self.observe.is_empty() { of_model() } else { Cells::any() }
    }
}

/// Flags that say how observations are read.
#[derive(Args, Debug)]
pub(super) struct ReadingFlags {
    /// An attribute's column (in CSV) or member (in JSON) that is called otherwise, in other units if need be, such as x=lon or
    /// x=lon*1000-5; may be given for several.
    #[arg(long = "column", value_name = "ATTRIBUTE=COLUMN[*FACTOR][+OFFSET]")]
    pub(super) columns: Vec<Column>,
}

/// A request that was read from a file, with what flags say over it.
pub(super) struct FlaggedRequest {
    members: Members<String, Value>,
    /// Which flag set which value: a JSON pointer and the flag as it was typed.
    flags: Vec<(String, String)>,
}

impl FlaggedRequest {
    /// What was read from a file.
    pub(super) fn new(members: Members<String, Value>) -> Self {
        Self { members, flags: Vec::new() }
    }

    pub(super) fn members(&self) -> &Members<String, Value> {
        &self.members
    }

    /// Adds a member that no flag stands for.
    pub(super) fn insert(&mut self, name: &str, value: Value) {
        self.members.insert(name.to_owned(), value);
    }

    /// Sets the option at `path`, members within members, to what `flag` says.
    pub(super) fn set(&mut self, flag: &str, path: &[&str], value: Value) -> Result<(), CliError> {
        let Some((last, parents)) = path.split_last() else { return Ok(()) };
        let mut members = &mut self.members;
        for name in parents {
            let parent = members.entry(*name).or_insert(Value::Null);
            if parent.is_null() {
                *parent = json!({});
            }
            let Value::Object(object) = parent else {
                return Err(CliError::Faulty(format!("{flag}: the request has {name:?} already, and it is no object")));
            };
            members = object;
        }
        members.insert((*last).to_owned(), value);
        let escaped = path.iter().map(|name| name.replace('~', "~0").replace('/', "~1"));
        let pointer = escaped.fold(String::new(), |pointer, name| pointer + "/" + &name);
        self.flags.push((pointer, flag.to_owned()));
        Ok(())
    }

    /// Sets the option `name` to what `flag` says, if it says anything.
    pub(super) fn set_some(&mut self, flag: &str, name: &str, value: Option<Value>) -> Result<(), CliError> {
        match value {
            Some(value) => self.set(&format!("{flag} {value}"), &[name], value.clone()),
            None => Ok(()),
        }
    }

    /// Sets the option `name` to the list of what `flag` says each time that it is given, if it is.
    pub(super) fn set_each(&mut self, flag: &str, name: &str, values: &[String]) {
        if values.is_empty() {
            return;
        }
        self.members.insert(name.to_owned(), json!(values));
        let told = values.iter().enumerate().map(|(n, value)| (format!("/{name}/{n}"), format!("{flag} {value}")));
        self.flags.extend(told);
    }

    /// The request as one document.
    pub(super) fn document(&self) -> Value {
        self.members.clone().into()
    }

    /// All that is wrong with the request, each fault with the flag, or the place in `source`, that it is about. Of its demonstration, the
    /// observations stood at `spots`.
    pub(super) fn told(&self, faults: &[Fault], n_more: usize, source: &Source, spots: &[Spot]) -> CliError {
        let tell = |Fault { pointer, detail, .. }: &Fault| self.tell(pointer, detail, source, spots);
        faulty(faults.iter().map(tell).collect(), n_more)
    }

    /// What is to be said of what `pointer` leads to, with the flag, or the place in `source`, that it is about; likewise.
    pub(super) fn tell(&self, pointer: &str, detail: &str, source: &Source, spots: &[Spot]) -> String {
        if let Some((index, rest)) = pointer.strip_prefix("/demonstration/").map(split_pointer)
            && let Some(spot) = index.parse().ok().and_then(|index: usize| spots.get(index))
        {
            return spot.tell(rest, detail);
        }
        let within = |(place, flag): &(String, String)| {
            let rest = pointer.strip_prefix(place.as_str())?;
            (rest.is_empty() || rest.starts_with('/')).then(|| (flag.clone(), rest))
        };
        match self.flags.iter().find_map(within) {
            Some((flag, "")) => format!("{flag}: {detail}"),
            Some((flag, rest)) => format!("{flag}: {rest}: {detail}"),
            None => source
                .tell(pointer.strip_prefix("/demonstration").filter(|rest| rest.is_empty()).unwrap_or(pointer), detail),
        }
    }

    /// The same, of faults that were found here.
    pub(super) fn told_of(&self, faults: &Faults, source: &Source, spots: &[Spot]) -> CliError {
        self.told(faults.listed(), faults.count() - faults.listed().len(), source, spots)
    }
}

/// The error that tells of these faults, and of how many more there are.
pub(super) fn faulty(mut faults: Vec<String>, n_more: usize) -> CliError {
    if let ([fault], 0) = (&*faults, n_more) {
        return CliError::Faulty(fault.clone());
    }
    let count = faults.len() + n_more;
    if n_more > 0 {
        faults.push(format!("and {n_more} more"));
    }
    CliError::Faulty(format!("{count} faults:\n{}", faults.join("\n")))
}

/// The first part of a pointer, and the rest, with the slash that it begins with.
fn split_pointer(pointer: &str) -> (&str, &str) {
    pointer.split_at(pointer.find('/').unwrap_or(pointer.len()))
}

/// How many observations past the current one a step may wait for; `none`: all.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lookahead(pub(super) Option<NonZeroU32>);

impl Lookahead {
    /// As in a request.
    pub(super) fn document(self) -> Value {
        json!(self.0)
    }
}

impl FromStr for Lookahead {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        /// As long as the longest demonstration.
        const LONGEST: usize = Demonstration::MAX_OBSERVATIONS;
        if text == "none" {
            return Ok(Self(None));
        }
        let lookahead = text.parse().ok().filter(|lookahead: &NonZeroU32| lookahead.get() as usize <= LONGEST);
        let lookahead = lookahead.ok_or_else(|| format!("expected a number from 1 to {LONGEST}, or none"))?;
        Ok(Self(Some(lookahead)))
    }
}

pub(super) fn parse_start(text: &str) -> Result<Value, String> {
    parse_json(text).map_err(|_| {
        r#"expected a state's index, or attribute values such as '{"x": 0, "heading": "east"}'"#.to_owned()
    })
}

pub(super) fn parse_weight(text: &str) -> Result<(String, f64), String> {
    parse_named_number(text, "expected ATTRIBUTE=WEIGHT, such as x=2")
}

pub(super) fn parse_within(text: &str) -> Result<(String, f64), String> {
    parse_named_number(text, "expected ATTRIBUTE=WITHIN, such as x=0.5")
}

pub(super) fn parse_observed(text: &str) -> Result<(String, String), String> {
    let (name, expression) = text.split_once('=').ok_or("expected ATTRIBUTE=EXPRESSION, such as x=east_m/0.25")?;
    Ok((name.trim().to_owned(), expression.trim().to_owned()))
}

fn parse_action_cost(text: &str) -> Result<(String, f64), String> {
    parse_named_number(text, "expected ACTION=COST, such as forward=2")
}

fn parse_named_number(text: &str, expected: &str) -> Result<(String, f64), String> {
    let (name, number) = text.rsplit_once('=').ok_or(expected)?;
    let number: f64 = number.parse().map_err(|_| format!("expected a number, found {number:?}"))?;
    if number.is_finite() { Ok((name.to_owned(), number)) } else { Err("expected a finite number".to_owned()) }
}
