//! A demonstration and its imitation over time, and which step belongs to which observation.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::sheet::{
    Area, BLUE, GRID, INK, ORANGE, PictureError, Point, Symbol, draw_legend, failed, label, on_sheet, text,
};

/// The alignment of a demonstration and its imitation.
#[derive(Clone, Debug)]
pub struct Timeline {
    /// What stands above the picture: a line, and a smaller one.
    pub title: [String; 2],
    /// What is written at each observation.
    pub observations: Vec<String>,
    /// The steps of the imitator.
    pub steps: Vec<Moment>,
}

/// A step of the imitator.
#[derive(Clone, Debug)]
pub struct Moment {
    /// The observation that it belongs to; no less than that of the step before.
    pub observation: usize,
    /// How it advances: `start`, `match`, `extra` or `skip`.
    pub kind: &'static str,
    /// What is written at it.
    pub words: String,
    /// Whether it meets its observation exactly.
    pub is_exact: bool,
}

/// Steps that stand beside one another; further ones stand below.
const PER_ROW: usize = 40;
/// Width of a step.
const STEP: i32 = 26;
const LEFT: i32 = 96;
const TOP: i32 = 70;
const RIGHT: i32 = 40;
/// Between the lines of observations and of steps.
const BETWEEN: i32 = 70;
/// About how long a character is.
const CHAR: i32 = 6;

const START: RGBColor = RGBColor(110, 110, 110);
const SKIP: RGBColor = RGBColor(136, 86, 167);
const MATCH: RGBColor = RGBColor(35, 139, 69);

/// The moves, as they are drawn and explained.
const MOVES: [(&str, RGBColor, &str); 4] = [
    ("start", START, "start"),
    ("match", MATCH, "match: an action, and the next observation"),
    ("extra", ORANGE, "extra: an action, and the same observation"),
    ("skip", SKIP, "skip: the next observation, and no action"),
];

impl Timeline {
    /// Most steps that are drawn.
    pub const MAX_STEPS: usize = 4000;

    /// Draws observations above and steps below, with a line from each step to the observation that it belongs to.
    ///
    /// # Errors
    ///
    /// Never, but for a defect.
    pub fn draw(&self) -> Result<String, PictureError> {
        let longest = |words: &mut dyn Iterator<Item = &String>| {
            let n_chars = words.map(|words| words.chars().count()).max().unwrap_or(0);
            CHAR * i32::try_from(n_chars).unwrap_or(0) + 24
        };
        let above = longest(&mut self.observations.iter());
        let below = longest(&mut self.steps.iter().map(|step| &step.words));
        let row_height = above + BETWEEN + below + 20;
        let n_rows = i32::try_from(self.steps.len().div_ceil(PER_ROW)).unwrap_or(0);
        let n_columns = i32::try_from(self.steps.len().min(PER_ROW)).unwrap_or(0);
        let width = (n_columns * STEP).max(620);
        on_sheet((LEFT + width + RIGHT, TOP + n_rows * row_height + 92), |area| {
            label(area, &self.title[0], (LEFT, 24), &text(18, HPos::Left))?;
            label(area, &self.title[1], (LEFT, 46), &text(14, HPos::Left))?;
            let mut top = TOP + above;
            for (row, steps) in self.steps.chunks(PER_ROW).enumerate() {
                self.draw_row(area, row * PER_ROW, steps, top)?;
                top += row_height;
            }
            let bottom = TOP + n_rows * row_height;
            let moves = MOVES.map(|(_, color, words)| (Symbol::Dot(color), words));
            let bottom = draw_legend(area, (LEFT, bottom + 10), width, &moves)?;
            let exact = [(Symbol::Ring(INK), "what differs from its observation"), (Symbol::Dot(BLUE), "observation")];
            draw_legend(area, (LEFT, bottom), width, &exact).map(drop)
        })
    }

    /// Draws the steps from `first` on, below their observations, which stand at the height `top`.
    fn draw_row(&self, area: &Area<'_>, first: usize, steps: &[Moment], top: i32) -> Result<(), PictureError> {
        let bottom = top + BETWEEN;
        let column = |n: usize| LEFT + STEP / 2 + STEP * i32::try_from(n).unwrap_or(0);
        let right = column(steps.len()) - STEP / 2;
        for (y, name) in [(top, "observed"), (bottom, "done")] {
            area.draw(&PathElement::new([(LEFT, y), (right, y)], GRID.stroke_width(2))).map_err(failed)?;
            label(area, name, (LEFT - 14, y), &text(14, HPos::Right))?;
        }
        let upwards = |anchor| text(12, anchor).transform(FontTransform::Rotate270);
        let mut n = 0;
        while let Some(step) = steps.get(n) {
            let n_steps = steps[n..].iter().take_while(|other| other.observation == step.observation).count();
            let x = i32::midpoint(column(n), column(n + n_steps - 1));
            for (at, step) in (n..).zip(&steps[n..n + n_steps]) {
                let line = [(x, top), (column(at), bottom)];
                area.draw(&PathElement::new(line, color_of(step.kind).stroke_width(2))).map_err(failed)?;
                draw_step(area, step, (column(at), bottom))?;
                label(area, &step.words, (column(at), bottom + 12), &upwards(HPos::Right))?;
                if (first + at).is_multiple_of(5) {
                    let number = (first + at).to_string();
                    label(area, &number, (column(at) + 11, bottom - 9), &text(10, HPos::Center).color(&START))?;
                }
            }
            area.draw(&Circle::new((x, top), 5, BLUE.filled())).map_err(failed)?;
            let words = self.observations.get(step.observation).map_or("", String::as_str);
            label(area, &format!("{} {words}", step.observation), (x, top - 12), &upwards(HPos::Left))?;
            n += n_steps;
        }
        Ok(())
    }
}

fn color_of(kind: &str) -> RGBColor {
    MOVES.iter().find(|(name, ..)| *name == kind).map_or(INK, |(_, color, _)| *color)
}

fn draw_step(area: &Area<'_>, step: &Moment, at: Point) -> Result<(), PictureError> {
    let color = color_of(step.kind);
    if step.is_exact { Symbol::Dot(color) } else { Symbol::Ring(color) }.draw(area, at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_is_drawn_below_its_observation_in_the_color_of_its_move() {
        let moments = (0..90).map(|n| Moment {
            observation: n / 2,
            kind: if n == 0 { "start" } else { ["match", "extra", "skip"][n % 3] },
            words: format!("act {n}"),
            is_exact: n % 2 == 0,
        });
        let timeline = Timeline {
            title: ["a title".to_owned(), "more of it".to_owned()],
            observations: (0..45).map(|n| format!("lit={n}")).collect(),
            steps: moments.collect(),
        };
        let svg = timeline.draw().unwrap();
        for words in ["a title", "act 0", "act 89", "0 lit=0", "44 lit=44", "observed", "done"] {
            assert!(svg.contains(&format!("\n{words}\n")), "{words} is not in\n{svg}");
        }
        for (_, color, words) in MOVES {
            let code = format!("#{:02X}{:02X}{:02X}", color.0, color.1, color.2);
            assert!(svg.contains(&code) && svg.contains(words), "{words}");
        }
    }
}
