//! Ranges and tick labels, and the axes that all charts share.

use super::PlotError;
use super::theme::{Area, GRID, INK, LABEL_PX, TICK_PX, draw_error, font, text_width, units};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use std::ops::Range;

/// A chart on two linear axes.
pub(super) type Chart<'a> = ChartContext<'a, SVGBackend<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Names and ranges of the axes.
pub(super) struct Axes<'a> {
    pub(super) x_name: &'a str,
    pub(super) y_name: &'a str,
    pub(super) x: Range<f64>,
    pub(super) y: Range<f64>,
    /// Whether the x axis counts whole things, so that ticks between them have no label.
    pub(super) whole_x: bool,
}

/// Draws grid, axes and labels on `area`.
pub(super) fn chart<'a>(area: &Area<'a>, axes: &Axes<'_>) -> Result<Chart<'a>, PlotError> {
    let (width, height) = area.dim_in_pixel();
    let x_ticks = (width / units(95)).clamp(2, 10) as usize;
    let y_ticks = (height / units(48)).clamp(2, 8) as usize;
    let (x_scale, y_scale) = (Scale::of(&axes.x), Scale::of(&axes.y));
    let widest = axes.y_ticks(y_ticks).iter().map(|&tick| text_width(&y_scale.label(tick), TICK_PX)).max().unwrap_or(0);
    let mut chart = ChartBuilder::on(area)
        .x_label_area_size(units(48))
        .y_label_area_size(units(widest + 34))
        .margin_right(units(20))
        .margin_top(units(8))
        .build_cartesian_2d(axes.x.clone(), axes.y.clone())
        .map_err(draw_error)?;
    let (ink, grid) = (INK.color(), GRID.color());
    chart
        .configure_mesh()
        .x_desc(axes.x_name)
        .y_desc(axes.y_name)
        .x_labels(x_ticks)
        .y_labels(y_ticks)
        .x_label_formatter(&|&tick| {
            if axes.whole_x && (tick.round() - tick).abs() > 1e-9 { String::new() } else { x_scale.label(tick) }
        })
        .y_label_formatter(&|&tick| y_scale.label(tick))
        .label_style(font(TICK_PX, &ink))
        .axis_desc_style(font(LABEL_PX, &ink))
        .axis_style(ink.stroke_width(units(1)))
        .bold_line_style(grid.stroke_width(units(1)))
        .light_line_style(TRANSPARENT)
        .set_all_tick_mark_size(units(4))
        .draw()
        .map_err(draw_error)?;
    Ok(chart)
}

impl Axes<'_> {
    /// The ticks that the library will choose for the y axis.
    fn y_ticks(&self, count: usize) -> Vec<f64> {
        RangedCoordf64::from(self.y.clone()).key_points(count)
    }
}

/// How the ticks of one axis are written: all alike.
struct Scale {
    divisor: f64,
    suffix: &'static str,
}

impl Scale {
    fn of(range: &Range<f64>) -> Self {
        let largest = range.start.abs().max(range.end.abs());
        let (divisor, suffix) = match largest {
            1e9.. => (1e9, "G"),
            1e6..1e9 => (1e6, "M"),
            1e4..1e6 => (1e3, "k"),
            _ => (1.0, ""),
        };
        Self { divisor, suffix }
    }

    fn label(&self, tick: f64) -> String {
        let scaled = tick / self.divisor;
        if scaled.abs() < 1e-12 {
            return "0".to_owned();
        }
        if scaled.abs() < 1e-3 {
            return format!("{tick:e}").replace('-', "−");
        }
        // Ticks are sums of steps and carry their rounding; six digits do not show it.
        let fixed = format!("{scaled:.6}");
        let shortest = fixed.trim_end_matches('0').trim_end_matches('.');
        format!("{}{}", shortest.replace('-', "−"), self.suffix)
    }
}

/// The smallest range that holds `values`, with `padding` of its length on both sides; never empty.
pub(super) fn padded(values: impl IntoIterator<Item = f64>, padding: f64) -> Range<f64> {
    let (low, high) = values
        .into_iter()
        .filter(|value| value.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    if low > high {
        return -1.0..1.0;
    }
    let length = high - low;
    if length <= 1e-9 * low.abs().max(high.abs()).max(1e-9) {
        let half = (low.abs() * 0.1).max(1e-6);
        let half = if low == 0.0 { 1.0 } else { half };
        return low - half..high + half;
    }
    low - padding * length..high + padding * length
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_hold_their_values_and_are_never_empty() {
        assert_eq!(padded([1.0, 3.0, f64::NAN], 0.1), 0.8..3.2);
        assert_eq!(padded([0.0, 0.0], 0.1), -1.0..1.0);
        assert_eq!(padded([], 0.1), -1.0..1.0);
        let constant = padded([1000.0], 0.1);
        assert!(constant.start < 1000.0 && constant.end > 1000.0);
    }

    #[test]
    fn ticks_of_an_axis_share_their_scale() {
        let scale = Scale::of(&(0.0..60_000.0));
        assert_eq!([0.0, 5e3, 2e4].map(|tick| scale.label(tick)), ["0", "5k", "20k"]);
        let scale = Scale::of(&(0.0..3e6));
        assert_eq!([5e5, 3e6].map(|tick| scale.label(tick)), ["0.5M", "3M"]);
        let scale = Scale::of(&(-1.0..1.0));
        assert_eq!([-0.5, 0.1 + 0.2, 1e-17].map(|tick| scale.label(tick)), ["−0.5", "0.3", "0"]);
        let scale = Scale::of(&(-5e-5..5e-5));
        assert_eq!(scale.label(-5e-5), "−5e−5");
    }
}
