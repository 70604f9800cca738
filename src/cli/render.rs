//! Policies, weights and caves as text. What is a table is one of comfy-table; bars and maps are drawn.

use std::fmt::Write;

use comfy_table::{CellAlignment, ContentArrangement, Table, TableComponent, presets};
use serde_json::Value;

use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::mapping::{Cost, MoveKind, Policy, PolicyEnd, Step};

/// How wide what is printed may be: as the terminal, or [`WIDTH`] where there is none.
pub(super) fn width() -> usize {
    /// Less is of no use to a table.
    const LEAST: u16 = 40;
    match terminal_size::terminal_size_of(std::io::stdout()) {
        Some((terminal_size::Width(width), _)) => width.max(LEAST).into(),
        None => WIDTH,
    }
}

/// Width of what is printed to a file or a pipe, so that it is the same wherever it is made.
pub(super) const WIDTH: usize = 100;

/// A column of a table.
pub(super) struct Column {
    header: &'static str,
    alignment: CellAlignment,
    cells: Vec<String>,
}

impl Column {
    pub(super) fn new(header: &'static str, alignment: CellAlignment, cells: impl Iterator<Item = String>) -> Self {
        Self { header, alignment, cells: cells.collect() }
    }

    /// How wide it is.
    pub(super) fn width(&self) -> usize {
        let lines = self.cells.iter().flat_map(|cell| cell.lines());
        lines.chain([self.header]).map(|line| line.chars().count()).max().unwrap_or(0)
    }

    /// Breaks its lines between words, so that it is no wider than `width`, but for words that are.
    pub(super) fn wrap(&mut self, width: usize) {
        self.cells.iter_mut().for_each(|cell| *cell = wrapped(cell, width).join("\n"));
    }
}

/// The steps of a policy as a table that is no wider than `width`, but for words that are: of the first step the whole state, of the
/// others what changes, and where the state differs from what was observed. Only attributes that have weight are shown.
pub(super) fn steps(policy: &Policy, width: usize) -> String {
    /// Where the table is too wide, columns are left out in this order.
    const OPTIONAL: [&str; 4] = ["differs in", "distance", "observation", "move"];
    /// Between columns.
    const GAP: usize = 2;
    const STATE: &str = "state";
    /// Widths that the states have at least, while there are columns to be left out: so many words fit, and long ones as far as that.
    const LEAST: usize = 24;
    const LEAST_OF_LONG_WORDS: usize = 40;
    /// A list of attributes is not made wider for the longest that there is.
    const MAX_DIFFERING: usize = 24;
    use CellAlignment::{Left, Right};

    let steps = &policy.steps;
    let before = std::iter::once(None).chain(steps.iter().map(|step| Some(&step.state)));
    let states = before.zip(steps).map(|(before, step)| changes(Some(&policy.weights), before, &step.state));
    let differing = |step: &Step| {
        let names: Vec<_> = step.distance_by_attribute.iter().map(|(name, _)| name).collect();
        names.join(" ")
    };
    let action = |step: &Step| step.action.as_deref().unwrap_or("-").to_owned();
    let mut columns = vec![
        Column::new("step", Right, steps.iter().map(|step| step.step.to_string())),
        Column::new("observation", Right, steps.iter().map(|step| step.observation.to_string())),
        Column::new("move", Left, steps.iter().map(|step| name(step.kind).to_owned())),
        Column::new("action", Left, steps.iter().map(action)),
        Column::new(STATE, Left, states),
        Column::new("distance", Right, steps.iter().map(|step| decimal(step.distance))),
        Column::new("differs in", Left, steps.iter().map(differing)),
        Column::new("cost", Right, steps.iter().map(|step| decimal(step.cost))),
    ];
    columns[6].wrap(MAX_DIFFERING);
    let words = columns[4].cells.iter().flat_map(|state| state.split(' '));
    let longest_word = words.map(|word| word.chars().count()).max().unwrap_or(0);
    let least = longest_word.clamp(LEAST, LEAST_OF_LONG_WORDS);
    let mut optional = OPTIONAL.into_iter();
    let room = loop {
        let others = columns.iter().filter(|column| column.header != STATE).map(|column| column.width() + GAP);
        let room = width.saturating_sub(others.sum());
        match optional.next().filter(|_| room < least) {
            Some(left_out) => columns.retain(|column| column.header != left_out),
            None => break room,
        }
    };
    columns.iter_mut().filter(|column| column.header == STATE).for_each(|column| column.wrap(room.max(1)));
    table(&columns, GAP)
}

/// The columns side by side.
pub(super) fn table(columns: &[Column], gap: usize) -> String {
    let mut table = Table::new();
    table.load_preset(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
    table.set_style(TableComponent::HeaderLines, '─').remove_style(TableComponent::VerticalLines);
    table.set_header(columns.iter().map(|column| column.header));
    let n_rows = columns.first().map_or(0, |column| column.cells.len());
    for row in 0..n_rows {
        table.add_row(columns.iter().map(|column| &column.cells[row]));
    }
    let gap = u16::try_from(gap).unwrap_or(u16::MAX);
    for (n, (column, laid_out)) in columns.iter().zip(table.column_iter_mut()).enumerate() {
        laid_out.set_cell_alignment(column.alignment);
        laid_out.set_padding((0, if n + 1 < columns.len() { gap } else { 0 }));
    }
    table.trim_fmt()
}

/// What a policy costs, what was proven of it, and what it took.
pub(super) fn totals(policy: &Policy) -> String {
    let Policy { cost, coverage, search, .. } = policy;
    let bound =
        policy.lower_bound.map_or("no lower bound".to_owned(), |bound| format!("lower bound {}", decimal(bound)));
    #[expect(clippy::cast_precision_loss, reason = "a time that is shown to three digits")]
    let elapsed_ms = search.elapsed_us as f64 / 1000.0;
    format!(
        "{}status    {}, {bound}\nend       {}\ncoverage  {} of {} observations met exactly\nsearch    \
         {} nodes expanded, {} generated, {elapsed_ms:.2} ms\n",
        self::cost(cost),
        policy.status.name(),
        end(&policy.end),
        coverage.exact,
        coverage.observed,
        search.expanded,
        search.generated,
    )
}

/// The line of a cost.
pub(super) fn cost(cost: &Cost) -> String {
    format!("cost      {}\n", sum(cost))
}

/// A cost and what it is the sum of.
pub(super) fn sum(cost: &Cost) -> String {
    let Cost { total, actions, distance, end } = cost;
    let end = if *end > 0.0 { format!(" + end {}", decimal(*end)) } else { String::new() };
    format!("{} = actions {} + distance {}{end}", decimal(*total), decimal(*actions), decimal(*distance))
}

/// How far a policy ends from the last observation, and in what.
fn end(end: &PolicyEnd) -> String {
    let differing: Vec<_> = end.distance_by_attribute.iter().map(|(name, _)| name).collect();
    match &*differing {
        [] => "as observed".to_owned(),
        names => format!("{} from the last observation, by {}", decimal(end.distance), names.join(", ")),
    }
}

pub(super) fn name(kind: MoveKind) -> &'static str {
    match kind {
        MoveKind::Start => "start",
        MoveKind::Match => "match",
        MoveKind::Extra => "extra",
        MoveKind::Skip => "skip",
    }
}

/// The attributes of a state that are others than `before`, all where that is not known; only those that have weight, if that is known.
pub(super) fn changes(
    weights: Option<&ByAttribute<f64>>,
    before: Option<&ByAttribute<Scalar>>,
    state: &ByAttribute<Scalar>,
) -> String {
    let weighs = |name: &str| weights.is_none_or(|weights| weights.get(name).is_some_and(|weight| *weight > 0.0));
    let is_other = |name: &str, value: &Scalar| before.and_then(|before| before.get(name)) != Some(value);
    let shown = state.iter().filter(|(name, value)| weighs(name) && is_other(name, value));
    shown.map(|(name, value)| format!("{name}={value}")).collect::<Vec<_>>().join(" ")
}

/// The words of `text` on lines of at most `width` characters; a word that is longer stands alone.
pub(super) fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut().filter(|line| line.chars().count() + 1 + word.chars().count() <= width) {
            Some(line) => {
                line.push(' ');
                line.push_str(word);
            }
            None => lines.push(word.to_owned()),
        }
    }
    lines
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

#[cfg(test)]
mod tests {
    use super::*;

    const POLICY: &str = include_str!("../../examples/figure-4/policy.json");

    fn widest(table: &str) -> usize {
        table.lines().map(|line| line.chars().count()).max().unwrap()
    }

    #[test]
    fn a_table_of_steps_shows_what_changes_and_where_the_state_differs() {
        let policy: Policy = serde_json::from_str(POLICY).unwrap();
        let table = steps(&policy, 100);
        let lines: Vec<Vec<&str>> = table.lines().map(|line| line.split_whitespace().collect()).collect();
        for line in [
            "step observation move action state distance differs in cost",
            "0 0 start - x=0 y=0 heading=east gold=0 0.0 0.0",
            "arrows=1 outside=false",
            "1 0 extra turn_left heading=north 1.0 heading 1.3",
            "12 7 match grab gold=1 1.0 arrows 24.6",
        ] {
            let line: Vec<&str> = line.split(' ').collect();
            assert!(lines.contains(&line), "{line:?}\n{table}");
        }
    }

    #[test]
    fn a_table_is_no_wider_than_what_it_is_shown_on() {
        let policy: Policy = serde_json::from_str(POLICY).unwrap();
        for width in (40..140).chain([200]) {
            let table = steps(&policy, width);
            assert!(widest(&table) <= width, "{width}\n{table}");
            assert!(table.contains("action") && table.contains("state") && table.contains("cost"), "{table}");
        }
        assert_eq!(steps(&policy, 200).lines().count(), policy.steps.len() + 2);
    }

    #[test]
    fn lines_are_broken_between_words() {
        assert_eq!(wrapped("a bc defghi j k", 4), ["a bc", "defghi", "j k"]);
        assert_eq!(wrapped("", 4), [""]);
    }
}
