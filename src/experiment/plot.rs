//! The figures as pictures (SVG), tables and CSV: as text, written nowhere.

use std::fmt::Write;

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{Curve, LocationRow, Locations, Paths, Scene};
use etude_core::model::Cell;

/// Why a picture could not be drawn: a defect.
#[derive(Debug, thiserror::Error)]
#[error("a figure could not be drawn: {0}")]
pub struct PlotError(String);

type Drawn = Result<String, PlotError>;

const FONT: &str = "sans-serif";
const INK: RGBColor = RGBColor(40, 40, 40);
const GRID: RGBColor = RGBColor(225, 225, 225);
const BLUE_LINE: RGBColor = RGBColor(31, 105, 176);
const ORANGE_LINE: RGBColor = RGBColor(214, 96, 20);

fn failed(error: impl std::fmt::Display) -> PlotError {
    PlotError(error.to_string())
}

/// Figure 4: both ways on the grid, each on its lane, to the right of where it goes.
///
/// # Errors
///
/// Never, but for a defect.
pub fn figure_4(paths: &Paths) -> Drawn {
    const CELL: i32 = 100;
    const MARGIN: i32 = 40;
    const LEGEND: i32 = 60;
    let scene = Scene::figure_4();
    let cave = scene.cave();
    let (width, height) = (i32::from(cave.size().0), i32::from(cave.size().1));
    let size = ((width * CELL + 2 * MARGIN).unsigned_abs(), (height * CELL + MARGIN + LEGEND + 30).unsigned_abs());
    let corner = |(x, y): Cell| (MARGIN + i32::from(x) * CELL, 20 + (height - 1 - i32::from(y)) * CELL);
    let middle = |cell: Cell| {
        let (x, y) = corner(cell);
        (x + CELL / 2, y + CELL / 2)
    };
    let text = |size: i32| {
        let style = TextStyle::from((FONT, size).into_font()).color(&INK);
        style.pos(Pos::new(HPos::Center, VPos::Center))
    };

    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        for x in 0..cave.size().0 {
            for y in 0..cave.size().1 {
                let (left, top) = corner((x, y));
                area.draw(&Rectangle::new([(left, top), (left + CELL, top + CELL)], GRID)).map_err(failed)?;
            }
            let label = (middle((x, 0)).0, corner((x, 0)).1 + CELL + 14);
            area.draw(&Text::new(x.to_string(), label, text(15))).map_err(failed)?;
        }
        for y in 0..cave.size().1 {
            let label = (MARGIN - 16, middle((0, y)).1);
            area.draw(&Text::new(y.to_string(), label, text(15))).map_err(failed)?;
        }
        let start = cave.first_state().cell;
        let things =
            cave.wumpi().iter().map(|cell| (*cell, "wumpus")).chain(cave.gold().iter().map(|cell| (*cell, "gold")));
        for (cell, name) in things.chain([(start, "start")]) {
            let (left, top) = corner(cell);
            let fill = match name {
                "wumpus" => RGBColor(246, 221, 221),
                "gold" => RGBColor(252, 240, 196),
                _ => RGBColor(226, 240, 226),
            };
            let inside = [(left + 1, top + 1), (left + CELL - 1, top + CELL - 1)];
            area.draw(&Rectangle::new(inside, fill.filled())).map_err(failed)?;
            let corner = text(14).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw(&Text::new(name, (left + 6, top + 12), corner)).map_err(failed)?;
        }
        let ways = [
            (&paths.demonstrator, BLUE_LINE, 24, "demonstrator, who shoots the wumpus at (3, 0)"),
            (&paths.imitator, ORANGE_LINE, 9, "imitator, which cannot shoot"),
        ];
        for (n, (cells, color, lane, name)) in (0..).zip(ways) {
            let line = lanes(cells, lane, middle);
            let style = color.stroke_width(3);
            if let (Some(first), Some([before, last])) = (line.first(), line.last_chunk::<2>()) {
                area.draw(&Circle::new(*first, 5, color.filled())).map_err(failed)?;
                area.draw(&Polygon::new(arrow_head(*before, *last), color.filled())).map_err(failed)?;
            }
            area.draw(&PathElement::new(line, style)).map_err(failed)?;
            let top = 20 + height * CELL + 38 + n * 24;
            area.draw(&PathElement::new([(MARGIN, top), (MARGIN + 40, top)], style)).map_err(failed)?;
            let left = text(16).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw(&Text::new(name, (MARGIN + 52, top), left)).map_err(failed)?;
        }
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

/// The line through `cells`, each part `lane` to the right of where it goes, so that the way back lies beside the way there.
fn lanes(cells: &[Cell], lane: i32, middle: impl Fn(Cell) -> (i32, i32)) -> Vec<(i32, i32)> {
    let parts = cells.windows(2).filter(|pair| pair[0] != pair[1]).map(|pair| {
        let ((x0, y0), (x1, y1)) = (middle(pair[0]), middle(pair[1]));
        ((x0, y0), (x1, y1), ((x1 - x0).signum(), (y1 - y0).signum()))
    });
    // On paper y grows downwards: right of (dx, dy) is (-dy, dx).
    let aside = |(x, y): (i32, i32), (dx, dy): (i32, i32)| (x - dy * lane, y + dx * lane);
    let mut line = Vec::new();
    let mut last = None;
    for (from, to, heading) in parts {
        match last {
            None => line.push(aside(from, heading)),
            Some((_, before)) if before == heading => {}
            Some((_, before)) if before == (-heading.0, -heading.1) => {
                line.extend([aside(from, before), aside(from, heading)]);
            }
            // Where lanes meet at a corner.
            Some((_, before)) => line.push(aside(aside(from, before), heading)),
        }
        last = Some((to, heading));
    }
    line.extend(last.map(|(end, heading)| aside(end, heading)));
    line
}

fn arrow_head((x0, y0): (i32, i32), (x1, y1): (i32, i32)) -> [(i32, i32); 3] {
    let (dx, dy) = ((x1 - x0).signum(), (y1 - y0).signum());
    [(x1 + 12 * dx, y1 + 12 * dy), (x1 - 7 * dy, y1 + 7 * dx), (x1 + 7 * dy, y1 - 7 * dx)]
}

/// Figure 7: the running average of rewards over trials, with its deviation between runs every ten trials.
///
/// # Errors
///
/// Never, but for a defect.
pub fn figure_7(curve: &Curve) -> Drawn {
    let points: Vec<_> = curve.points().collect();
    let n_trials = points.len();
    let least = points.iter().map(|point| point.mean - point.sd).fold(0.0, f64::min);
    let most = points.iter().map(|point| point.mean + point.sd).fold(1000.0, f64::max);
    #[expect(clippy::cast_precision_loss, reason = "there are few trials")]
    let at = |trial: usize| trial as f64;
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (860, 480)).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(20)
            .margin_right(30)
            .x_label_area_size(46)
            .y_label_area_size(66)
            .build_cartesian_2d(0.0..at(n_trials), (least * 1.05)..(most * 1.05))
            .map_err(failed)?;
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .bold_line_style(GRID)
            .axis_style(INK)
            .x_labels(11)
            .y_labels(9)
            .x_label_formatter(&|trial| format!("{trial:.0}"))
            .y_label_formatter(&|reward| format!("{reward:.0}"))
            .x_desc("trial")
            .y_desc(format!("reward: mean of {} runs, each averaged over 10 trials", curve.runs.len()))
            .label_style((FONT, 14).into_font().color(&INK))
            .axis_desc_style((FONT, 15).into_font().color(&INK))
            .draw()
            .map_err(failed)?;
        let line = points.iter().map(|point| (at(point.trial), point.mean));
        chart.draw_series(LineSeries::new(line, BLUE_LINE.stroke_width(2))).map_err(failed)?;
        for point in points.iter().filter(|point| point.trial % Curve::WINDOW == 0) {
            let (x, low, high) = (at(point.trial), point.mean - point.sd, point.mean + point.sd);
            let half = at(n_trials) / 250.0;
            let bars = [
                PathElement::new([(x, low), (x, high)], ORANGE_LINE.stroke_width(1)),
                PathElement::new([(x - half, low), (x + half, low)], ORANGE_LINE.stroke_width(1)),
                PathElement::new([(x - half, high), (x + half, high)], ORANGE_LINE.stroke_width(1)),
            ];
            chart.draw_series(bars).map_err(failed)?;
        }
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

/// Figure 8: what is earned at each location, uniform against learned.
///
/// # Errors
///
/// Never, but for a defect.
pub fn figure_8(locations: &Locations) -> Drawn {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (720, 460)).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        let n_rows = f64::from(u32::try_from(locations.rows.len()).unwrap_or(0));
        let mut chart = ChartBuilder::on(&area)
            .margin(20)
            .margin_top(46)
            .x_label_area_size(30)
            .y_label_area_size(60)
            .build_cartesian_2d(0.0..n_rows, -170.0..1100.0)
            .map_err(failed)?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .disable_x_axis()
            .light_line_style(WHITE)
            .bold_line_style(GRID)
            .axis_style(INK)
            .y_labels(7)
            .y_label_formatter(&|reward| format!("{reward:.0}"))
            .y_desc("reward")
            .label_style((FONT, 14).into_font().color(&INK))
            .axis_desc_style((FONT, 15).into_font().color(&INK))
            .draw()
            .map_err(failed)?;
        let text = |size: i32| {
            let style = TextStyle::from((FONT, size).into_font()).color(&INK);
            style.pos(Pos::new(HPos::Center, VPos::Center))
        };
        for (n, row) in (0_u32..).zip(&locations.rows) {
            let left = f64::from(n);
            for (from, to, reward, color) in
                [(0.14, 0.48, row.uniform, ORANGE_LINE), (0.52, 0.86, row.learned, BLUE_LINE)]
            {
                let bar = Rectangle::new([(left + from, 0.0), (left + to, reward)], color.filled());
                let at = (left + f64::midpoint(from, to), if reward < 0.0 { reward - 35.0 } else { reward + 35.0 });
                let label = Text::new(format!("{reward:.0}"), at, text(14));
                chart.draw_series([bar]).map_err(failed)?;
                chart.draw_series([label]).map_err(failed)?;
            }
            let name = Text::new(format!("gold at {}", row.location), (left + 0.5, -140.0), text(15));
            chart.draw_series([name]).map_err(failed)?;
        }
        chart.draw_series([PathElement::new([(0.0, 0.0), (n_rows, 0.0)], INK)]).map_err(failed)?;
        for (x, color, name) in [(90, ORANGE_LINE, "uniform weights"), (250, BLUE_LINE, "learned weights")] {
            area.draw(&Rectangle::new([(x, 18), (x + 14, 32)], color.filled())).map_err(failed)?;
            let style = text(15).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw(&Text::new(name, (x + 22, 25), style)).map_err(failed)?;
        }
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

/// Figure 7 as CSV: per trial the mean and deviation of the running averages, then the reward of each run.
#[must_use]
pub fn figure_7_csv(curve: &Curve) -> String {
    let mut csv = "trial,mean,sd".to_owned();
    for run in &curve.runs {
        let _ = write!(csv, ",reward_seed_{}", run.seed);
    }
    csv.push('\n');
    for point in curve.points() {
        let _ = write!(csv, "{},{},{}", point.trial, point.mean, point.sd);
        for run in &curve.runs {
            let _ = write!(csv, ",{}", run.rewards[point.trial - 1]);
        }
        csv.push('\n');
    }
    csv
}

/// Figure 8 as CSV.
#[must_use]
pub fn figure_8_csv(locations: &Locations) -> String {
    let mut csv = "location,uniform,learned\n".to_owned();
    for LocationRow { location, uniform, learned } in &locations.rows {
        let _ = writeln!(csv, "{location},{uniform},{learned}");
    }
    csv
}

/// Figure 8 as a table.
#[must_use]
pub fn figure_8_text(locations: &Locations) -> String {
    let mut text = "gold at   uniform   learned\n".to_owned();
    for LocationRow { location, uniform, learned } in &locations.rows {
        let _ = writeln!(text, "{location:<7}   {uniform:>7}   {learned:>7}");
    }
    text.push_str("\nlearned weights:");
    for (attribute, mean) in &locations.means {
        let _ = write!(text, " {attribute} {mean:.2}");
    }
    text.push('\n');
    text
}
