//! A report in words and tables.

use std::fmt::Write;

use comfy_table::CellAlignment::{Left, Right};

use crate::cli::render::{Column, decimal, table, wrapped};
use etude_core::attribute::{KindName, Scalar};
use etude_core::inspection::{
    ActionReport, AttributeReport, DemonstrationReport, PartsReport, ReachReport, Report, StatesReport, UndoReport,
    UnmetReport,
};

/// Between columns.
const GAP: usize = 2;

/// How wide what stands before each line is.
const LABEL: usize = 12;

/// A line that begins with what it is of, no wider than `width`, but for words that are.
pub(super) fn line(label: &str, text: &str, width: usize) -> String {
    let mut lines = String::new();
    for (n, part) in wrapped(text, width.saturating_sub(LABEL).max(1)).iter().enumerate() {
        let _ = writeln!(lines, "{:<LABEL$}{part}", if n == 0 { label } else { "" });
    }
    lines
}

/// What was found in the model.
pub(super) fn model(report: &Report, width: usize) -> String {
    let mut text = line("model", &format!("{}, hash {}", report.model, report.model_hash), width);
    let mut say = |label: &str, told: String| text.push_str(&line(label, &told, width));
    let counts = &report.counts;
    match (&report.reach, counts.states) {
        (Some(reach), n_states) => {
            say("states", states(reach, n_states, counts.n_unsafe));
            if reach.unreachable.states > 0 {
                let told = format!("the body never comes to {}", some(&reach.unreachable, "state", "states"));
                say("unreachable", told);
            }
            say("dead ends", dead_ends(reach));
        }
        (None, Some(n_states)) => say("states", n_states.to_string()),
        (None, None) => say("states", "too many to list them".to_owned()),
    }
    if counts.stochastic > 0 {
        let pairs = count(counts.stochastic, "pair", "pairs");
        say("outcomes", format!("{pairs} of a state and an action have several"));
    }
    if let Some(found) = &report.parts {
        say("parts", parts(found));
    }
    if let Some(undo) = &report.undo {
        say("undoing", undoing(undo));
    }
    if let Some(lookahead) = report.lookahead {
        let never = report.undo.as_ref().is_some_and(|undo| undo.never > 0);
        let more = if never { "; what can never be undone may need more" } else { "" };
        say(
            "lookahead",
            format!("{lookahead} observations for a stream: one more than the actions that undo any one{more}"),
        );
    }
    for unknown in &report.unknown {
        say("not known", format!("{}: {}", unknown.pointer.trim_start_matches('/'), unknown.detail));
    }
    let _ = write!(text, "\n{}\n\n{}\n", attributes(&report.attributes, width), actions(&report.actions));
    text
}

fn count(n: u64, one: &str, several: &str) -> String {
    if n == 1 { format!("1 {one}") } else { format!("{n} {several}") }
}

fn states(reach: &ReachReport, n_states: Option<u64>, n_unsafe: u64) -> String {
    let from = count(reach.starts, "start state", "start states");
    let comes = match n_states {
        Some(n_states) if n_states == reach.states => format!("{n_states}, all of which the body comes to from {from}"),
        Some(n_states) => format!("{n_states}, of which the body comes to {} from {from}", reach.states),
        None => format!("{} that the body comes to from {from}", reach.states),
    };
    let never = if n_unsafe > 0 { format!("; {n_unsafe} must never be entered") } else { String::new() };
    format!("{comes}, with {} between them{never}", count(reach.transitions, "transition", "transitions"))
}

fn dead_ends(reach: &ReachReport) -> String {
    match reach.dead_ends.states {
        0 => "none: something leads on from every state".to_owned(),
        _ => format!("nothing leads on from {}", some(&reach.dead_ends, "state", "states")),
    }
}

/// How many there are, and one of them.
fn some(states: &StatesReport, one: &str, several: &str) -> String {
    let example = states.examples.first().map_or(String::new(), |example| {
        let number = example.state_index.map_or(String::new(), |index| format!("{index} "));
        let values: Vec<String> = example.state.iter().map(|(name, value)| format!("{name}={value}")).collect();
        let such_as = if states.states == 1 { "" } else { "such as " };
        format!(", {such_as}{number}({})", values.join(" "))
    });
    format!("{}{example}", count(states.states, one, several))
}

fn parts(found: &PartsReport) -> String {
    if let [whole] = &*found.largest {
        return match whole.states {
            1 => "a single state".to_owned(),
            n => format!("1: the body can go to and fro between any two of the {n} states"),
        };
    }
    let mut sizes: Vec<(u64, u64)> = Vec::new();
    for part in &found.largest {
        match sizes.last_mut().filter(|(size, _)| *size == part.states) {
            Some((_, n)) => *n += 1,
            None => sizes.push((part.states, 1)),
        }
    }
    let of = |(size, n): (u64, u64)| match n {
        1 => format!("one of {}", count(size, "state", "states")),
        n => format!("{n} of {}", count(size, "state", "states")),
    };
    let mut told: Vec<String> = sizes.into_iter().map(of).collect();
    let n_more = found.parts - found.largest.len() as u64;
    if n_more > 0 {
        told.push(format!("{n_more} that are no larger"));
    }
    let left = match found.n_final {
        n if n == found.parts => "none can be left".to_owned(),
        1 => "1 cannot be left".to_owned(),
        n => format!("{n} cannot be left"),
    };
    format!(
        "{}: {}. The body goes to and fro within one, and never comes back to one that it has left; {left}",
        found.parts,
        told.join(", "),
    )
}

fn undoing(undo: &UndoReport) -> String {
    let mut told = match &undo.steps {
        None => "nothing that the body does was seen to be undone".to_owned(),
        Some(steps) if steps.median == steps.greatest => {
            let undo =
                if steps.greatest == 1 { "1 action undoes" } else { &format!("{} actions undo", steps.greatest) };
            format!("{undo} whatever can be undone")
        }
        Some(steps) => {
            let rare = if steps.p99 < steps.greatest { format!(", 99 of 100 by {}", steps.p99) } else { String::new() };
            format!(
                "half of what can be undone is undone by {}{rare}, all by {}",
                count(steps.median, "action", "actions"),
                steps.greatest
            )
        }
    };
    let told_of = |n: u64, what: &str| {
        if n > 0 {
            format!("; {n} of {} {what}", count(undo.examined, "transition", "transitions"))
        } else {
            String::new()
        }
    };
    told.push_str(&told_of(undo.never, "can never be undone"));
    told.push_str(&told_of(undo.not_found, "would take longer than was looked for, if they can be undone at all"));
    if undo.examined < undo.transitions {
        let _ = write!(told, " (a sample: {} of {} transitions were looked at)", undo.examined, undo.transitions);
    }
    told
}

fn attributes(attributes: &[AttributeReport], width: usize) -> String {
    let kind = |attribute: &AttributeReport| match attribute.kind {
        KindName::Number => "number",
        KindName::Cyclic => "cyclic",
        KindName::Category => "category",
    };
    let values = |attribute: &AttributeReport| match (&attribute.values, attribute.span) {
        (Some(values), _) => values.iter().map(Scalar::to_string).collect::<Vec<_>>().join(", "),
        (None, Some(span)) if span.least == span.greatest => span.least.to_string(),
        (None, Some(span)) => format!("{} from {} to {}", attribute.distinct, span.least, span.greatest),
        (None, None) => format!("{} different ones", attribute.distinct),
    };
    let weight =
        |attribute: &AttributeReport| if attribute.hidden { "hidden".to_owned() } else { decimal(attribute.weight) };
    let changes = |attribute: &AttributeReport| match attribute.changed_by {
        Some(0) => "nothing".to_owned(),
        Some(n) => n.to_string(),
        None => "?".to_owned(),
    };
    let mut columns = vec![
        Column::new("attribute", Left, attributes.iter().map(|attribute| attribute.name.clone())),
        Column::new("kind", Left, attributes.iter().map(|attribute| kind(attribute).to_owned())),
        Column::new("weight", Right, attributes.iter().map(weight)),
        Column::new("changed by", Right, attributes.iter().map(changes)),
        Column::new("values", Left, attributes.iter().map(values)),
    ];
    fit_last(&mut columns, width);
    table(&columns, GAP)
}

/// Breaks the lines of the last column, so that all are no wider than `width`.
fn fit_last(columns: &mut [Column], width: usize) {
    let Some((last, others)) = columns.split_last_mut() else { return };
    let taken: usize = others.iter().map(|column| column.width() + GAP).sum();
    last.wrap(width.saturating_sub(taken).max(1));
}

fn actions(actions: &[ActionReport]) -> String {
    let applies = |action: &ActionReport| match action.applies_in {
        Some(0) => "nowhere".to_owned(),
        Some(n) => n.to_string(),
        None => "?".to_owned(),
    };
    let undone = |action: &ActionReport| match (action.undone_in, action.never_undone) {
        (Some(0), _) => "0: nothing that is compared changes".to_owned(),
        (Some(most), Some(0) | None) => most.to_string(),
        (Some(most), Some(never)) => format!("{most}, but for {never} that nothing undoes"),
        (None, Some(never)) if never > 0 => "nothing".to_owned(),
        (None, _) if action.applies_in == Some(0) => "-".to_owned(),
        (None, _) => "?".to_owned(),
    };
    let columns = [
        Column::new("action", Left, actions.iter().map(|action| action.name.clone())),
        Column::new("cost", Right, actions.iter().map(|action| decimal(action.cost))),
        Column::new("in states", Right, actions.iter().map(applies)),
        Column::new("undone by at most", Left, actions.iter().map(undone)),
    ];
    table(&columns, GAP)
}

/// What of a demonstration the body can never meet.
pub(super) fn demonstration(found: &DemonstrationReport, width: usize) -> String {
    let mut text = String::new();
    let mut say = |label: &str, told: String| text.push_str(&line(label, &told, width));
    let seen = count(found.observations, "observation", "observations");
    say(
        "seen",
        match (found.met, &found.unmet) {
            (Some(met), _) if met == found.observations => {
                format!("{seen}, each of which some state of the body meets")
            }
            (Some(met), Some(unmet)) => {
                let n_unmet = found.observations - met;
                let more = if (unmet.len() as u64) < n_unmet { " .." } else { "" };
                format!("{seen}, {n_unmet} of which no state of the body meets: {}{more}", runs(unmet))
            }
            _ => seen,
        },
    );
    let by_attribute: f64 = found.attributes.iter().map(|attribute| attribute.distance).sum();
    let least = found.distance.unwrap_or(by_attribute);
    say("distance", format!("{} at least, wherever the body goes", decimal(least)));
    let met: Vec<&str> = found
        .attributes
        .iter()
        .filter(|seen| seen.observed > 0 && seen.unmet == 0)
        .map(|seen| seen.name.as_str())
        .collect();
    let unmet: Vec<&UnmetReport> = found.attributes.iter().filter(|seen| seen.unmet > 0).collect();
    match (met.is_empty(), unmet.is_empty()) {
        (false, true) if found.met.is_some_and(|met| met < found.observations) => {
            say("values", "each is that of some state, but no state has all that was observed at a time".to_owned());
        }
        (false, true) => say("values", "each is that of some state".to_owned()),
        (false, false) => say("values", format!("each of {} is that of some state; others are not:", met.join(", "))),
        (true, _) => {}
    }
    if !unmet.is_empty() {
        let _ = writeln!(text, "\n{}", attributes_unmet(&unmet, width));
    }
    text
}

/// Numbers, ascending, those that follow one another as a run.
fn runs(numbers: &[u64]) -> String {
    let runs = numbers.chunk_by(|one, other| other - one == 1);
    let told = runs.map(|run| match run {
        [first, .., last] => format!("{first} to {last}"),
        run => run.iter().map(u64::to_string).collect(),
    });
    told.collect::<Vec<_>>().join(", ")
}

fn attributes_unmet(unmet: &[&UnmetReport], width: usize) -> String {
    let values = |unmet: &&UnmetReport| {
        let listed = unmet.values.iter();
        let told = listed.map(|value| format!("{} (closest: {})", value.value, value.closest));
        let mut told: Vec<String> = told.take(MAX_SHOWN).collect();
        if unmet.distinct > told.len() as u64 {
            told.push(format!("and {} more", unmet.distinct - told.len() as u64));
        }
        told.join(", ")
    };
    let mut columns = vec![
        Column::new("attribute", Left, unmet.iter().map(|unmet| unmet.name.clone())),
        Column::new("observed", Right, unmet.iter().map(|unmet| unmet.observed.to_string())),
        Column::new("not met", Right, unmet.iter().map(|unmet| unmet.unmet.to_string())),
        Column::new("distance at least", Right, unmet.iter().map(|unmet| decimal(unmet.distance))),
        Column::new("values that no state has", Left, unmet.iter().map(values)),
    ];
    fit_last(&mut columns, width);
    table(&columns, GAP)
}

/// Of the values that no state has, so many are shown.
const MAX_SHOWN: usize = 5;
