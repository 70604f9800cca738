//! Pictures (SVG), as text: nothing is written anywhere.
//!
//! | file | draws |
//! |---|---|
//! | `sheet` | what all pictures are made of: a sheet, colours, text, legends |
//! | `route` | ways through a plane, beside one another where they go the same way |
//! | `paths` | a demonstration and its imitation in the plane of two attributes |
//! | `timeline` | a demonstration and its imitation over time, and which step belongs to which observation |

mod paths;
mod route;
mod sheet;
mod timeline;

pub use paths::{Paths, Stop};
pub(crate) use route::Route;
pub use sheet::PictureError;
pub(crate) use sheet::{Area, BLUE, GRID, INK, ORANGE, Point, Symbol, draw_legend, failed, label, on_sheet, text};
pub use timeline::{Moment, Timeline};
