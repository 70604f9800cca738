//! The figures as pictures (SVG), tables and CSV: as text, written nowhere.

mod curve;
mod grid;
mod locations;
mod ways;

use std::fmt::Write;

pub use self::curve::figure_7;
pub use self::locations::figure_8;
pub use self::ways::figure_4;
use super::{Curve, LocationRow, Locations};

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
