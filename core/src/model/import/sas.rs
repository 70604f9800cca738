//! SAS+ tasks, as the translator of Fast Downward writes them: `output.sas`, version 3 of its format (<https://www.fast-downward.org/TranslatorOutputFormat>).
//!
//! A variable becomes an attribute, whose values are atoms; it is called after the one thing that all its atoms are about, if it is the only such
//! variable, and after its atom if it has but one. An operator becomes an action. What the body reaches from the state in the file becomes a table
//! if that is little; else it is a `planning` task, searched lazily if that is much. The goal is not used: what is followed is a demonstration.

use std::collections::{BTreeSet, HashMap};
use std::io::BufRead;
use std::sync::Arc;

use super::deadly::{unsafe_states, wrong};
use super::lines::{Lines, number};
use super::words::check_names;
use super::{Edits, ImportError};
use crate::attribute::{Attribute, Schema, Value};
use crate::document::{Quoted, normal};
use crate::interrupt::{Interrupt, Meter};
use crate::model::planning::{Planning, Rule, Values};
use crate::model::table::{Edges, Table};
use crate::model::{Action, ActionIdx, Definition, Limits, Model, Outcome};

/// The version of the format that is read here.
const VERSION: u32 = 3;

/// How many values are looked at between two looks at the interrupt: less than a millisecond.
const POLL_EVERY: u64 = 1 << 12;

/// Most states of a table that is made of a task.
const MAX_TABLE_STATES: usize = 10_000;

struct Variable {
    name: String,
    values: Vec<String>,
}

struct SasOperator {
    name: String,
    cost: u32,
    rule: Rule,
}

/// Reads a task.
pub(super) fn read(
    reader: impl BufRead,
    edits: &Edits,
    interrupt: &mut dyn Interrupt,
) -> Result<Definition, ImportError> {
    let mut file = Sas { lines: Lines::new(reader), variables: Vec::new() };
    let has_costs = file.read_head()?;
    file.read_variables()?;
    file.read_mutex_groups()?;
    let start = file.read_start()?;
    file.read_goal()?;
    let operators = file.read_operators(has_costs)?;
    file.read_axioms()?;
    let task = task(file.variables, start, operators, edits)?;
    as_table_if_small(task, edits, interrupt)
}

/// A file as it is read.
struct Sas<R> {
    lines: Lines<R>,
    variables: Vec<Variable>,
}

impl<R: BufRead> Sas<R> {
    fn expect(&mut self, keyword: &str) -> Result<(), ImportError> {
        let found = self.lines.required(&format!("`{keyword}`"))?.trim();
        if found == keyword {
            return Ok(());
        }
        let detail = format!("expected `{keyword}`, found {}", Quoted(found));
        Err(self.lines.wrong(detail))
    }

    fn number(&mut self, what: &str) -> Result<usize, ImportError> {
        let spot = self.lines.next_spot();
        number(self.lines.required(what)?, what, spot)
    }

    /// The numbers of the next line, at least `least`.
    fn numbers(&mut self, what: &str, least: usize) -> Result<Vec<i64>, ImportError> {
        let spot = self.lines.next_spot();
        let line = self.lines.required(what)?;
        let numbers = line.split_ascii_whitespace().map(|part| number(part, what, spot));
        let numbers: Vec<i64> = numbers.collect::<Result<_, _>>()?;
        if numbers.len() >= least {
            return Ok(numbers);
        }
        Err(self.lines.wrong(format!("expected {what}: {least} numbers, found {}", numbers.len())))
    }

    /// A variable and one of its values.
    fn fact(&self, variable: i64, value: i64) -> Result<(usize, u32), ImportError> {
        let variable = self.variable(variable)?;
        Ok((variable, self.value(variable, value)?))
    }

    fn variable(&self, variable: i64) -> Result<usize, ImportError> {
        let n_variables = self.variables.len();
        let index = usize::try_from(variable).ok().filter(|variable| *variable < n_variables);
        index.ok_or_else(|| self.lines.wrong(format!("there is no variable {variable}: there are {n_variables}")))
    }

    fn value(&self, variable: usize, value: i64) -> Result<u32, ImportError> {
        let n_values = self.variables[variable].values.len();
        let index = u32::try_from(value).ok().filter(|value| (*value as usize) < n_values);
        index.ok_or_else(|| {
            self.lines.wrong(format!("variable {variable} has no value {value}: it has {n_values}, counted from 0"))
        })
    }

    /// Whether operators have costs of their own.
    fn read_head(&mut self) -> Result<bool, ImportError> {
        self.expect("begin_version")?;
        let version = self.number("a version")?;
        if version != VERSION as usize {
            return Err(self.lines.wrong(format!("version {version}; version {VERSION} is read here")));
        }
        self.expect("end_version")?;
        self.expect("begin_metric")?;
        let metric = self.number("0 or 1")?;
        if metric > 1 {
            return Err(self.lines.wrong(format!("expected 0 or 1, found {metric}")));
        }
        self.expect("end_metric")?;
        Ok(metric == 1)
    }

    fn read_variables(&mut self) -> Result<(), ImportError> {
        let n_variables = self.number("how many variables there are")?;
        if !(1..=Schema::MAX_ATTRIBUTES).contains(&n_variables) {
            let most = Schema::MAX_ATTRIBUTES;
            return Err(self.lines.wrong(format!("{n_variables} variables: a model has 1 to {most} attributes")));
        }
        for _ in 0..n_variables {
            self.expect("begin_variable")?;
            let name = self.lines.required("a variable's name")?.to_owned();
            let layer = self.numbers("an axiom layer", 1)?[0];
            if layer != -1 {
                let detail = format!("{} is derived by axioms, which are not read", Quoted(&name));
                return Err(self.lines.wrong(detail));
            }
            let n_values = self.number("how many values there are")?;
            if n_values == 0 {
                return Err(self.lines.wrong("a variable has at least one value"));
            }
            let mut values = Vec::new();
            for _ in 0..n_values {
                let value = value_of(self.lines.required("a variable's value")?);
                if value.len() > Attribute::MAX_TEXT_BYTES {
                    return Err(self.lines.wrong(format!("a value of over {} bytes", Attribute::MAX_TEXT_BYTES)));
                }
                values.push(value);
            }
            if values.iter().collect::<BTreeSet<_>>().len() < values.len() {
                return Err(self.lines.wrong(format!("{} has a value twice", Quoted(&name))));
            }
            self.expect("end_variable")?;
            self.variables.push(Variable { name, values });
        }
        Ok(())
    }

    fn read_mutex_groups(&mut self) -> Result<(), ImportError> {
        for _ in 0..self.number("how many mutex groups there are")? {
            self.expect("begin_mutex_group")?;
            self.read_facts("a fact of a mutex group")?;
            self.expect("end_mutex_group")?;
        }
        Ok(())
    }

    /// A number, and so many lines with a variable and its value.
    fn read_facts(&mut self, what: &str) -> Result<Values, ImportError> {
        let mut facts = Values::new();
        for _ in 0..self.number("how many lines follow")? {
            let numbers = self.numbers(what, 2)?;
            facts.push(self.fact(numbers[0], numbers[1])?);
        }
        Ok(facts)
    }

    fn read_start(&mut self) -> Result<Vec<u32>, ImportError> {
        self.expect("begin_state")?;
        let mut start = Vec::with_capacity(self.variables.len());
        for variable in 0..self.variables.len() {
            let value = self.numbers("a value of the first state", 1)?[0];
            start.push(self.value(variable, value)?);
        }
        self.expect("end_state")?;
        Ok(start)
    }

    fn read_goal(&mut self) -> Result<(), ImportError> {
        self.expect("begin_goal")?;
        self.read_facts("a fact of the goal")?;
        self.expect("end_goal")
    }

    fn read_operators(&mut self, has_costs: bool) -> Result<Vec<SasOperator>, ImportError> {
        let n_operators = self.number("how many operators there are")?;
        let mut operators = Vec::new();
        for _ in 0..n_operators {
            self.expect("begin_operator")?;
            let name = self.lines.required("an operator's name")?.trim().to_owned();
            let mut rule = Rule { when: self.read_facts("a prevail condition")?, ..Rule::default() };
            for _ in 0..self.number("how many effects there are")? {
                self.read_effect(&mut rule)?;
            }
            let cost = self.number("a cost")?;
            let cost = u32::try_from(cost).map_err(|_| self.lines.wrong("the cost is too large"))?;
            self.expect("end_operator")?;
            operators.push(SasOperator { name, cost: if has_costs { cost } else { 1 }, rule });
        }
        Ok(operators)
    }

    fn read_effect(&mut self, rule: &mut Rule) -> Result<(), ImportError> {
        let numbers = self.numbers("an effect: conditions, variable, value before and after", 4)?;
        let n_conditions = usize::try_from(numbers[0]).unwrap_or(usize::MAX);
        let Some((conditions, [variable, before, after])) = n_conditions
            .checked_mul(2)
            .and_then(|n| numbers[1..].split_at_checked(n))
            .and_then(|(conditions, rest)| Some((conditions, <[i64; 3]>::try_from(rest).ok()?)))
        else {
            return Err(self
                .lines
                .wrong(format!("an effect with {} conditions does not have so many numbers", numbers[0])));
        };
        let conditions = conditions.chunks(2).map(|fact| self.fact(fact[0], fact[1])).collect::<Result<Values, _>>()?;
        let change = self.fact(variable, after)?;
        if before != -1 {
            let needed = self.fact(variable, before)?;
            match rule.when.iter().find(|(variable, _)| *variable == needed.0) {
                Some(known) if *known != needed => {
                    return Err(self.lines.wrong(format!("the operator needs two values of variable {variable}")));
                }
                Some(_) => {}
                None => rule.when.push(needed),
            }
        }
        // Effects happen in their order, the later in place of the earlier.
        if conditions.is_empty() && rule.conditional.is_empty() {
            rule.then.retain(|(variable, _)| *variable != change.0);
            rule.then.push(change);
        } else {
            rule.conditional.push((conditions, vec![change]));
        }
        Ok(())
    }

    fn read_axioms(&mut self) -> Result<(), ImportError> {
        let n_axioms = self.number("how many axioms there are")?;
        if n_axioms > 0 {
            return Err(self.lines.wrong(format!("{n_axioms} axioms, which are not read")));
        }
        while let Some(line) = self.lines.next()? {
            if !line.trim().is_empty() {
                return Err(self.lines.wrong("the file goes on after its end"));
            }
        }
        Ok(())
    }
}

/// A value as it is read by people: an atom, or that it does not hold.
fn value_of(line: &str) -> String {
    let line = line.trim();
    let value = match (line.strip_prefix("Atom "), line.strip_prefix("NegatedAtom ")) {
        (Some(atom), _) => atom.to_owned(),
        (_, Some(atom)) => format!("not {atom}"),
        _ => line.trim_start_matches('<').trim_end_matches('>').to_owned(),
    };
    normal(&value).into_owned()
}

/// What an atom is about: `a` and `b` of `on(a, b)`.
fn things(atom: &str) -> Vec<&str> {
    let inside = atom.split_once('(').map_or("", |(_, inside)| inside.trim_end_matches(')'));
    inside.split(',').map(str::trim).filter(|thing| !thing.is_empty()).collect()
}

/// Names of variables that say what they are about, as far as these differ; else those of the file.
fn names(variables: &[Variable]) -> Vec<String> {
    let telling = |variable: &Variable| {
        let is_atom = |value: &&String| value.contains('(') && !value.starts_with("not ");
        let atoms: Vec<&String> = variable.values.iter().filter(is_atom).collect();
        if let [atom] = atoms.as_slice() {
            return Some((*atom).clone());
        }
        let mut common = things(atoms.first()?);
        for atom in &atoms {
            let others = things(atom);
            common.retain(|thing| others.contains(thing));
        }
        if let [thing] = common.as_slice() { Some((*thing).to_owned()) } else { None }
    };
    let telling: Vec<Option<String>> = variables.iter().map(telling).collect();
    let mut n_times: HashMap<&str, usize> = HashMap::new();
    let plain = variables.iter().map(|variable| variable.name.as_str());
    for name in telling.iter().flatten().map(String::as_str).chain(plain) {
        *n_times.entry(name).or_default() += 1;
    }
    let fits =
        |name: &&String| n_times.get(name.as_str()) == Some(&1) && name.chars().count() <= Attribute::MAX_NAME_CHARS;
    let named = telling.iter().zip(variables);
    named.map(|(telling, variable)| telling.as_ref().filter(fits).unwrap_or(&variable.name).clone()).collect()
}

fn task(
    variables: Vec<Variable>,
    start: Vec<u32>,
    operators: Vec<SasOperator>,
    edits: &Edits,
) -> Result<Planning, ImportError> {
    let attribute_names = names(&variables);
    let old_names: Vec<&str> = attribute_names.iter().map(String::as_str).collect();
    let operator_names = numbered(&operators);
    edits.check(&operator_names.iter().map(String::as_str).collect::<Vec<_>>(), &old_names)?;
    let new_names = || old_names.iter().map(|name| edits.renamed(name));
    check_names("attribute", new_names(), Attribute::MAX_NAME_CHARS)?;
    let schema = Schema::of(new_names().map(|name| Attribute::category(normal(name))).collect());

    let kept = operator_names.iter().zip(operators).filter(|(name, _)| !edits.lacks(name));
    let (mut actions, mut rules) = (Vec::new(), Vec::new());
    for (name, SasOperator { cost, rule, .. }) in kept {
        let Some(index) = ActionIdx::try_from(actions.len()).ok().filter(|_| actions.len() < Action::MAX_ACTIONS)
        else {
            let most = Action::MAX_ACTIONS;
            return Err(ImportError::Unfit(format!(
                "over {most} operators, which is the most actions that a model has"
            )));
        };
        let cost = edits.cost(name).unwrap_or(cost.into());
        actions.push(Action { name: normal(edits.renamed(name)).into(), cost });
        rules.push((index, rule));
    }
    check_names("action", actions.iter().map(|action| &*action.name), Action::MAX_NAME_CHARS)?;
    let text = |value: String| Value::Text(value.into());
    let domains = variables.into_iter().map(|variable| variable.values.into_iter().map(text).collect());
    Ok(Planning::new(schema, actions, domains.collect(), start, rules))
}

/// The names of operators, numbered where several have the same.
fn numbered(operators: &[SasOperator]) -> Vec<String> {
    let mut n_times: HashMap<&str, usize> = HashMap::new();
    let mut names = Vec::with_capacity(operators.len());
    for operator in operators {
        let n = n_times.entry(&operator.name).or_default();
        *n += 1;
        names.push(if *n == 1 { operator.name.clone() } else { format!("{} ({n})", operator.name) });
    }
    names
}

/// A table of what the body reaches, if that is little.
fn as_table_if_small(task: Planning, edits: &Edits, interrupt: &mut dyn Interrupt) -> Result<Definition, ImportError> {
    let listed = Arc::new(task.clone());
    let (schema, actions) = (task.schema().clone(), task.actions().to_vec());
    let limits = Limits { max_states: MAX_TABLE_STATES, ..Limits::DEFAULT };
    let model = Model::explore(schema, actions, listed, limits, interrupt)?;
    if model.is_lazy() {
        // Of several expressions, one holds.
        let task = match edits.unsafe_if.as_slice() {
            [] => task,
            [text] => task.avoiding(text).map_err(|detail| wrong(text, &detail))?,
            texts => {
                let text = texts.iter().map(|text| format!("({text})")).collect::<Vec<_>>().join(" || ");
                task.avoiding(&text).map_err(|detail| wrong(&text, &detail))?
            }
        };
        return Ok(Definition::of(task));
    }
    let mut edges = Edges::default();
    for (from, way) in model.graph().iter() {
        edges.push(from, way.action, Outcome::certain(way.to));
    }
    let mut meter = Meter::new(interrupt, POLL_EVERY);
    let unsafe_states = unsafe_states(edits, model.schema(), model.states(), model.start(), &mut meter)?;
    Ok(Definition::of(Table::of_model(&model, edges, unsafe_states)))
}
