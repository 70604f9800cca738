//! Figure 8: where the gold lies, and what is earned there.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::super::{Locations, Scene};
use super::grid::Grid;
use crate::picture::{
    Area, BLUE, GRID, INK, ORANGE, PictureError, Route, Symbol, draw_legend, failed, label, on_sheet, text,
};

/// Width of the part with the world.
const WORLD: i32 = 400;
/// Height of the part with titles and legends.
const HEAD: i32 = 100;
const SIZE: (i32, i32) = (WORLD + 640, 540);

/// Figure 8: what is earned at each location, uniform against learned, beside the world with the locations.
///
/// # Errors
///
/// Never, but for a defect.
pub fn figure_8(locations: &Locations) -> Result<String, PictureError> {
    on_sheet(SIZE, |area| {
        let title = "Figure 8: weights that were learned in the world of figure 6, used where the gold lies elsewhere";
        label(area, title, (24, 26), &text(19, HPos::Left))?;
        draw_world(area)?;
        let (_, right) = area.split_horizontally(WORLD);
        draw_rewards(&right, locations)?;
        let entries = [(Symbol::Bar(ORANGE), "uniform weights"), (Symbol::Bar(BLUE), "learned weights")];
        draw_legend(area, (WORLD + 84, 66), SIZE.0 - WORLD, &entries).map(drop)
    })
}

/// The world in which the demonstration was given, and the four locations of what gold is left.
fn draw_world(area: &Area<'_>) -> Result<(), PictureError> {
    const CELL: i32 = 54;
    const CORNER: (i32, i32) = (56, HEAD);
    let scenes = Scene::figure_8();
    let [first, ..] = &scenes;
    let cave = first.cave();
    let grid = Grid { corner: CORNER, cell: CELL, size: cave.size() };
    for (scene, name) in scenes.iter().zip(["L1", "L2", "L3", "L4"]) {
        for cell in scene.cave().gold() {
            grid.fill(area, *cell, RGBColor(252, 240, 196), name)?;
        }
    }
    grid.fill(area, cave.first_state().cell, RGBColor(226, 240, 226), "start")?;
    grid.draw(area)?;
    let points = first.observed_cells().iter().map(|cell| grid.middle(*cell)).collect();
    Route { points, lane: 8.0, color: INK }.draw(area)?;
    if let Some(cell) = first.grabbed_at() {
        let (x, y) = grid.pixel(cell);
        Symbol::Diamond(INK).draw(area, (x + 8, y + 8))?;
    }
    let (width, height) = grid.pixels();
    let entries = [(Symbol::Line(INK, 3), "demonstrator"), (Symbol::Diamond(INK), "grabs gold, gone since")];
    draw_legend(area, (CORNER.0, CORNER.1 + height + 66), width + 40, &entries).map(drop)
}

fn draw_rewards(area: &DrawingArea<SVGBackend<'_>, Shift>, locations: &Locations) -> Result<(), PictureError> {
    /// Room for the numbers at the bars.
    const ROOM: f64 = 90.0;
    let rewards = || locations.rows.iter().flat_map(|row| [row.uniform, row.learned]);
    let least = rewards().fold(0.0, f64::min) - ROOM;
    let most = rewards().fold(1000.0, f64::max) + ROOM;
    let n_rows = f64::from(u32::try_from(locations.rows.len()).unwrap_or(0));
    let mut chart = ChartBuilder::on(area)
        .margin(20)
        .margin_top(HEAD - 12)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..n_rows, least..most)
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
        .label_style(text(14, HPos::Left))
        .axis_desc_style(text(15, HPos::Left))
        .draw()
        .map_err(failed)?;
    for (n, row) in (0_u32..).zip(&locations.rows) {
        let left = f64::from(n);
        for (from, to, reward, color) in [(0.14, 0.48, row.uniform, ORANGE), (0.52, 0.86, row.learned, BLUE)] {
            let bar = Rectangle::new([(left + from, 0.0), (left + to, reward)], color.filled());
            let at = (left + f64::midpoint(from, to), if reward < 0.0 { reward - 30.0 } else { reward + 30.0 });
            chart.draw_series([bar]).map_err(failed)?;
            chart.draw_series([Text::new(format!("{reward:.0}"), at, text(14, HPos::Center))]).map_err(failed)?;
        }
        let name = Text::new(format!("gold at {}", row.location), (left + 0.5, least + 8.0), text(15, HPos::Center));
        chart.draw_series([name]).map_err(failed)?;
    }
    chart.draw_series([PathElement::new([(0.0, 0.0), (n_rows, 0.0)], INK)]).map_err(failed).map(drop)
}
