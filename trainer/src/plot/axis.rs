//! Ranges and tick labels, and the axes that all charts share.

use super::PlotError;
use super::theme::{Area, GRID, INK, LABEL_PX, MIN_CHART_PX, TICK_PX, draw_error, font, inner_px, text_width, units};
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
    /// Least room for the labels of the y axis in CSS pixels, to line up several charts; see [`Axes::y_label_px`].
    pub(super) least_y_label_px: u32,
}

/// Height of the x axis with its labels and name, in CSS pixels.
const X_LABEL_PX: u32 = 48;
/// Fewest and most ticks asked for on the y axis.
const Y_TICKS: (u32, u32) = (2, 8);

/// Draws grid, axes and labels on `area`.
pub(super) fn chart<'a>(area: &Area<'a>, axes: &Axes<'_>) -> Result<Chart<'a>, PlotError> {
    let (ink, grid) = (INK.color(), GRID.color());
    // A name longer than its axis would be cut: it goes above the chart then.
    let (width, height) = inner_px(area);
    if width < MIN_CHART_PX.0 || height < MIN_CHART_PX.1 {
        return Err(PlotError::TooSmall { width, height, needed: MIN_CHART_PX });
    }
    let upright = text_width(axes.y_name, LABEL_PX) + X_LABEL_PX <= height;
    let below = if upright {
        area.clone()
    } else {
        let (top, below) = area.split_vertically(units(LABEL_PX + 7));
        top.draw(&Text::new(axes.y_name.to_owned(), (0, 0), font(LABEL_PX, &ink))).map_err(draw_error)?;
        below
    };
    let (width, height) = below.dim_in_pixel();
    let x_ticks = (width / units(95)).clamp(2, 10) as usize;
    let y_ticks = (height / units(48)).clamp(Y_TICKS.0, Y_TICKS.1) as usize;
    let (x_scale, y_scale) = (Scale::of(&axes.x), Scale::of(&axes.y));
    let y_label_px = axes.y_label_px().max(axes.least_y_label_px);
    let mut chart = ChartBuilder::on(&below)
        .x_label_area_size(units(X_LABEL_PX))
        .y_label_area_size(units(y_label_px))
        .margin_right(units(20))
        .margin_top(units(8))
        .build_cartesian_2d(axes.x.clone(), axes.y.clone())
        .map_err(draw_error)?;
    chart
        .configure_mesh()
        .x_desc(axes.x_name)
        .y_desc(if upright { axes.y_name } else { "" })
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
    /// Room for the labels and the name of the y axis in CSS pixels, whatever the chart's height.
    pub(super) fn y_label_px(&self) -> u32 {
        let scale = Scale::of(&self.y);
        let coord = RangedCoordf64::from(self.y.clone());
        let ticks = (Y_TICKS.0..=Y_TICKS.1).flat_map(|count| coord.key_points(count as usize));
        ticks.map(|tick| text_width(&scale.label(tick), TICK_PX)).max().unwrap_or(0) + 34
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
