//! The cells of a cave on a sheet.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use crate::picture::{Area, GRID, INK, PictureError, Point, failed, label, text};
use etude_core::model::Cell;

/// Where the cells of a cave lie on a sheet.
pub(super) struct Grid {
    /// Its upper left corner.
    pub(super) corner: Point,
    /// Side of a cell in pixels.
    pub(super) cell: i32,
    /// Cells to the right and up.
    pub(super) size: (u16, u16),
}

impl Grid {
    /// Its width and height.
    pub(super) fn pixels(&self) -> Point {
        (i32::from(self.size.0) * self.cell, i32::from(self.size.1) * self.cell)
    }

    /// The upper left corner of a cell.
    fn corner_of(&self, (x, y): Cell) -> Point {
        let row = i32::from(self.size.1) - 1 - i32::from(y);
        (self.corner.0 + i32::from(x) * self.cell, self.corner.1 + row * self.cell)
    }

    /// The middle of a cell.
    pub(super) fn pixel(&self, cell: Cell) -> Point {
        let (x, y) = self.corner_of(cell);
        (x + self.cell / 2, y + self.cell / 2)
    }

    /// The same.
    pub(super) fn middle(&self, cell: Cell) -> (f64, f64) {
        let (x, y) = self.pixel(cell);
        (x.into(), y.into())
    }

    /// Colours a cell, and says what is there.
    pub(super) fn fill(&self, area: &Area<'_>, cell: Cell, color: RGBColor, words: &str) -> Result<(), PictureError> {
        let (left, top) = self.corner_of(cell);
        area.draw(&Rectangle::new([(left, top), (left + self.cell, top + self.cell)], color.filled()))
            .map_err(failed)?;
        label(area, words, (left + 6, top + 12), &text(13, HPos::Left))
    }

    /// Draws the lines between cells, and their coordinates.
    pub(super) fn draw(&self, area: &Area<'_>) -> Result<(), PictureError> {
        let (width, height) = self.pixels();
        let (left, top) = self.corner;
        for n in 0..=i32::from(self.size.0) {
            let x = left + n * self.cell;
            area.draw(&PathElement::new([(x, top), (x, top + height)], GRID)).map_err(failed)?;
        }
        for n in 0..=i32::from(self.size.1) {
            let y = top + n * self.cell;
            area.draw(&PathElement::new([(left, y), (left + width, y)], GRID)).map_err(failed)?;
        }
        area.draw(&Rectangle::new([(left, top), (left + width, top + height)], INK.mix(0.4))).map_err(failed)?;
        for x in 0..self.size.0 {
            label(area, &x.to_string(), (self.pixel((x, 0)).0, top + height + 14), &text(14, HPos::Center))?;
        }
        for y in 0..self.size.1 {
            label(area, &y.to_string(), (left - 14, self.pixel((0, y)).1), &text(14, HPos::Center))?;
        }
        label(area, "x", (left + width / 2, top + height + 34), &text(15, HPos::Center))?;
        label(area, "y", (left - 36, top + height / 2), &text(15, HPos::Center))
    }
}
