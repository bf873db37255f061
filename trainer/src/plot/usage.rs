//! Latent usage: how often each latent was chosen.

use super::axis::{Axes, chart};
use super::theme::{Entry, MUTED, Swatch, data_color, draw_error, figure, legend, units};
use super::{PlotError, PlotOptions};
use plotters::prelude::*;

/// Draws the share of decisions of every latent as bars, with uniform use for comparison. `counts[k]` is how often latent
/// `k` was chosen.
///
/// # Errors
/// [`PlotError::NoData`] if nothing was counted, [`PlotError::Draw`] from the plotting library.
pub fn latent_usage(counts: &[u64], options: &PlotOptions) -> Result<String, PlotError> {
    let total: u64 = counts.iter().sum();
    if total == 0 {
        return Err(PlotError::NoData("no decision was counted"));
    }
    let share = |count: u64| 100.0 * count as f64 / total as f64;
    let used = counts.iter().filter(|&&count| count > 0).count();
    let uniform = 100.0 / counts.len() as f64;
    let highest = counts.iter().map(|&count| share(count)).fold(uniform, f64::max);
    let axes = Axes {
        x_name: "latent",
        y_name: "share of decisions (%)",
        x: -0.6..counts.len() as f64 - 0.4,
        y: 0.0..highest * 1.05,
        whole_x: true,
        least_y_label_px: 0,
    };
    figure(options, options.height, |area| {
        let bars = format!("{used} of {} latents in use", counts.len());
        let entries = [
            Entry { name: bars, color: data_color(0), swatch: Swatch::Block },
            Entry { name: "uniform use".to_owned(), color: MUTED.color(), swatch: Swatch::Dashed },
        ];
        let below = legend(area, &entries)?;
        let mut chart = chart(&below, &axes)?;
        let rectangles = counts.iter().enumerate().map(|(k, &count)| {
            let k = k as f64;
            Rectangle::new([(k - 0.4, 0.0), (k + 0.4, share(count))], data_color(0).filled())
        });
        chart.draw_series(rectangles).map_err(draw_error)?;
        let level = [(axes.x.start, uniform), (axes.x.end, uniform)];
        let style = MUTED.color().stroke_width(units(1));
        chart.draw_series(DashedLineSeries::new(level, units(6), units(4), style)).map_err(draw_error)?;
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_used_latents() {
        let svg = latent_usage(&[5, 0, 3, 2], &PlotOptions::new("Usage")).unwrap();
        assert!(svg.contains("3 of 4 latents in use") && svg.contains("share of decisions (%)"), "{svg}");
        assert!(matches!(latent_usage(&[0, 0], &PlotOptions::new("")), Err(PlotError::NoData(_))));
        assert!(matches!(latent_usage(&[], &PlotOptions::new("")), Err(PlotError::NoData(_))));
    }
}
