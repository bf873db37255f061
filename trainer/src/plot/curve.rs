//! Learning curves: evaluation return over environment steps.

use super::axis::{Axes, chart, padded};
use super::theme::{
    Area, Entry, INK, LABEL_PX, MUTED, Swatch, data_color, draw_error, figure, font, height_with_legend, legend, units,
};
use super::{PlotError, PlotOptions};
use crate::metrics::jsonl::METRICS_FILE;
use crate::metrics::{keys, read_jsonl};
use plotters::prelude::*;
use std::path::Path;

/// One evaluation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CurvePoint {
    /// Environment steps taken before it.
    pub env_steps: f64,
    /// Mean return of its episodes.
    pub mean: f64,
    /// Standard deviation of the return over its episodes; 0 if unknown.
    pub sd: f64,
}

/// The evaluations of one run in the order of their steps.
#[derive(Debug, Clone, PartialEq)]
pub struct RunCurve {
    /// Environment and algorithm. Runs with the same label are seeds of the same experiment and drawn as one.
    pub label: String,
    /// The evaluations.
    pub points: Vec<CurvePoint>,
}

/// Reads the evaluations of the run in `run_dir`.
///
/// # Errors
/// [`PlotError::NoEvaluation`] if there are none yet, [`PlotError::Metrics`] if the file cannot be read.
pub fn read_run(run_dir: &Path, label: impl Into<String>) -> Result<RunCurve, PlotError> {
    let path = run_dir.join(METRICS_FILE);
    let points: Vec<CurvePoint> = read_jsonl(&path)?
        .into_iter()
        .filter_map(|(step, values)| {
            let mean = *values.get(keys::EVAL_RETURN_MEAN)?;
            let sd = values.get(keys::EVAL_RETURN_SD).copied().filter(|sd| sd.is_finite()).unwrap_or(0.0);
            mean.is_finite().then_some(CurvePoint { env_steps: step as f64, mean, sd })
        })
        .collect();
    if points.is_empty() {
        return Err(PlotError::NoEvaluation { path, key: keys::EVAL_RETURN_MEAN });
    }
    Ok(RunCurve { label: label.into(), points })
}

/// Draws the mean evaluation return over environment steps.
///
/// A label with one run gets its curve and a band of one standard deviation over the episodes of each evaluation. A label
/// with several runs gets the mean over the runs, a band of one standard deviation over the runs, and every run as a
/// thin line; where runs were evaluated at different steps they are interpolated linearly between them, over the steps
/// that all of them cover. The figure grows with its legend.
///
/// # Errors
/// [`PlotError::NoData`] without any evaluation, [`PlotError::Draw`] from the plotting library.
pub fn learning_curve(runs: &[RunCurve], options: &PlotOptions) -> Result<String, PlotError> {
    let groups = group(runs);
    if groups.is_empty() {
        return Err(PlotError::NoData("no run holds an evaluation"));
    }
    let axes = axes(&groups, RETURN);
    let entries: Vec<Entry> = groups
        .iter()
        .enumerate()
        .map(|(i, group)| Entry { name: group.name(), color: data_color(i), swatch: Swatch::Band })
        .collect();
    let height = height_with_legend(&entries, options);
    figure(options, height, |area| draw(area, &groups, &entries, &axes))
}

/// Name of the vertical axis of returns.
pub const RETURN: &str = "evaluation return (reward)";

/// Axes that hold `groups`.
fn axes<'a>(groups: &[Group<'_>], y_name: &'a str) -> Axes<'a> {
    let all = || groups.iter().flat_map(|group| group.summary.iter().chain(group.members()));
    let last = all().map(|point| point.env_steps).fold(0.0, f64::max);
    Axes {
        x_name: "environment steps",
        y_name,
        x: 0.0..if last > 0.0 { last } else { 1.0 },
        y: padded(all().flat_map(|point| [point.mean - point.sd, point.mean + point.sd]), 0.05),
        whole_x: true,
        least_y_label_px: 0,
    }
}

/// One chart of several that share a legend.
#[derive(Debug, Clone, PartialEq)]
pub struct CurvePanel {
    /// Text above the chart.
    pub title: String,
    /// Name of its vertical axis with the unit, such as [`RETURN`].
    pub y_name: &'static str,
    /// The runs; [`RunCurve::label`] is one of the legend's names.
    pub runs: Vec<RunCurve>,
}

/// Draws charts side by side, three in a row at most, under one legend of `names`, in whose order the colours are given. A label
/// with several runs is drawn as by [`learning_curve`]; a single run is a line without a band, for one seed has no deviation over
/// seeds. Panels without a run are empty charts with a word about it. The size in `options` is that of a panel.
///
/// # Errors
/// [`PlotError::NoData`] where no panel holds a run, [`PlotError::Draw`] from the plotting library.
pub fn learning_curves(panels: &[CurvePanel], names: &[&str], options: &PlotOptions) -> Result<String, PlotError> {
    if panels.iter().all(|panel| panel.runs.is_empty()) {
        return Err(PlotError::NoData("no run holds an evaluation"));
    }
    let columns = match panels.len() {
        n @ 0..=3 => n,
        4 => 2,
        _ => 3,
    };
    let rows = panels.len().div_ceil(columns);
    let entry =
        |(i, name): (usize, &&str)| Entry { name: (*name).to_owned(), color: data_color(i), swatch: Swatch::Band };
    let entries: Vec<Entry> = names.iter().enumerate().map(entry).collect();
    let whole = options.clone().with_size(options.width * columns as u32, options.height * rows as u32);
    figure(&whole, height_with_legend(&entries, &whole), |area| {
        let below = legend(area, &entries)?;
        for (panel, area) in panels.iter().zip(below.split_evenly((rows, columns))) {
            let (top, chart_area) = area.split_vertically(units(LABEL_PX + 10));
            top.draw(&Text::new(panel.title.clone(), (units(8) as i32, 0), font(LABEL_PX, &INK.color())))
                .map_err(draw_error)?;
            let mut groups = group(&panel.runs);
            groups.iter_mut().filter(|group| group.runs.len() == 1).for_each(Group::drop_band);
            if groups.is_empty() {
                let (at, muted) = ((units(8) as i32, units(8) as i32), MUTED.color());
                chart_area.draw(&Text::new("no runs yet", at, font(LABEL_PX, &muted))).map_err(draw_error)?;
                continue;
            }
            let color = |group: &Group<'_>| {
                data_color(names.iter().position(|name| *name == group.runs[0].label).unwrap_or(names.len()))
            };
            let colors: Vec<RGBColor> = groups.iter().map(color).collect();
            draw_groups(&chart_area, &groups, &colors, &axes(&groups, panel.y_name))?;
        }
        Ok(())
    })
}

fn draw(area: &Area<'_>, groups: &[Group<'_>], entries: &[Entry], axes: &Axes<'_>) -> Result<(), PlotError> {
    let below = legend(area, entries)?;
    let colors: Vec<RGBColor> = entries.iter().map(|entry| entry.color).collect();
    draw_groups(&below, groups, &colors, axes)
}

/// Draws `groups` in these colours on axes.
fn draw_groups(area: &Area<'_>, groups: &[Group<'_>], colors: &[RGBColor], axes: &Axes<'_>) -> Result<(), PlotError> {
    let mut chart = chart(area, axes)?;
    // Bands first, so that no line lies under another group's band.
    for (group, color) in groups.iter().zip(colors) {
        let upper = group.summary.iter().map(|point| (point.env_steps, point.mean + point.sd));
        let lower = group.summary.iter().rev().map(|point| (point.env_steps, point.mean - point.sd));
        let band = Polygon::new(upper.chain(lower).collect::<Vec<_>>(), color.mix(0.2));
        chart.draw_series([band]).map_err(draw_error)?;
    }
    for (group, color) in groups.iter().zip(colors) {
        let line = |points: &[CurvePoint]| points.iter().map(|point| (point.env_steps, point.mean)).collect::<Vec<_>>();
        if group.runs.len() > 1 {
            for run in &group.runs {
                let style = color.mix(0.5).stroke_width(units(1));
                chart.draw_series(LineSeries::new(line(&run.points), style)).map_err(draw_error)?;
            }
        }
        let style = color.stroke_width(units(2));
        chart.draw_series(LineSeries::new(line(&group.summary), style)).map_err(draw_error)?;
        // A curve of few points is not visible as a line alone.
        if group.summary.len() <= 30 {
            let dots = group.summary.iter().map(|point| {
                let at = (point.env_steps, point.mean);
                Circle::new(at, units(3) as i32, color.filled())
            });
            chart.draw_series(dots).map_err(draw_error)?;
        }
    }
    Ok(())
}

/// Runs with the same label.
struct Group<'a> {
    runs: Vec<&'a RunCurve>,
    /// What is drawn thick: the only run, or mean and standard deviation over the runs.
    summary: Vec<CurvePoint>,
}

impl Group<'_> {
    /// Points of the thin lines, without a band of their own.
    fn members(&self) -> impl Iterator<Item = &CurvePoint> {
        let thin = if self.runs.len() > 1 { &self.runs[..] } else { &[] };
        thin.iter().flat_map(|run| &run.points)
    }

    /// Leaves the line and takes the spread over episodes from it.
    fn drop_band(&mut self) {
        self.summary.iter_mut().for_each(|point| point.sd = 0.0);
    }

    fn name(&self) -> String {
        let label = &self.runs[0].label;
        match self.runs.len() {
            1 => format!("{label}, mean ± sd over episodes"),
            n => format!("{label}, mean ± sd over {n} seeds"),
        }
    }
}

fn group(runs: &[RunCurve]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group> = Vec::new();
    for run in runs.iter().filter(|run| !run.points.is_empty()) {
        match groups.iter_mut().find(|group| group.runs[0].label == run.label) {
            Some(group) => group.runs.push(run),
            None => groups.push(Group { runs: vec![run], summary: Vec::new() }),
        }
    }
    for group in &mut groups {
        group.summary = if group.runs.len() == 1 { group.runs[0].points.clone() } else { over_runs(&group.runs) };
    }
    groups
}

/// Mean and sample standard deviation over `runs` at every step that one of them was evaluated at and all of them cover.
fn over_runs(runs: &[&RunCurve]) -> Vec<CurvePoint> {
    let first = runs.iter().map(|run| run.points[0].env_steps).fold(f64::NEG_INFINITY, f64::max);
    let last = runs.iter().map(|run| run.points[run.points.len() - 1].env_steps).fold(f64::INFINITY, f64::min);
    let mut steps: Vec<f64> = runs.iter().flat_map(|run| &run.points).map(|point| point.env_steps).collect();
    steps.retain(|step| (first..=last).contains(step));
    steps.sort_by(f64::total_cmp);
    steps.dedup();
    let n = runs.len() as f64;
    steps
        .into_iter()
        .map(|env_steps| {
            let values: Vec<f64> = runs.iter().map(|run| interpolate(&run.points, env_steps)).collect();
            let mean = values.iter().sum::<f64>() / n;
            let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
            CurvePoint { env_steps, mean, sd: (squares / (n - 1.0)).sqrt() }
        })
        .collect()
}

/// The mean at `env_steps`, which lies between the first and the last point.
fn interpolate(points: &[CurvePoint], env_steps: f64) -> f64 {
    let after = points.partition_point(|point| point.env_steps < env_steps).min(points.len() - 1);
    let (b, a) = (points[after], points[after.saturating_sub(1)]);
    if b.env_steps <= env_steps || b.env_steps <= a.env_steps {
        return b.mean;
    }
    a.mean + (b.mean - a.mean) * (env_steps - a.env_steps) / (b.env_steps - a.env_steps)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::{JsonlSink, Record};

    fn run(label: &str, points: &[(f64, f64)]) -> RunCurve {
        let points = points.iter().map(|&(env_steps, mean)| CurvePoint { env_steps, mean, sd: 1.0 }).collect();
        RunCurve { label: label.into(), points }
    }

    #[test]
    fn seeds_of_a_label_become_mean_and_sd() {
        let runs =
            [run("a", &[(0.0, 0.0), (10.0, 10.0)]), run("a", &[(0.0, 2.0), (5.0, 7.0), (10.0, 12.0), (20.0, 0.0)])];
        let groups = group(&runs);
        assert_eq!(groups.len(), 1);
        let steps: Vec<f64> = groups[0].summary.iter().map(|point| point.env_steps).collect();
        let means: Vec<f64> = groups[0].summary.iter().map(|point| point.mean).collect();
        assert_eq!(steps, [0.0, 5.0, 10.0]);
        assert_eq!(means, [1.0, 6.0, 11.0]);
        assert!(groups[0].summary.iter().all(|point| (point.sd - 2f64.sqrt()).abs() < 1e-12));
        assert_eq!(groups[0].name(), "a, mean ± sd over 2 seeds");
    }

    #[test]
    fn a_single_run_keeps_its_own_band() {
        let runs = [run("a", &[(0.0, 5.0)]), run("b", &[(0.0, 6.0)])];
        let groups = group(&runs);
        assert_eq!(groups.len(), 2);
        assert_eq!(groups[1].summary, runs[1].points);
    }

    #[test]
    fn seeds_without_common_steps_are_still_drawn() {
        let runs = [run("a", &[(0.0, 0.0), (1.0, 1.0)]), run("a", &[(5.0, 0.0), (6.0, 1.0)])];
        assert!(group(&runs)[0].summary.is_empty());
        learning_curve(&runs, &PlotOptions::new("t")).unwrap();
    }

    #[test]
    fn the_figure_names_axes_and_runs() {
        let runs = [run("moving <dqn>", &[(0.0, -1.0), (50_000.0, 1.9)])];
        let svg = learning_curve(&runs, &PlotOptions::new("Return")).unwrap();
        for text in ["environment steps", "evaluation return", "moving &lt;dqn&gt;", "50k", "<polygon", "</svg>"] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(matches!(learning_curve(&[], &PlotOptions::new("")), Err(PlotError::NoData(_))));
    }

    #[test]
    fn panels_share_a_legend_and_keep_the_colour_of_a_name() {
        let panel =
            |title: &str, runs: &[RunCurve]| CurvePanel { title: title.into(), y_name: RETURN, runs: runs.to_vec() };
        let panels = [
            panel("Moving", &[run("a", &[(0.0, 0.0), (9.0, 1.0)]), run("b", &[(0.0, 0.0), (9.0, 2.0)])]),
            panel("Sliding", &[run("b", &[(0.0, 0.0), (9.0, 2.0)]), run("b", &[(0.0, 1.0), (9.0, 4.0)])]),
            panel("HardMove", &[]),
        ];
        let svg = learning_curves(&panels, &["a", "b"], &PlotOptions::new("Figure").with_size(340, 300)).unwrap();
        for text in ["Moving", "Sliding", "HardMove", "no runs yet", "width=\"1020\""] {
            assert!(svg.contains(text), "{text}");
        }
        let content = &svg[svg.find("</style>").unwrap()..];
        let lines = |i: usize| {
            let RGBColor(r, g, b) = data_color(i);
            content.matches(&format!("<polyline fill=\"none\" opacity=\"1\" stroke=\"#{r:02X}{g:02X}{b:02X}\"")).count()
        };
        // A line in the legend, and one where a panel has the name.
        assert_eq!((lines(0), lines(1)), (2, 3), "{content}");
        assert!(matches!(learning_curves(&panels[2..], &["a"], &PlotOptions::new("")), Err(PlotError::NoData(_))));
    }

    #[test]
    fn evaluations_are_read_from_a_run_folder() {
        let folder = tempfile::tempdir().unwrap();
        let mut sink = JsonlSink::create(folder.path()).unwrap();
        sink.write(&Record::new(5).with(keys::Q_LOSS, 1.0)).unwrap();
        assert!(matches!(read_run(folder.path(), "a"), Err(PlotError::NoEvaluation { .. })));
        sink.write(&Record::new(10).with(keys::EVAL_RETURN_MEAN, 3.0).with(keys::EVAL_RETURN_SD, 0.5)).unwrap();
        sink.write(&Record::new(20).with(keys::EVAL_RETURN_MEAN, f64::NAN)).unwrap();
        let curve = read_run(folder.path(), "a").unwrap();
        assert_eq!(curve.points, [CurvePoint { env_steps: 10.0, mean: 3.0, sd: 0.5 }]);
    }
}
