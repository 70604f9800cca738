//! Ways through a plane.

use plotters::prelude::*;

use super::sheet::{Area, PictureError, Point, failed};

/// A way through a plane, in pixels.
#[derive(Clone, Debug)]
pub(crate) struct Route {
    /// The places that it passes.
    pub(crate) points: Vec<(f64, f64)>,
    /// How far to the right of where it goes it is drawn, in pixels, so that a way back lies beside the way there, and two routes beside
    /// each other.
    pub(crate) lane: f64,
    pub(crate) color: RGBColor,
}

impl Route {
    /// Draws it, with a dot where it begins and an arrow where it ends.
    pub(crate) fn draw(&self, area: &Area<'_>) -> Result<(), PictureError> {
        let line = beside(&self.points, self.lane);
        let Some(first) = line.first() else { return Ok(()) };
        area.draw(&Circle::new(*first, 5, self.color.filled())).map_err(failed)?;
        if let Some([before, last]) = line.last_chunk::<2>() {
            area.draw(&Polygon::new(arrow_head(*before, *last), self.color.filled())).map_err(failed)?;
        }
        area.draw(&PathElement::new(line, self.color.stroke_width(3))).map_err(failed)
    }
}

/// The line through `points`, each part `lane` pixels to the right of where it goes.
pub(crate) fn beside(points: &[(f64, f64)], lane: f64) -> Vec<Point> {
    /// Where the way bends by more than this (the cosine), its sides are not drawn to where they meet, which is far away.
    const SHARPEST: f64 = -0.7;
    let mut places: Vec<(f64, f64)> = Vec::with_capacity(points.len());
    for point in points {
        if places.last() != Some(point) {
            places.push(*point);
        }
    }
    if let [only] = &*places {
        return vec![pixel((only.0, only.1 + lane))];
    }
    // On paper y grows downwards: right of (dx, dy) is (-dy, dx).
    let right = |from: (f64, f64), to: (f64, f64)| {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        let length = dx.hypot(dy);
        (-dy / length, dx / length)
    };
    let aside = |at: (f64, f64), to: (f64, f64), by: f64| (at.0 + to.0 * by, at.1 + to.1 * by);
    let sides: Vec<_> = places.windows(2).map(|pair| right(pair[0], pair[1])).collect();
    let mut line = Vec::with_capacity(2 * places.len());
    for (n, place) in places.iter().enumerate() {
        let before = n.checked_sub(1).and_then(|before| sides.get(before));
        match (before, sides.get(n)) {
            (Some(before), Some(after)) => {
                let cosine = before.0 * after.0 + before.1 * after.1;
                if cosine > SHARPEST {
                    let middle = (before.0 + after.0, before.1 + after.1);
                    line.push(pixel(aside(*place, middle, lane / (1.0 + cosine))));
                } else {
                    line.extend([*before, *after].map(|side| pixel(aside(*place, side, lane))));
                }
            }
            (Some(side), None) | (None, Some(side)) => line.push(pixel(aside(*place, *side, lane))),
            (None, None) => {}
        }
    }
    line
}

/// A triangle that points on from where a line ends.
fn arrow_head(before: Point, last: Point) -> [Point; 3] {
    let (dx, dy) = (f64::from(last.0 - before.0), f64::from(last.1 - before.1));
    let length = dx.hypot(dy).max(1.0);
    let (dx, dy) = (dx / length, dy / length);
    let (x, y) = (f64::from(last.0), f64::from(last.1));
    [(x + 12.0 * dx, y + 12.0 * dy), (x - 7.0 * dy, y + 7.0 * dx), (x + 7.0 * dy, y - 7.0 * dx)].map(pixel)
}

/// The nearest pixel; the edge of what there can be for what is far beyond the sheet.
#[expect(clippy::cast_possible_truncation, reason = "saturates")]
pub(super) fn pixel((x, y): (f64, f64)) -> Point {
    (x.round() as i32, y.round() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_way_back_lies_beside_the_way_there() {
        let there_and_back = [(0.0, 0.0), (100.0, 0.0), (100.0, 0.0), (0.0, 0.0)];
        assert_eq!(beside(&there_and_back, 10.0), [(0, 10), (100, 10), (100, -10), (0, -10)]);
    }

    #[test]
    fn lanes_meet_at_corners() {
        // To the right, then down: the right of which is left.
        assert_eq!(beside(&[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0)], 10.0), [(0, 10), (90, 10), (90, 100)]);
        assert_eq!(beside(&[(0.0, 0.0), (100.0, 0.0), (200.0, 0.0)], 10.0), [(0, 10), (100, 10), (200, 10)]);
        assert_eq!(beside(&[(5.0, 5.0)], 10.0), [(5, 15)]);
        assert_eq!(beside(&[], 10.0), []);
    }
}
