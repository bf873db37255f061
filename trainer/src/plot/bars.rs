//! Several values for each latent, side by side.

use super::axis::{Axes, chart};
use super::theme::{Entry, INK, MUTED, Swatch, data_color, draw_error, figure, legend, units};
use super::{PlotError, PlotOptions};
use plotters::prelude::*;

/// Share of a latent's place that its bars take.
const WIDTH: f64 = 0.84;

/// Values of all latents in several series.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupedBars {
    /// Name of the vertical axis with its unit.
    pub y_name: String,
    /// Ends of the vertical axis.
    pub y: std::ops::Range<f64>,
    /// Name of each series, and its value for each latent.
    pub series: Vec<(String, Vec<f64>)>,
    /// Values to compare with, a line over each latent's bars.
    pub reference: (String, Vec<f64>),
    /// A level over all latents.
    pub level: (String, f64),
}

/// Draws the bars of every latent side by side.
///
/// # Errors
/// [`PlotError::NoData`] without a series or a latent, [`PlotError::Lengths`] where a series does not have one value per latent,
/// [`PlotError::Draw`] from the plotting library.
pub fn grouped_bars(bars: &GroupedBars, options: &PlotOptions) -> Result<String, PlotError> {
    let latents = bars.reference.1.len();
    if bars.series.is_empty() || latents == 0 {
        return Err(PlotError::NoData("no latent has a value"));
    }
    if let Some((_, values)) = bars.series.iter().find(|(_, values)| values.len() != latents) {
        return Err(PlotError::Lengths { what: "values by latent, and latents", left: values.len(), right: latents });
    }
    let mut entries: Vec<Entry> = (bars.series.iter().enumerate())
        .map(|(i, (name, _))| Entry { name: name.clone(), color: data_color(i), swatch: Swatch::Block })
        .collect();
    entries.push(Entry { name: bars.reference.0.clone(), color: INK.color(), swatch: Swatch::Line });
    entries.push(Entry { name: bars.level.0.clone(), color: MUTED.color(), swatch: Swatch::Dashed });
    let axes = Axes {
        x_name: "latent",
        y_name: &bars.y_name,
        x: -0.5..latents as f64 - 0.5,
        y: bars.y.clone(),
        whole_x: true,
        least_y_label_px: 0,
    };
    figure(options, options.height, |area| {
        let mut chart = chart(&legend(area, &entries)?, &axes)?;
        let width = WIDTH / bars.series.len() as f64;
        for (i, (_, values)) in bars.series.iter().enumerate() {
            let rectangles =
                values.iter().enumerate().filter(|(_, value)| value.is_finite()).map(|(latent, &value)| {
                    let left = latent as f64 - WIDTH / 2.0 + i as f64 * width;
                    let corners = [(left + 0.06 * width, bars.y.start), (left + 0.94 * width, value)];
                    Rectangle::new(corners, data_color(i).filled())
                });
            chart.draw_series(rectangles).map_err(draw_error)?;
        }
        let level = [(axes.x.start, bars.level.1), (axes.x.end, bars.level.1)];
        let style = MUTED.color().stroke_width(units(1));
        chart.draw_series(DashedLineSeries::new(level, units(6), units(4), style)).map_err(draw_error)?;
        let lines = bars.reference.1.iter().enumerate().map(|(latent, &value)| {
            let ends = [-0.5, 0.5].map(|side| (latent as f64 + side * (WIDTH + 0.06), value));
            PathElement::new(ends, INK.color().stroke_width(units(2)))
        });
        chart.draw_series(lines).map_err(draw_error)?;
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bars(series: &[&[f64]]) -> GroupedBars {
        GroupedBars {
            y_name: "confidence".into(),
            y: 0.0..1.0,
            series: series.iter().enumerate().map(|(i, v)| (format!("γ {i}"), v.to_vec())).collect(),
            reference: ("share in the data".into(), vec![0.7, 0.3, 0.0]),
            level: ("1/K".into(), 1.0 / 3.0),
        }
    }

    #[test]
    fn every_value_has_a_bar_and_every_latent_its_line() {
        let svg = grouped_bars(&bars(&[&[0.7, 0.2, 0.1], &[0.5, f64::NAN, 0.2]]), &PlotOptions::new("t")).unwrap();
        let content = &svg[svg.find("</style>").unwrap()..];
        let filled = |i: usize| {
            let RGBColor(r, g, b) = data_color(i);
            content.matches(&format!("fill=\"#{r:02X}{g:02X}{b:02X}\"")).count()
        };
        // One of them is in the legend.
        assert_eq!((filled(0), filled(1)), (4, 3));
        for text in ["γ 0", "γ 1", "share in the data", "1/K", "latent", "confidence"] {
            assert!(svg.contains(text), "{text}");
        }
    }

    #[test]
    fn lists_of_other_lengths_are_refused() {
        let options = PlotOptions::new("t");
        let error = grouped_bars(&bars(&[&[0.5]]), &options);
        assert!(matches!(error, Err(PlotError::Lengths { left: 1, right: 3, .. })));
        assert!(matches!(grouped_bars(&bars(&[]), &options), Err(PlotError::NoData(_))));
    }
}
