//! What all pictures are made of.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// Why a picture could not be drawn: a defect.
#[derive(Debug, thiserror::Error)]
#[error("a picture could not be drawn: {0}")]
pub struct PictureError(String);

/// What failed in plotters.
pub(crate) fn failed(error: impl std::fmt::Display) -> PictureError {
    PictureError(error.to_string())
}

/// What is drawn on.
pub(crate) type Area<'s> = DrawingArea<SVGBackend<'s>, Shift>;

/// A place on a sheet, in pixels to the right and down.
pub(crate) type Point = (i32, i32);

const FONT: &str = "sans-serif";
pub(crate) const INK: RGBColor = RGBColor(40, 40, 40);
pub(crate) const GRID: RGBColor = RGBColor(225, 225, 225);
/// Demonstrators are blue, imitators orange.
pub(crate) const BLUE: RGBColor = RGBColor(31, 105, 176);
pub(crate) const ORANGE: RGBColor = RGBColor(214, 96, 20);

/// Draws on a white sheet of this width and height; gives the picture.
pub(crate) fn on_sheet(
    (width, height): (i32, i32),
    draw: impl FnOnce(&Area<'_>) -> Result<(), PictureError>,
) -> Result<String, PictureError> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (width.unsigned_abs(), height.unsigned_abs())).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        draw(&area)?;
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

/// Text of a size in pixels, which stands left of, about or right of its place, at the middle of its height.
pub(crate) fn text(size: i32, anchor: HPos) -> TextStyle<'static> {
    TextStyle::from((FONT, size).into_font()).color(&INK).pos(Pos::new(anchor, VPos::Center))
}

/// Writes `words` at `at`.
pub(crate) fn label(area: &Area<'_>, words: &str, at: Point, style: &TextStyle<'_>) -> Result<(), PictureError> {
    area.draw(&Text::new(words.to_owned(), at, style.clone())).map_err(failed)
}

/// How something is drawn that a legend explains.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Symbol {
    /// A line of this width.
    Line(RGBColor, u32),
    /// A filled circle.
    Dot(RGBColor),
    /// A circle that is not filled.
    Ring(RGBColor),
    /// A filled square.
    Bar(RGBColor),
    /// A line with a stroke at both ends, upright.
    Range(RGBColor),
    /// A filled square on its corner.
    Diamond(RGBColor),
}

impl Symbol {
    /// Draws it around `at`, as large as in a text.
    pub(crate) fn draw(self, area: &Area<'_>, at: Point) -> Result<(), PictureError> {
        let (x, y) = at;
        match self {
            Self::Line(color, width) => {
                area.draw(&PathElement::new([(x - 12, y), (x + 12, y)], color.stroke_width(width)))
            }
            Self::Dot(color) => area.draw(&Circle::new(at, 5, color.filled())),
            Self::Ring(color) => {
                area.draw(&Circle::new(at, 5, WHITE.filled())).map_err(failed)?;
                area.draw(&Circle::new(at, 5, color.stroke_width(2)))
            }
            Self::Bar(color) => area.draw(&Rectangle::new([(x - 7, y - 7), (x + 7, y + 7)], color.filled())),
            Self::Range(color) => {
                for end in [y - 8, y + 8] {
                    area.draw(&PathElement::new([(x - 4, end), (x + 4, end)], color.stroke_width(1)))
                        .map_err(failed)?;
                }
                area.draw(&PathElement::new([(x, y - 8), (x, y + 8)], color.stroke_width(1)))
            }
            Self::Diamond(color) => {
                let corners = [(x - 7, y), (x, y - 7), (x + 7, y), (x, y + 7)];
                area.draw(&Polygon::new(corners, color.filled())).map_err(failed)?;
                area.draw(&PathElement::new([corners[0], corners[1], corners[2], corners[3], corners[0]], INK))
            }
        }
        .map_err(failed)
    }
}

/// An entry of a legend.
pub(crate) type Entry<'w> = (Symbol, &'w str);

/// Draws the entries in a row from `at` on, the next one below where `width` ends. Gives how far down they go.
pub(crate) fn draw_legend(
    area: &Area<'_>,
    (left, top): Point,
    width: i32,
    entries: &[Entry<'_>],
) -> Result<i32, PictureError> {
    /// About how wide a character is.
    const CHAR_WIDTH: i32 = 7;
    const ROW_HEIGHT: i32 = 24;
    let (mut x, mut y) = (left, top);
    for (symbol, words) in entries {
        let entry_width = 52 + CHAR_WIDTH * i32::try_from(words.chars().count()).unwrap_or(0);
        if x > left && x + entry_width > left + width {
            (x, y) = (left, y + ROW_HEIGHT);
        }
        symbol.draw(area, (x + 12, y))?;
        label(area, words, (x + 32, y), &text(15, HPos::Left))?;
        x += entry_width;
    }
    Ok(y + ROW_HEIGHT)
}
