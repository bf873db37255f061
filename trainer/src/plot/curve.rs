//! Learning curves: evaluation return over environment steps.

use super::axis::{Axes, chart, padded};
use super::theme::{Area, Entry, Swatch, data_color, draw_error, figure, height_with_legend, legend, units};
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
    let all = || groups.iter().flat_map(|group| group.summary.iter().chain(group.members()));
    let last = all().map(|point| point.env_steps).fold(0.0, f64::max);
    let axes = Axes {
        x_name: "environment steps",
        y_name: "evaluation return (reward)",
        x: 0.0..if last > 0.0 { last } else { 1.0 },
        y: padded(all().flat_map(|point| [point.mean - point.sd, point.mean + point.sd]), 0.05),
        whole_x: true,
        least_y_label_px: 0,
    };
    let entries: Vec<Entry> = groups
        .iter()
        .enumerate()
        .map(|(i, group)| Entry { name: group.name(), color: data_color(i), swatch: Swatch::Band })
        .collect();
    let height = height_with_legend(&entries, options);
    figure(options, height, |area| draw(area, &groups, &entries, &axes))
}

fn draw(area: &Area<'_>, groups: &[Group<'_>], entries: &[Entry], axes: &Axes<'_>) -> Result<(), PlotError> {
    let below = legend(area, entries)?;
    let mut chart = chart(&below, axes)?;
    // Bands first, so that no line lies under another group's band.
    for (i, group) in groups.iter().enumerate() {
        let upper = group.summary.iter().map(|point| (point.env_steps, point.mean + point.sd));
        let lower = group.summary.iter().rev().map(|point| (point.env_steps, point.mean - point.sd));
        let band = Polygon::new(upper.chain(lower).collect::<Vec<_>>(), data_color(i).mix(0.2));
        chart.draw_series([band]).map_err(draw_error)?;
    }
    for (i, group) in groups.iter().enumerate() {
        let color = data_color(i);
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
