//! Actions of the float policy against those of the int8 policy on the same observations.

use super::axis::{Axes, chart, padded};
use super::theme::{Area, MUTED, data_color, draw_error, figure, units};
use super::{PlotError, PlotOptions};
use plotters::prelude::*;

/// Points drawn at most in the scatter plot; of more, evenly spaced ones are taken.
const MAX_POINTS: usize = 2000;
/// Bins of the histogram; odd, so that one is centred on zero.
const BINS: usize = 41;

/// Draws two panels: `int8` over `float` as points on the diagonal, and the histogram of their difference. Both lists hold
/// one action component on the same observations, in `unit` (`1` for none).
///
/// # Errors
/// [`PlotError::Lengths`] if the lists differ in length, [`PlotError::NoData`] if they are empty or not finite,
/// [`PlotError::Draw`] from the plotting library.
pub fn action_error(float: &[f64], int8: &[f64], unit: &str, options: &PlotOptions) -> Result<String, PlotError> {
    if float.len() != int8.len() {
        return Err(PlotError::Lengths { what: "float against int8 actions", left: float.len(), right: int8.len() });
    }
    let pairs: Vec<(f64, f64)> =
        float.iter().copied().zip(int8.iter().copied()).filter(|(a, b)| a.is_finite() && b.is_finite()).collect();
    if pairs.is_empty() {
        return Err(PlotError::NoData("no finite pair of actions"));
    }
    figure(options, options.height, |area| {
        let (left, right) = area.split_horizontally(area.dim_in_pixel().0 / 2);
        scatter(&left, &pairs, unit)?;
        histogram(&right, &pairs, unit)
    })
}

fn scatter(area: &Area<'_>, pairs: &[(f64, f64)], unit: &str) -> Result<(), PlotError> {
    let range = padded(pairs.iter().flat_map(|&(a, b)| [a, b]), 0.05);
    let axes = Axes {
        x_name: &with_unit("float action", unit),
        y_name: &with_unit("int8 action", unit),
        x: range.clone(),
        y: range.clone(),
        whole_x: false,
        least_y_label_px: 0,
    };
    let mut chart = chart(area, &axes)?;
    let diagonal = [(range.start, range.start), (range.end, range.end)];
    let style = MUTED.color().stroke_width(units(1));
    chart.draw_series(DashedLineSeries::new(diagonal, units(6), units(4), style)).map_err(draw_error)?;
    let points = pairs
        .iter()
        .step_by(pairs.len().div_ceil(MAX_POINTS))
        .map(|&point| Circle::new(point, (units(5) / 2) as i32, data_color(0).mix(0.5).filled()));
    chart.draw_series(points).map_err(draw_error)?;
    Ok(())
}

fn histogram(area: &Area<'_>, pairs: &[(f64, f64)], unit: &str) -> Result<(), PlotError> {
    let (counts, half_range) = bins(pairs);
    let share = |count: usize| 100.0 * count as f64 / pairs.len() as f64;
    let highest = counts.iter().map(|&count| share(count)).fold(0.0, f64::max);
    let axes = Axes {
        x_name: &with_unit("int8 − float", unit),
        y_name: "share of decisions (%)",
        x: -half_range..half_range,
        y: 0.0..highest * 1.05,
        whole_x: false,
        least_y_label_px: 0,
    };
    let mut chart = chart(area, &axes)?;
    let width = 2.0 * half_range / BINS as f64;
    let bars = counts.iter().enumerate().filter(|&(_, &count)| count > 0).map(|(i, &count)| {
        let left = -half_range + width * i as f64;
        Rectangle::new([(left + 0.04 * width, 0.0), (left + 0.96 * width, share(count))], data_color(0).filled())
    });
    chart.draw_series(bars).map_err(draw_error)?;
    Ok(())
}

/// Counts of the differences in [`BINS`] equal bins over `-half_range..half_range`, and `half_range`.
fn bins(pairs: &[(f64, f64)]) -> ([usize; BINS], f64) {
    let largest = pairs.iter().map(|(a, b)| (b - a).abs()).fold(0.0, f64::max);
    let half_range = if largest > 0.0 { largest } else { 1.0 };
    let mut counts = [0; BINS];
    for (a, b) in pairs {
        let place = ((b - a) / half_range + 1.0) * (BINS as f64 / 2.0);
        counts[(place as usize).min(BINS - 1)] += 1;
    }
    (counts, half_range)
}

fn with_unit(name: &str, unit: &str) -> String {
    if unit.is_empty() || unit == "1" { name.to_owned() } else { format!("{name} ({unit})") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_fall_in_the_right_bins() {
        let (counts, half_range) = bins(&[(0.0, 0.0), (1.0, 1.5), (1.0, 0.5), (2.0, 2.0)]);
        assert_eq!(half_range, 0.5);
        assert_eq!((counts[0], counts[BINS / 2], counts[BINS - 1]), (1, 2, 1));
        assert_eq!(counts.iter().sum::<usize>(), 4);
        assert_eq!(bins(&[(1.0, 1.0)]).0[BINS / 2], 1);
    }

    #[test]
    fn the_figure_has_both_panels_with_units() {
        let svg = action_error(&[0.0, 1.0], &[0.1, 0.9], "N", &PlotOptions::new("Error")).unwrap();
        for text in ["float action (N)", "int8 action (N)", "int8 − float (N)", "share of decisions (%)"] {
            assert!(svg.contains(text), "{text}");
        }
    }

    #[test]
    fn unequal_or_empty_lists_are_refused() {
        let options = PlotOptions::new("");
        assert!(matches!(action_error(&[0.0], &[], "1", &options), Err(PlotError::Lengths { left: 1, right: 0, .. })));
        assert!(matches!(action_error(&[f64::NAN], &[0.0], "1", &options), Err(PlotError::NoData(_))));
    }

    #[test]
    fn many_points_are_thinned() {
        let values: Vec<f64> = (0..50_000).map(f64::from).collect();
        let svg = action_error(&values, &values, "1", &PlotOptions::new("")).unwrap();
        let circles = svg.matches("<circle").count();
        assert!((MAX_POINTS / 2..=MAX_POINTS).contains(&circles), "{circles}");
    }
}
