//! One number per latent, such as Q-values and confidences at one step.

use super::axis::{Axes, chart, padded};
use super::theme::{Area, Entry, MUTED, Swatch, data_color, draw_error, figure, legend, units};
use super::{PlotError, PlotOptions};
use plotters::prelude::*;

/// Values of all latents that share an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct LatentPanel {
    /// Name of the axis with its unit.
    pub y_name: String,
    /// One per latent.
    pub values: Vec<f64>,
    /// A level to compare with, with its name.
    pub level: Option<(f64, String)>,
}

/// Draws `panels` below one another: a point per latent, told apart by whether it is allowed, masked, or chosen.
/// [`PlotOptions::height`] is the height of one panel.
///
/// # Errors
/// [`PlotError::NoData`] without a value, [`PlotError::Lengths`] where a panel does not have one value per latent,
/// [`PlotError::Draw`] from the plotting library.
pub fn by_latent(
    panels: &[LatentPanel],
    allowed: &[bool],
    chosen: usize,
    options: &PlotOptions,
) -> Result<String, PlotError> {
    if panels.is_empty() || allowed.is_empty() {
        return Err(PlotError::NoData("no latent has a value"));
    }
    if let Some(panel) = panels.iter().find(|panel| panel.values.len() != allowed.len()) {
        let (left, right) = (panel.values.len(), allowed.len());
        return Err(PlotError::Lengths { what: "values by latent, and latents", left, right });
    }
    figure(options, options.height * panels.len() as u32, |area| {
        for (panel, place) in panels.iter().zip(area.split_evenly((panels.len(), 1))) {
            draw(&place.margin(units(6), 0, 0, 0), panel, allowed, chosen)?;
        }
        Ok(())
    })
}

fn draw(area: &Area<'_>, panel: &LatentPanel, allowed: &[bool], chosen: usize) -> Result<(), PlotError> {
    let entry = |name: &str, color, swatch| Entry { name: name.to_owned(), color, swatch };
    let mut entries = vec![
        entry("chosen", data_color(1), Swatch::Block),
        entry("allowed", data_color(0), Swatch::Block),
        entry("masked", MUTED.color(), Swatch::Block),
    ];
    if let Some((_, name)) = &panel.level {
        entries.push(entry(name, MUTED.color(), Swatch::Dashed));
    }
    let below = legend(area, &entries)?;
    let level = panel.level.as_ref().map(|(level, _)| *level);
    let y = padded(panel.values.iter().copied().chain(level), 0.08);
    let x = -0.6..allowed.len() as f64 - 0.4;
    let axes = Axes {
        x_name: "latent",
        y_name: &panel.y_name,
        x: x.clone(),
        y: y.clone(),
        whole_x: true,
        least_y_label_px: 0,
    };
    let mut chart = chart(&below, &axes)?;
    if let Some(level) = level {
        let style = MUTED.color().stroke_width(units(1));
        chart
            .draw_series(DashedLineSeries::new([(x.start, level), (x.end, level)], units(6), units(4), style))
            .map_err(draw_error)?;
    }
    let color = |latent: usize| match (latent == chosen, allowed[latent]) {
        (true, _) => data_color(1),
        (false, true) => data_color(0),
        (false, false) => MUTED.color(),
    };
    let finite = || panel.values.iter().copied().enumerate().filter(|(_, value)| value.is_finite());
    let stems = finite().map(|(latent, value)| {
        let at = latent as f64;
        PathElement::new(vec![(at, y.start), (at, value)], color(latent).mix(0.4).stroke_width(units(1)))
    });
    chart.draw_series(stems).map_err(draw_error)?;
    let points =
        finite().map(|(latent, value)| Circle::new((latent as f64, value), units(4) as i32, color(latent).filled()));
    chart.draw_series(points).map_err(draw_error)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(values: &[f64]) -> LatentPanel {
        LatentPanel { y_name: "confidence".into(), values: values.to_vec(), level: Some((0.25, "threshold".into())) }
    }

    #[test]
    fn every_latent_has_a_point() {
        let values = [0.5, 0.2, f64::NAN, 0.3];
        let svg = by_latent(&[panel(&values)], &[true, false, false, true], 0, &PlotOptions::new("t")).unwrap();
        assert_eq!(svg.matches("<circle").count(), 3);
        for text in ["confidence", "threshold", "chosen", "masked", "latent"] {
            assert!(svg.contains(text), "{text}");
        }
    }

    #[test]
    fn lists_of_other_lengths_are_refused() {
        let options = PlotOptions::new("t");
        let error = by_latent(&[panel(&[0.0])], &[true, true], 0, &options);
        assert!(matches!(error, Err(PlotError::Lengths { left: 1, right: 2, .. })));
        assert!(matches!(by_latent(&[], &[true], 0, &options), Err(PlotError::NoData(_))));
    }
}
