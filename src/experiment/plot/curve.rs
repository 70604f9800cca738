//! Figure 7: the learning curve.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::super::{Curve, Point};
use crate::picture::{BLUE, GRID, INK, ORANGE, PictureError, Symbol, draw_legend, failed, label, on_sheet, text};

/// Figure 7: the running average of rewards over trials, with its deviation between runs every ten trials.
///
/// # Errors
///
/// Never, but for a defect.
pub fn figure_7(curve: &Curve) -> Result<String, PictureError> {
    const SIZE: (i32, i32) = (860, 560);
    const HEAD: u32 = 96;
    let points: Vec<_> = curve.points().collect();
    let n_trials = points.len();
    let (n_runs, window) = (curve.runs.len(), Curve::WINDOW);
    let bars = || points.iter().filter(|point| n_runs > 1 && point.trial % window == 0);
    let ends = |point: &Point| [point.mean - point.sd, point.mean + point.sd];
    let drawn = || points.iter().map(|point| point.mean).chain(bars().flat_map(ends));
    // Below 0 only as far as something is drawn there.
    let least = drawn().fold(0.0, f64::min);
    let most = drawn().fold(1000.0, f64::max);
    #[expect(clippy::cast_precision_loss, reason = "there are few trials")]
    let at = |trial: usize| trial as f64;
    on_sheet(SIZE, |area| {
        let title = "Figure 7: rewards while weights are learned, in the world of figure 6";
        label(area, title, (24, 26), &text(19, HPos::Left))?;
        let mean = match n_runs {
            1 => format!("running average over {window} trials"),
            _ => format!("running average over {window} trials, mean of {n_runs} runs"),
        };
        let entries = [(Symbol::Line(BLUE, 2), &*mean), (Symbol::Range(ORANGE), "standard deviation between runs")];
        draw_legend(area, (24, 62), SIZE.0 - 48, if n_runs > 1 { &entries } else { &entries[..1] })?;
        let mut chart = ChartBuilder::on(area)
            .margin(20)
            .margin_top(HEAD)
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
            .y_desc("reward")
            .label_style(text(14, HPos::Left))
            .axis_desc_style(text(15, HPos::Left))
            .draw()
            .map_err(failed)?;
        if least < 0.0 {
            chart.draw_series([PathElement::new([(0.0, 0.0), (at(n_trials), 0.0)], INK.mix(0.5))]).map_err(failed)?;
        }
        for point in bars() {
            let (x, [low, high], half) = (at(point.trial), ends(point), at(n_trials) / 250.0);
            let bars =
                [[(x, low), (x, high)], [(x - half, low), (x + half, low)], [(x - half, high), (x + half, high)]];
            let bars = bars.map(|bar| PathElement::new(bar, ORANGE.stroke_width(1)));
            chart.draw_series(bars).map_err(failed)?;
        }
        let line = points.iter().map(|point| (at(point.trial), point.mean));
        chart.draw_series(LineSeries::new(line, BLUE.stroke_width(2))).map_err(failed).map(drop)
    })
}
