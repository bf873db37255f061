//! The table of a figure: a row for each environment and variant, the numbers of every seed behind it, and what made them.
//!
//! The return of a run is the mean over the episodes of its last evaluation (specification 8.5); the best evaluation and the
//! mean of the last five stand beside it. Only runs with all their steps count, unless the caller asks for the others too.

use std::fmt::Write as _;

use serde::Serialize;

use super::PaperError;
use super::columns::Columns;
use super::figure::Figure;
use super::plan::{Plan, PlannedRun};
use super::state::{State, Status};
use super::stats::{COVERAGE, Interval, REPLICATES, Summary, mean};
use crate::metrics::jsonl::{METRICS_FILE, read_jsonl};
use crate::metrics::keys;
use crate::plot::{CurvePoint, RunCurve};
use crate::runner::progress::duration;

/// Evaluations behind the smoothed return.
const LAST: usize = 5;

/// One run behind a row.
#[derive(Clone, Debug, Serialize)]
pub struct SeedResult {
    /// Its seed.
    pub seed: u64,
    /// Its folder's name below `runs`.
    pub run: String,
    /// Environment steps of its last evaluation that counts.
    pub env_steps: u64,
    /// Mean return of that evaluation.
    pub final_return: f64,
    /// Standard deviation over its episodes.
    pub final_sd_over_episodes: f64,
    /// Mean return of the last five evaluations.
    pub last_five: f64,
    /// Mean return of the best evaluation.
    pub best_return: f64,
    /// Share of its last evaluation's episodes that ended in the goal, where the environment has one.
    pub success_rate: Option<f64>,
    /// Wall-clock time of the training, s.
    pub wall_s: f64,
    /// Commit that it was started with.
    pub commit: Option<String>,
    /// Its evaluations, for the drawing.
    #[serde(skip)]
    pub points: Vec<CurvePoint>,
}

/// A row.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Environment id; `all` for a row over all of them.
    pub env: String,
    /// Variant.
    pub variant: &'static str,
    /// Its name in the legend.
    pub label: &'static str,
    /// Runs that were planned.
    pub planned: usize,
    /// Statistics of the final returns; none without a run.
    pub final_return: Option<Summary>,
    /// Mean of the best returns.
    pub best_return: Option<f64>,
    /// Mean of the success rates.
    pub success_rate: Option<f64>,
    /// Mean wall-clock time of a run, s.
    pub wall_s: Option<f64>,
    /// The runs.
    pub seeds: Vec<SeedResult>,
}

/// All of it.
#[derive(Clone, Debug, Serialize)]
pub struct Results {
    /// Version of this layout.
    pub version: u32,
    /// The figure.
    pub figure: &'static str,
    /// Its heading.
    pub title: &'static str,
    /// Environment steps of a run.
    pub steps: u64,
    /// Whether runs that are not done count too.
    pub partial: bool,
    /// Coverage of the intervals.
    pub coverage: f64,
    /// Replicates of the bootstrap.
    pub replicates: usize,
    /// The rows.
    pub rows: Vec<Row>,
    /// What else the figure shows.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tables: Vec<Columns>,
}

impl Results {
    /// Reads the runs of `plan`; `statuses` are those of [`super::state::survey`].
    ///
    /// # Errors
    /// [`PaperError::Plot`] for metrics that cannot be read.
    pub fn read(plan: &Plan, statuses: &[Status], partial: bool) -> Result<Self, PaperError> {
        let figure = plan.figure;
        let shown: Vec<_> = plan.runs.iter().zip(statuses).filter(|(run, _)| run.shown).collect();
        // An expert may train for longer than the others.
        let steps = shown.iter().map(|(run, _)| run.steps).min().unwrap_or(0);
        let mut rows = Vec::new();
        for task in figure.tasks {
            for variant in figure.variants {
                let own = |run: &PlannedRun| run.task.env == task.env && run.variant.id == variant.id;
                let of: Vec<_> = shown.iter().filter(|(run, _)| own(run)).collect();
                let counts = |s: &Status| s.state == State::Done || partial && s.state == State::Partial;
                let mut seeds = Vec::new();
                for (run, status) in of.iter().filter(|(_, status)| counts(status)) {
                    seeds.extend(result(run, status, steps)?);
                }
                if !of.is_empty() {
                    let strata = [seeds.iter().map(|seed| seed.final_return).collect()];
                    rows.push(row(task.env, (variant.id, variant.label), of.len(), &strata, seeds));
                }
            }
        }
        if figure.one_scale {
            let over_all = figure.variants.iter().filter_map(|variant| over_all_tasks(figure, variant.id, &rows));
            let over_all: Vec<Row> = over_all.collect();
            rows.extend(over_all);
        }
        let (version, coverage, replicates) = (1, COVERAGE, REPLICATES);
        let tables = Vec::new();
        Ok(Self { version, figure: figure.id, title: figure.title, steps, partial, coverage, replicates, rows, tables })
    }

    /// For people.
    pub fn to_markdown(&self) -> String {
        let mut text = format!("# {}: {}\n\n", self.figure, self.title);
        if !self.rows.is_empty() {
            self.returns_to_markdown(&mut text);
        }
        for (i, table) in self.tables.iter().enumerate() {
            text.push_str(if i == 0 && self.rows.is_empty() { "" } else { "\n" });
            text.push_str(&table.to_markdown());
        }
        text
    }

    fn returns_to_markdown(&self, text: &mut String) {
        // Writing into a `String` cannot fail.
        let _ = writeln!(
            text,
            "{} environment steps a run. Return: mean over the episodes of the last evaluation; ± is the standard deviation over \
             seeds; IQM is the interquartile mean with a {:.0} % stratified bootstrap interval ({} replicates).{}\n",
            grouped(self.steps),
            100.0 * self.coverage,
            grouped(self.replicates as u64),
            if self.partial { " Runs that are not done count with their last evaluation." } else { "" },
        );
        text.push_str("| environment | algorithm | seeds | n | return | IQM | best evaluation | in the goal | wall time a run | commit |\n");
        text.push_str("| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |\n");
        for row in &self.rows {
            let _ = writeln!(text, "| {} |", row.cells().join(" | "));
        }
    }

    /// For spreadsheets: one line for each run.
    pub fn to_csv(&self) -> String {
        let mut text =
            "env,variant,seed,env_steps,final_return,last_five,best_return,success_rate,wall_s,commit\n".to_owned();
        for row in self.rows.iter().filter(|row| row.env != ALL) {
            for s in &row.seeds {
                let success = s.success_rate.map_or_else(String::new, |rate| rate.to_string());
                let _ = writeln!(
                    text,
                    "{},{},{},{},{},{},{},{success},{:.1},{}",
                    row.env,
                    row.variant,
                    s.seed,
                    s.env_steps,
                    s.final_return,
                    s.last_five,
                    s.best_return,
                    s.wall_s,
                    s.commit.as_deref().unwrap_or("")
                );
            }
        }
        text
    }

    /// Curves of an environment.
    pub fn curves(&self, env: &str) -> Vec<RunCurve> {
        let rows = self.rows.iter().filter(|row| row.env == env);
        rows.flat_map(|row| {
            row.seeds.iter().map(|s| RunCurve { label: row.label.to_owned(), points: s.points.clone() })
        })
        .collect()
    }
}

/// Environment of a row over all of them.
const ALL: &str = "all";

impl Row {
    fn cells(&self) -> Vec<String> {
        let none = || "–".to_owned();
        let seeds: Vec<String> = self.seeds.iter().map(|seed| seed.seed.to_string()).collect();
        let mut commits: Vec<&str> = self.seeds.iter().filter_map(|seed| seed.commit.as_deref()).collect();
        commits.sort_unstable();
        commits.dedup();
        let n = self.final_return.map_or(0, |summary| summary.n);
        let returns = self.final_return.map_or_else(none, |s| match s.sd {
            Some(sd) => format!("{} ± {}", short(s.mean), short(sd)),
            None => short(s.mean),
        });
        let iqm = self.final_return.map_or_else(none, |s| match s.iqm_interval {
            Some(Interval { low, high }) => format!("{} [{}, {}]", short(s.iqm), short(low), short(high)),
            None => short(s.iqm),
        });
        vec![
            self.env.clone(),
            self.label.to_owned(),
            if self.env == ALL || seeds.is_empty() { none() } else { seeds.join(", ") },
            if n == self.planned { n.to_string() } else { format!("{n} of {}", self.planned) },
            returns,
            iqm,
            self.best_return.map_or_else(none, short),
            self.success_rate.map_or_else(none, |rate| format!("{:.0} %", 100.0 * rate)),
            self.wall_s.map_or_else(none, duration),
            if commits.is_empty() { none() } else { format!("`{}`", commits.join("`, `")) },
        ]
    }
}

fn row(
    env: &str,
    (variant, label): (&'static str, &'static str),
    planned: usize,
    strata: &[Vec<f64>],
    seeds: Vec<SeedResult>,
) -> Row {
    let over = |value: &dyn Fn(&SeedResult) -> f64| mean(&seeds.iter().map(value).collect::<Vec<_>>());
    let successes: Vec<f64> = seeds.iter().filter_map(|seed| seed.success_rate).collect();
    Row {
        env: env.to_owned(),
        variant,
        label,
        planned,
        final_return: Summary::of(strata),
        best_return: over(&|seed| seed.best_return),
        success_rate: mean(&successes),
        wall_s: over(&|seed| seed.wall_s),
        seeds,
    }
}

/// A variant over all environments, each a stratum; `None` unless every one of them has a run.
fn over_all_tasks(figure: &Figure, variant: &str, rows: &[Row]) -> Option<Row> {
    let own: Vec<&Row> = rows.iter().filter(|row| row.variant == variant && !row.seeds.is_empty()).collect();
    let first = own.first().filter(|_| own.len() == figure.tasks.len())?;
    let strata: Vec<Vec<f64>> =
        own.iter().map(|row| row.seeds.iter().map(|seed| seed.final_return).collect()).collect();
    let seeds = own.iter().flat_map(|row| row.seeds.clone()).collect();
    let planned = own.iter().map(|row| row.planned).sum();
    Some(row(ALL, (first.variant, first.label), planned, &strata, seeds))
}

/// The evaluations of a run up to `steps`; `None` where it has none.
fn result(run: &PlannedRun, status: &Status, steps: u64) -> Result<Option<SeedResult>, PaperError> {
    let records = read_jsonl(&run.dir.join(METRICS_FILE)).map_err(crate::plot::PlotError::from)?;
    // A run stops at the end of a round: its last evaluation comes a little after the last step that was asked for.
    let beyond = records.iter().map(|(step, _)| *step).find(|step| *step >= steps).unwrap_or(u64::MAX);
    let within = records.iter().filter(|(step, _)| *step <= beyond);
    let evaluations: Vec<_> = within
        .filter_map(|(step, values)| Some((*step, *values.get(keys::EVAL_RETURN_MEAN)?, values)))
        .filter(|(_, mean, _)| mean.is_finite())
        .collect();
    let Some((env_steps, final_return, values)) = evaluations.last() else { return Ok(None) };
    let sd =
        |values: &std::collections::BTreeMap<String, f64>| values.get(keys::EVAL_RETURN_SD).copied().unwrap_or(0.0);
    let means: Vec<f64> = evaluations.iter().map(|(_, mean, _)| *mean).collect();
    let tail = &means[means.len().saturating_sub(LAST)..];
    let points = evaluations
        .iter()
        .map(|(step, mean, values)| CurvePoint { env_steps: *step as f64, mean: *mean, sd: sd(values) })
        .collect();
    Ok(Some(SeedResult {
        seed: run.seed,
        run: run.name.clone(),
        env_steps: *env_steps,
        final_return: *final_return,
        final_sd_over_episodes: sd(values),
        last_five: tail.iter().sum::<f64>() / tail.len() as f64,
        best_return: means.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        success_rate: values.get(keys::EVAL_SUCCESS_RATE).copied(),
        wall_s: status.wall_s,
        commit: status.commit.clone(),
        points,
    }))
}

/// Four significant digits or so.
fn short(value: f64) -> String {
    match value.abs() {
        0.0..10.0 => format!("{value:.3}"),
        10.0..1000.0 => format!("{value:.1}"),
        _ => format!("{value:.0}"),
    }
}

/// `1,000,000`.
fn grouped(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
#[path = "table_tests.rs"]
mod tests;
