//! A demonstration and its imitation in the plane of two attributes.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::route::{Route, pixel};
use super::sheet::{
    Area, BLUE, GRID, INK, ORANGE, PictureError, Point, Symbol, draw_legend, failed, label, on_sheet, text,
};

/// Two paths, each of them in the order of time.
#[derive(Clone, Debug)]
pub struct Paths {
    /// What stands above the picture: a line, and a smaller one.
    pub title: [String; 2],
    /// Names of the two attributes, to the right and up.
    pub axes: [String; 2],
    /// Where the demonstrator was seen; `None` where one of the attributes was not observed.
    pub demonstration: Vec<Option<(f64, f64)>>,
    /// Where the imitator went.
    pub imitation: Vec<Stop>,
}

/// A step of the imitator.
#[derive(Clone, Debug)]
pub struct Stop {
    /// Where it led to.
    pub at: (f64, f64),
    /// The observation that it belongs to.
    pub observation: usize,
    /// The action that was taken, if any.
    pub action: Option<String>,
}

/// Size of the plane.
const PLANE: f64 = 560.0;
const LEFT: i32 = 76;
const TOP: i32 = 70;
const RIGHT: i32 = 40;

impl Paths {
    /// Draws both paths, and thin lines from each observation to the steps that belong to it, where those are elsewhere.
    ///
    /// # Errors
    ///
    /// Never, but for a defect.
    pub fn draw(&self) -> Result<String, PictureError> {
        let seen = || self.demonstration.iter().flatten().copied();
        let plane = Plane::around(seen().chain(self.imitation.iter().map(|stop| stop.at)));
        let (width, height) = plane.size();
        on_sheet((LEFT + width.max(420) + RIGHT, TOP + height + 130), |area| {
            label(area, &self.title[0], (LEFT, 24), &text(18, HPos::Left))?;
            label(area, &self.title[1], (LEFT, 46), &text(14, HPos::Left))?;
            plane.draw_axes(area, &self.axes)?;
            self.draw_alignment(area, &plane)?;
            let imitated: Vec<_> = self.imitation.iter().map(|stop| plane.place(stop.at)).collect();
            Route { points: seen().map(|at| plane.place(at)).collect(), lane: 10.0, color: BLUE }.draw(area)?;
            Route { points: imitated, lane: 4.0, color: ORANGE }.draw(area)?;
            self.draw_acts(area, &plane)?;
            let entries = [
                (Symbol::Line(BLUE, 3), "demonstrator"),
                (Symbol::Line(ORANGE, 3), "imitator"),
                (Symbol::Line(PALE, 1), "observation and step of it"),
            ];
            draw_legend(area, (LEFT, TOP + height + 84), width.max(420), &entries).map(drop)
        })
    }

    fn draw_alignment(&self, area: &Area<'_>, plane: &Plane) -> Result<(), PictureError> {
        for stop in &self.imitation {
            let seen = self.demonstration.get(stop.observation).copied().flatten();
            if let Some(seen) = seen.filter(|seen| *seen != stop.at) {
                let line = [seen, stop.at].map(|at| pixel(plane.place(at)));
                area.draw(&PathElement::new(line, PALE)).map_err(failed)?;
            }
        }
        Ok(())
    }

    /// Names the actions that are rare and do not lead elsewhere: what is done where the imitator stands.
    fn draw_acts(&self, area: &Area<'_>, plane: &Plane) -> Result<(), PictureError> {
        const RARE: usize = 2;
        /// About how wide a character is.
        const CHAR_WIDTH: i32 = 7;
        let count = |action: &str| self.imitation.iter().filter(|stop| stop.action.as_deref() == Some(action)).count();
        let mut named: Vec<(f64, f64)> = Vec::new();
        for pair in self.imitation.windows(2) {
            let Some(action) = pair[1].action.as_deref().filter(|action| count(action) <= RARE) else { continue };
            if pair[0].at != pair[1].at {
                continue;
            }
            let n_before = named.iter().filter(|at| **at == pair[1].at).count();
            named.push(pair[1].at);
            let (x, y) = pixel(plane.place(pair[1].at));
            let below = 20 + 16 * i32::try_from(n_before).unwrap_or(0);
            Symbol::Ring(ORANGE).draw(area, (x, y))?;
            let length = CHAR_WIDTH * i32::try_from(action.chars().count()).unwrap_or(0);
            let left = (x + 8).min(LEFT + plane.size().0 - length - 4);
            let paper = [(left - 2, y + below - 8), (left + length, y + below + 8)];
            area.draw(&Rectangle::new(paper, WHITE.mix(0.8).filled())).map_err(failed)?;
            label(area, action, (left, y + below), &text(13, HPos::Left).color(&ORANGE))?;
        }
        Ok(())
    }
}

const PALE: RGBColor = RGBColor(170, 170, 170);

/// What of a plane is shown, and where.
struct Plane {
    least: (f64, f64),
    most: (f64, f64),
    /// Pixels per unit.
    scale: (f64, f64),
    /// Least distance of ticks: 1 where all points are whole numbers.
    least_step: f64,
}

impl Plane {
    /// The part of the plane that these points lie in, as large as there is room. A unit is as long up as to the right, unless the points
    /// would lie on a line then.
    fn around(points: impl Iterator<Item = (f64, f64)>) -> Self {
        /// The most that the sides of a picture differ by.
        const LONGEST: f64 = 6.0;
        let points: Vec<_> = points.collect();
        let are_whole = points.iter().all(|(x, y)| x.fract() == 0.0 && y.fract() == 0.0);
        let none = (f64::INFINITY, f64::NEG_INFINITY);
        let ((mut left, mut right), (mut bottom, mut top)) = points
            .into_iter()
            .fold((none, none), |(xs, ys), (x, y)| ((xs.0.min(x), xs.1.max(x)), (ys.0.min(y), ys.1.max(y))));
        if left > right {
            (left, right, bottom, top) = (0.0, 0.0, 0.0, 0.0);
        }
        let largest = (right - left).max(top - bottom);
        let margin = if largest > 0.0 { largest * 0.06 } else { 1.0 };
        let (width, height) = (right - left, top - bottom);
        let are_alike = width * LONGEST >= height && height * LONGEST >= width;
        let (margin_x, margin_y) = if are_alike || largest == 0.0 {
            (margin, margin)
        } else {
            // A line, or units that differ: each side has its own.
            let of = |side: f64| if side > 0.0 { side * 0.06 } else { 1.0 };
            (of(width), of(height))
        };
        (left, right, bottom, top) = (left - margin_x, right + margin_x, bottom - margin_y, top + margin_y);
        let (width, height) = (right - left, top - bottom);
        let scale = if width * LONGEST >= height && height * LONGEST >= width {
            let scale = PLANE / width.max(height);
            (scale, scale)
        } else {
            (PLANE / width, PLANE * 0.6 / height)
        };
        Self { least: (left, bottom), most: (right, top), scale, least_step: if are_whole { 1.0 } else { 0.0 } }
    }

    /// Its width and height in pixels.
    fn size(&self) -> Point {
        pixel(((self.most.0 - self.least.0) * self.scale.0, (self.most.1 - self.least.1) * self.scale.1))
    }

    /// Where a point lies on the sheet.
    fn place(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (f64::from(LEFT) + (x - self.least.0) * self.scale.0, f64::from(TOP) + (self.most.1 - y) * self.scale.1)
    }

    fn draw_axes(&self, area: &Area<'_>, names: &[String; 2]) -> Result<(), PictureError> {
        let (width, height) = self.size();
        let (right, bottom) = (LEFT + width, TOP + height);
        let (step_x, step_y) = (step(self.most.0 - self.least.0), step(self.most.1 - self.least.1));
        // Where a unit is as long up as to the right, so is what lies between ticks.
        let at_least = if self.scale.0 == self.scale.1 { step_x.max(step_y) } else { 0.0 }.max(self.least_step);
        for x in ticks(self.least.0, self.most.0, step_x.max(at_least)) {
            let (at, _) = pixel(self.place((x, 0.0)));
            area.draw(&PathElement::new([(at, TOP), (at, bottom)], GRID)).map_err(failed)?;
            label(area, &shown(x), (at, bottom + 16), &text(13, HPos::Center))?;
        }
        for y in ticks(self.least.1, self.most.1, step_y.max(at_least)) {
            let (_, at) = pixel(self.place((0.0, y)));
            area.draw(&PathElement::new([(LEFT, at), (right, at)], GRID)).map_err(failed)?;
            label(area, &shown(y), (LEFT - 10, at), &text(13, HPos::Right))?;
        }
        area.draw(&Rectangle::new([(LEFT, TOP), (right, bottom)], INK.mix(0.4))).map_err(failed)?;
        label(area, &names[0], (LEFT + width / 2, bottom + 42), &text(15, HPos::Center))?;
        let upwards = text(15, HPos::Center).transform(FontTransform::Rotate270);
        label(area, &names[1], (18, TOP + height / 2), &upwards)
    }
}

/// A round number that some five to ten times make a length.
fn step(length: f64) -> f64 {
    const MOST_TICKS: f64 = 10.0;
    let rough = length / MOST_TICKS;
    let power = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0].into_iter().map(|step| step * power).find(|step| *step >= rough);
    step.unwrap_or(10.0 * power)
}

/// The multiples of `step` between two numbers.
fn ticks(least: f64, most: f64, step: f64) -> Vec<f64> {
    if !step.is_normal() {
        return Vec::new();
    }
    let first = (least / step).ceil();
    // By whole multiples, so that no sum drifts.
    (0..=20).map(|n| (first + f64::from(n)) * step).take_while(|tick| *tick <= most).collect()
}

/// A tick as it is written: to as many digits as tell it from others.
fn shown(tick: f64) -> String {
    let rounded = format!("{tick:.9}");
    let trimmed = rounded.trim_end_matches('0').trim_end_matches('.');
    if trimmed == "-0" { "0".to_owned() } else { trimmed.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stop(at: (f64, f64), observation: usize, action: Option<&str>) -> Stop {
        Stop { at, observation, action: action.map(str::to_owned) }
    }

    #[test]
    fn both_paths_their_axes_and_rare_acts_are_drawn() {
        let paths = Paths {
            title: ["a title".to_owned(), "more of it".to_owned()],
            axes: ["east".to_owned(), "north".to_owned()],
            demonstration: vec![Some((0.0, 0.0)), None, Some((4.0, 3.0))],
            imitation: vec![
                stop((0.0, 0.0), 0, None),
                stop((4.0, 0.0), 1, Some("drive")),
                stop((4.0, 2.0), 2, Some("drive")),
                stop((4.0, 2.0), 2, Some("pick up")),
            ],
        };
        let svg = paths.draw().unwrap();
        for words in ["a title", "more of it", "east", "north", "pick up", "demonstrator", "imitator"] {
            assert!(svg.contains(&format!("\n{words}\n")), "{words} is not in\n{svg}");
        }
        assert!(!svg.contains("drive"), "what leads elsewhere is not named");
        assert!(svg.matches("<polyline").count() >= 2, "{svg}");
    }

    #[test]
    fn a_plane_holds_all_points_whatever_their_units() {
        for points in [
            vec![],
            vec![(3.0, 3.0)],
            vec![(0.0, 0.0), (9.0, 0.0)],
            vec![(0.0, -1e9), (1e-6, 1e9)],
            vec![(f64::MIN / 4.0, 0.0), (f64::MAX / 4.0, 1.0)],
        ] {
            let plane = Plane::around(points.iter().copied());
            let (width, height) = plane.size();
            assert!((1..=1000).contains(&width) && (1..=1000).contains(&height), "{points:?}: {width}x{height}");
            for point in points {
                let (x, y) = pixel(plane.place(point));
                let is_inside = (LEFT..=LEFT + width).contains(&x) && (TOP..=TOP + height).contains(&y);
                assert!(is_inside, "{point:?} is at {x}, {y}");
            }
        }
    }

    #[test]
    fn ticks_are_round_numbers() {
        assert_eq!((step(8.0), step(0.01), step(178.0), step(10.0)), (1.0, 0.001, 20.0, 1.0));
        assert_eq!(ticks(-0.5, 3.5, 1.0), [0.0, 1.0, 2.0, 3.0]);
        assert_eq!(ticks(0.0, 0.01, 0.001).iter().map(|tick| shown(*tick)).nth(3).as_deref(), Some("0.003"));
        assert_eq!(ticks(12.0, 190.0, 20.0).first(), Some(&20.0));
    }
}
