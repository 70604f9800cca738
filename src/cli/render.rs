//! Policies, weights and caves as text. What is a table is one of comfy-table; bars and maps are drawn.

use std::fmt::Write;

use comfy_table::{CellAlignment, ContentArrangement, Table, TableComponent, presets};
use serde_json::Value;

use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::mapping::{Cost, MoveKind, Policy, Step};

/// The steps of a policy as a table: observation, move, action, state, distance, cost. Of a state, the attributes that
/// have weight.
pub(super) fn steps(policy: &Policy) -> Table {
    let mut table = Table::new();
    table.load_preset(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
    for line in [TableComponent::HeaderLines, TableComponent::MiddleHeaderIntersections] {
        table.set_style(line, '─');
    }
    table.set_header(["step", "observation", "move", "action", "state", "distance", "cost"]);
    for step in &policy.steps {
        table.add_row([
            step.step.to_string(),
            step.observation.to_string(),
            name(step.kind).to_owned(),
            step.action.as_deref().unwrap_or("-").to_owned(),
            state(Some(&policy.weights), &step.state),
            decimal(step.distance),
            decimal(step.cost),
        ]);
    }
    for column in [0, 1, 5, 6] {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}

/// What a policy costs, what was proven of it, and what it took.
pub(super) fn totals(policy: &Policy) -> String {
    let Policy { cost, coverage, search, .. } = policy;
    let bound =
        policy.lower_bound.map_or("no lower bound".to_owned(), |bound| format!("lower bound {}", decimal(bound)));
    #[expect(clippy::cast_precision_loss, reason = "a time that is shown to three digits")]
    let elapsed_ms = search.elapsed_us as f64 / 1000.0;
    format!(
        "{}status    {}, {bound}\ncoverage  {} of {} observations met exactly\nsearch    \
         {} nodes expanded, {} generated, {elapsed_ms:.2} ms\n",
        self::cost(cost),
        policy.status.name(),
        coverage.exact,
        coverage.observed,
        search.expanded,
        search.generated,
    )
}

/// The line of a cost.
pub(super) fn cost(cost: &Cost) -> String {
    let Cost { total, actions, distance, .. } = cost;
    format!("cost      {} = actions {} + distance {}\n", decimal(*total), decimal(*actions), decimal(*distance))
}

pub(super) fn name(kind: MoveKind) -> &'static str {
    match kind {
        MoveKind::Start => "start",
        MoveKind::Match => "match",
        MoveKind::Extra => "extra",
        MoveKind::Skip => "skip",
    }
}

/// The attributes of a state that have weight; all, if weights are not known.
pub(super) fn state(weights: Option<&ByAttribute<f64>>, state: &ByAttribute<Scalar>) -> String {
    let weighs = |name: &str| weights.is_none_or(|weights| weights.get(name).is_some_and(|weight| *weight > 0.0));
    let shown = state.iter().filter(|(name, _)| weighs(name));
    shown.map(|(name, value)| format!("{name}={value}")).collect::<Vec<_>>().join(" ")
}

/// A cost with one decimal at least and six at most.
pub(super) fn decimal(cost: f64) -> String {
    let text = format!("{cost:.6}");
    let text = text.trim_end_matches('0');
    if text.ends_with('.') { format!("{text}0") } else { text.to_owned() }
}

/// The mean weights of a learner (JSON) as bars.
pub(super) fn weights(weights: &Value) -> String {
    /// Characters per unit of weight.
    const SCALE: f64 = 8.0;
    const MAX_CHARS: usize = 80;
    let mut text = String::new();
    for weight in weights["weights"].as_array().map(Vec::as_slice).unwrap_or_default() {
        let mean = weight["mean"].as_f64().unwrap_or_default();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "saturates, which is what is wanted"
        )]
        let n_chars = ((mean * SCALE).round() as usize).min(MAX_CHARS);
        let name = weight["attribute"].as_str().unwrap_or_default();
        let _ = writeln!(text, "  {name:<8} {mean:>5.2}  {}", "█".repeat(n_chars));
    }
    text
}

/// The cave of `model` (JSON, `wumpus` dynamics) with the cells that the demonstrator (`o`) and the imitator (`x`) pass.
pub(super) fn cave(model: &Value, demonstration: &Value, policy: &Policy) -> String {
    let dynamics = &model["dynamics"];
    let side = |name: &str| dynamics[name].as_u64().unwrap_or(0);
    let (width, height) = (side("width"), side("height"));
    let is_in = |name: &str, x: u64, y: u64| {
        dynamics[name].as_array().is_some_and(|cells| cells.iter().any(|cell| cell[0] == x && cell[1] == y))
    };
    let observations = demonstration.as_array().map(Vec::as_slice).unwrap_or_default();
    let passes_demonstrator = |x: u64, y: u64| observations.iter().any(|seen| seen["x"] == x && seen["y"] == y);
    let passes_imitator = |x: u64, y: u64| {
        let is_at = |step: &Step, name: &str, at: u64| {
            step.state.get(name).is_some_and(|value| value.to_string() == at.to_string())
        };
        policy.steps.iter().any(|step| is_at(step, "x", x) && is_at(step, "y", y))
    };
    let mark = |is_there: bool, mark: char| if is_there { mark } else { ' ' };

    let rule = format!("    +{}\n", "-----+".repeat(usize::try_from(width).unwrap_or(0)));
    let mut text = rule.clone();
    for y in (0..height).rev() {
        let _ = write!(text, "{y:>3} |");
        for x in 0..width {
            let things = [("wumpi", 'W'), ("gold", 'G'), ("pits", 'P')];
            let is_start = dynamics["start"]["x"] == x && dynamics["start"]["y"] == y;
            let thing = things.into_iter().find(|(name, _)| is_in(name, x, y)).map(|(_, mark)| mark);
            let thing = thing.unwrap_or(if is_start { 'S' } else { ' ' });
            let [o, i] = [mark(passes_demonstrator(x, y), 'o'), mark(passes_imitator(x, y), 'x')];
            let _ = write!(text, " {o}{i}{thing} |");
        }
        text.push('\n');
        text.push_str(&rule);
    }
    text.push_str("    ");
    for x in 0..width {
        let _ = write!(text, "{x:^6}");
    }
    text.push('\n');
    text
}
