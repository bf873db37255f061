//! What is kept of one run, and of all runs of a fault at an intensity.

use serde::{Deserialize, Serialize};

use super::Job;
use crate::result::RunResult;
use crate::scenario::{Verdict, return_ratio};

/// Name of the runs without faults.
pub const NOMINAL: &str = "nominal";

/// One run of a campaign.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Name of the fault, or [`NOMINAL`].
    pub fault: String,
    /// Layer of the fault; empty for the nominal run.
    pub layer: String,
    /// Kind of the fault; empty for the nominal run.
    pub kind: String,
    /// Intensity, as the scenario writes it.
    pub intensity: String,
    /// Seed.
    pub seed: u64,
    /// All criteria held.
    pub passed: bool,
    /// Faults injected.
    pub injected: u64,
    /// Episodes, and those in which a fault was injected.
    pub episodes: u64,
    /// See `episodes`.
    pub hit: u64,
    /// Of the hit episodes, those in which the fault was noticed, and the longest time to it, periods.
    pub detected: u64,
    /// See `detected`.
    pub time_to_detect: Option<u64>,
    /// Of the hit episodes, those in which the actuators became safe, and the longest time to it, periods.
    pub made_safe: u64,
    /// See `made_safe`.
    pub time_to_safe: Option<u64>,
    /// Largest distance of an action from the policy's decision on the true observation, fraction of the range.
    pub worst_action_error: f64,
    /// Longest row of periods in which the actuators had neither a new decision nor a safe action.
    pub max_action_age: u64,
    /// Periods with an action beyond its bounds.
    pub out_of_bounds: u64,
    /// Periods with the safe action.
    pub safe_periods: u64,
    /// Mean return.
    pub mean_return: f64,
    /// Mean return as a fraction of the nominal one.
    pub return_ratio: Option<f64>,
    /// The criteria that were missed.
    pub missed: Vec<String>,
    /// Why the run did not end.
    pub error: Option<String>,
}

impl Record {
    /// Of a run that ended.
    pub(super) fn of(job: &Job, result: &RunResult, nominal: Option<f64>, verdict: &Verdict) -> Self {
        let hit: Vec<_> = result.episodes.iter().filter_map(|e| e.faults).filter(|f| f.first_tick.is_some()).collect();
        let mean_return = result.returns.mean;
        let nominal = if job.fault.is_some() { nominal } else { Some(mean_return) };
        Self {
            passed: verdict.passed,
            injected: result.faults.iter().map(|f| f.injected).sum(),
            episodes: result.episodes.len() as u64,
            hit: hit.len() as u64,
            detected: hit.iter().filter(|f| f.detected_after.is_some()).count() as u64,
            time_to_detect: hit.iter().filter_map(|f| f.detected_after).max(),
            made_safe: hit.iter().filter(|f| f.safe_after.is_some()).count() as u64,
            time_to_safe: hit.iter().filter_map(|f| f.safe_after).max(),
            worst_action_error: hit.iter().map(|f| f.worst_action_error).fold(0.0, f64::max),
            max_action_age: result.episodes.iter().map(|e| e.max_action_age).max().unwrap_or(0),
            out_of_bounds: result.episodes.iter().map(|e| e.out_of_bounds).sum(),
            safe_periods: result.episodes.iter().map(|e| e.safe).sum(),
            mean_return,
            return_ratio: nominal.map(|n| return_ratio(mean_return, n)),
            missed: verdict.missed(),
            ..Self::named(job)
        }
    }

    /// Of a run that did not.
    pub(super) fn failed(job: &Job, error: &str) -> Self {
        Self { error: Some(error.to_owned()), ..Self::named(job) }
    }

    fn named(job: &Job) -> Self {
        let (fault, layer, kind) = job.fault.as_ref().map_or((NOMINAL, "", ""), |f| {
            let row = f.row();
            (f.name.as_str(), row.layer, row.kind)
        });
        Self {
            fault: fault.to_owned(),
            layer: layer.to_owned(),
            kind: kind.to_owned(),
            intensity: job.intensity.clone(),
            seed: job.seed,
            passed: false,
            injected: 0,
            episodes: 0,
            hit: 0,
            detected: 0,
            time_to_detect: None,
            made_safe: 0,
            time_to_safe: None,
            worst_action_error: 0.0,
            max_action_age: 0,
            out_of_bounds: 0,
            safe_periods: 0,
            mean_return: 0.0,
            return_ratio: None,
            missed: Vec::new(),
            error: None,
        }
    }

    /// Whether this is the record of that job.
    pub(super) fn is(&self, job: &Job) -> bool {
        let fault = job.fault.as_ref().map_or(NOMINAL, |f| f.name.as_str());
        self.fault == fault && self.intensity == job.intensity && self.seed == job.seed
    }

    /// Name for people.
    #[must_use]
    pub fn name(&self) -> String {
        format!("{} {} seed {}", self.fault, self.intensity, self.seed)
    }
}

/// All seeds of a fault at an intensity.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Tally {
    /// Name of the fault, or [`NOMINAL`].
    pub fault: String,
    /// Intensity.
    pub intensity: String,
    /// Runs, and those that passed.
    pub runs: u64,
    /// See `runs`.
    pub passed: u64,
    /// Faults injected.
    pub injected: u64,
    /// Share of the hit episodes in which the fault was noticed; `None` without such episodes.
    pub detected: Option<f64>,
    /// Longest time to detect, periods.
    pub time_to_detect: Option<u64>,
    /// Share of the hit episodes in which the actuators became safe.
    pub made_safe: Option<f64>,
    /// Longest time to safe, periods.
    pub time_to_safe: Option<u64>,
    /// Largest of all runs.
    pub worst_action_error: f64,
    /// Longest of all runs, periods.
    pub max_action_age: u64,
    /// Mean of all runs.
    pub mean_return: f64,
    /// Mean of all runs; `None` without a nominal run.
    pub return_ratio: Option<f64>,
}

/// Tallies in the order in which they come first.
pub(super) fn tally(records: &[Record]) -> Vec<Tally> {
    let mut keys: Vec<(&str, &str)> = Vec::new();
    for r in records {
        if !keys.contains(&(&r.fault, &r.intensity)) {
            keys.push((&r.fault, &r.intensity));
        }
    }
    keys.into_iter()
        .map(|(fault, intensity)| {
            let runs: Vec<&Record> = records.iter().filter(|r| r.fault == fault && r.intensity == intensity).collect();
            let n = runs.len() as f64;
            let hit: u64 = runs.iter().map(|r| r.hit).sum();
            let share =
                |f: fn(&Record) -> u64| (hit > 0).then(|| runs.iter().map(|r| f(r)).sum::<u64>() as f64 / hit as f64);
            let ratios: Vec<f64> = runs.iter().filter_map(|r| r.return_ratio).collect();
            Tally {
                fault: fault.to_owned(),
                intensity: intensity.to_owned(),
                runs: runs.len() as u64,
                passed: runs.iter().filter(|r| r.passed).count() as u64,
                injected: runs.iter().map(|r| r.injected).sum(),
                detected: share(|r| r.detected),
                time_to_detect: runs.iter().filter_map(|r| r.time_to_detect).max(),
                made_safe: share(|r| r.made_safe),
                time_to_safe: runs.iter().filter_map(|r| r.time_to_safe).max(),
                worst_action_error: runs.iter().map(|r| r.worst_action_error).fold(0.0, f64::max),
                max_action_age: runs.iter().map(|r| r.max_action_age).max().unwrap_or(0),
                mean_return: runs.iter().map(|r| r.mean_return).sum::<f64>() / n,
                return_ratio: (!ratios.is_empty()).then(|| ratios.iter().sum::<f64>() / ratios.len() as f64),
            }
        })
        .collect()
}
