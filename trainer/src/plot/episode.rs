//! Observations and actions of one episode over time.

use super::axis::{Axes, chart, padded};
use super::theme::{Area, Entry, Swatch, data_color, draw_error, figure, legend, units};
use super::{PlotError, PlotOptions};
use plotters::prelude::*;

/// One signal of an episode, a value per control period.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Values from the start of the episode; gaps are not finite.
    pub values: Vec<f64>,
}

/// Signals that share an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// Name of the y axis with its unit, such as `force (N)`.
    pub y_name: String,
    /// The signals.
    pub series: Vec<Series>,
}

/// Draws `panels` below one another over the time of an episode. `period_s` is the control period in seconds and
/// [`PlotOptions::height`] the height of one panel.
///
/// # Errors
/// [`PlotError::NoData`] if there is no value, [`PlotError::Draw`] from the plotting library.
pub fn episode(panels: &[Panel], period_s: f64, options: &PlotOptions) -> Result<String, PlotError> {
    let longest = panels.iter().flat_map(|panel| &panel.series).map(|series| series.values.len()).max().unwrap_or(0);
    if longest == 0 {
        return Err(PlotError::NoData("no signal holds a value"));
    }
    let end_s = period_s * (longest.max(2) - 1) as f64;
    let mut axes: Vec<Axes<'_>> = panels
        .iter()
        .map(|panel| Axes {
            x_name: "time (s)",
            y_name: &panel.y_name,
            x: 0.0..end_s,
            y: padded(panel.series.iter().flat_map(|series| series.values.iter().copied()), 0.05),
            whole_x: false,
            least_y_label_px: 0,
        })
        .collect();
    let widest = axes.iter().map(Axes::y_label_px).max().unwrap_or(0);
    for axes in &mut axes {
        axes.least_y_label_px = widest;
    }
    figure(options, options.height * panels.len() as u32, |area| {
        for ((panel, axes), place) in panels.iter().zip(&axes).zip(area.split_evenly((panels.len(), 1))) {
            draw(&place.margin(units(6), 0, 0, 0), panel, axes, period_s)?;
        }
        Ok(())
    })
}

fn draw(area: &Area<'_>, panel: &Panel, axes: &Axes<'_>, period_s: f64) -> Result<(), PlotError> {
    let entries: Vec<Entry> = panel
        .series
        .iter()
        .enumerate()
        .map(|(i, series)| Entry { name: series.name.clone(), color: data_color(i), swatch: Swatch::Line })
        .collect();
    let below = legend(area, &entries)?;
    let mut chart = chart(&below, axes)?;
    for (i, series) in panel.series.iter().enumerate() {
        let style = data_color(i).stroke_width(units(3) / 2);
        for stretch in finite_stretches(&series.values) {
            let points = stretch.map(|t| (period_s * t as f64, series.values[t]));
            chart.draw_series(LineSeries::new(points, style)).map_err(draw_error)?;
        }
    }
    Ok(())
}

/// Index ranges of consecutive finite values.
fn finite_stretches(values: &[f64]) -> Vec<std::ops::Range<usize>> {
    let mut stretches: Vec<std::ops::Range<usize>> = Vec::new();
    for (t, _) in values.iter().enumerate().filter(|(_, value)| value.is_finite()) {
        match stretches.last_mut() {
            Some(stretch) if stretch.end == t => stretch.end = t + 1,
            _ => stretches.push(t..t + 1),
        }
    }
    stretches
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_part_a_line() {
        assert_eq!(finite_stretches(&[1.0, 2.0, f64::NAN, 3.0]), [0..2, 3..4]);
        assert!(finite_stretches(&[f64::NAN]).is_empty());
    }

    #[test]
    fn every_panel_has_its_axis_and_legend() {
        let panel = |y_name: &str, name: &str| Panel {
            y_name: y_name.into(),
            series: vec![Series { name: name.into(), values: vec![0.0, 1.0, f64::NAN, 0.5] }],
        };
        let panels = [panel("angle (rad)", "pole"), panel("force (N)", "cart")];
        let svg = episode(&panels, 0.04, &PlotOptions::new("Episode").with_size(720, 200)).unwrap();
        for text in ["angle (rad)", "force (N)", "pole", "cart", "time (s)", "height=\"400\""] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(matches!(episode(&[], 0.04, &PlotOptions::new("")), Err(PlotError::NoData(_))));
    }
}
