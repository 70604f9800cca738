//! Figure 4: both ways on the grid.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::super::paths::{Deed, Mark};
use super::super::{Paths, Scene};
use super::grid::Grid;
use crate::picture::{BLUE, ORANGE, PictureError, Route, Symbol, draw_legend, failed, label, on_sheet, text};

/// Figure 4: both ways on the grid, each on its lane, to the right of where it goes, with what was shot and grabbed.
///
/// # Errors
///
/// Never, but for a defect.
pub fn figure_4(paths: &Paths) -> Result<String, PictureError> {
    const CORNER: (i32, i32) = (56, 72);
    const CELL: i32 = 100;
    let scene = Scene::figure_4();
    let cave = scene.cave();
    let grid = Grid { corner: CORNER, cell: CELL, size: cave.size() };
    let (width, height) = grid.pixels();
    on_sheet((CORNER.0 + width + 30, CORNER.1 + height + 130), |area| {
        let title = "Figure 4: the same effects by a body that cannot shoot";
        label(area, title, (CORNER.0, 24), &text(19, HPos::Left))?;
        let Paths { actions, cost, reward, .. } = paths;
        let subtitle = format!("imitator: {} actions, cost {cost:.1}, reward {reward}", actions.len());
        label(area, &subtitle, (CORNER.0, 48), &text(15, HPos::Left))?;
        let start = cave.first_state().cell;
        for cell in cave.wumpi() {
            grid.fill(area, *cell, RGBColor(246, 221, 221), "wumpus")?;
        }
        for cell in cave.gold() {
            grid.fill(area, *cell, RGBColor(252, 240, 196), "gold")?;
        }
        grid.fill(area, start, RGBColor(226, 240, 226), "start")?;
        grid.draw(area)?;
        let ways = [(&paths.demonstrator, BLUE, 24.0), (&paths.imitator, ORANGE, 9.0)];
        for (cells, color, lane) in ways {
            Route { points: cells.iter().map(|cell| grid.middle(*cell)).collect(), lane, color }.draw(area)?;
        }
        for Mark { cell, deed, by_imitator } in &paths.marks {
            let color = if *by_imitator { ORANGE } else { BLUE };
            let (x, y) = grid.pixel(*cell);
            match deed {
                Deed::Grab => {
                    let aside = if *by_imitator { (x + 9, y + 9) } else { (x, y + 24) };
                    Symbol::Diamond(color).draw(area, aside)?;
                }
                Deed::Shot { hit } => {
                    let y = y + 38;
                    let to = grid.pixel(*hit).0;
                    // A dashed line.
                    for from in (x..to).step_by(12) {
                        let dash = [(from, y), ((from + 6).min(to), y)];
                        area.draw(&PathElement::new(dash, color.stroke_width(2))).map_err(failed)?;
                    }
                    for rise in [-7, 7] {
                        let cross = [(to - 7, y - rise), (to + 7, y + rise)];
                        area.draw(&PathElement::new(cross, color.stroke_width(3))).map_err(failed)?;
                    }
                    label(area, "shot", (to + 14, y), &text(13, HPos::Left).color(&color))?;
                }
            }
        }
        let entries = [
            (Symbol::Line(BLUE, 3), "demonstrator, who shoots the wumpus in its way"),
            (Symbol::Diamond(BLUE), "grabs the gold"),
            (Symbol::Line(ORANGE, 3), "imitator, which cannot shoot"),
            (Symbol::Diamond(ORANGE), "grabs the gold"),
        ];
        let top = CORNER.1 + height + 72;
        draw_legend(area, (CORNER.0, top), width, &entries[..2])?;
        draw_legend(area, (CORNER.0, top + 26), width, &entries[2..]).map(drop)
    })
}
