//! What must hold in a run, and whether it did.

use serde::{Deserialize, Serialize};

use crate::result::{EpisodeResult, RunResult};

/// Limits; those left out do not apply. A run with faults also fails where none was injected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Criteria {
    /// Lowest mean return.
    pub min_return: Option<f64>,
    /// Lowest mean return as a fraction of the same run without faults.
    pub min_return_ratio: Option<f64>,
    /// Longest time from the first injected fault to the first sign of it (a flag, a counter or the heartbeat), control
    /// periods; in every episode with a fault.
    pub max_time_to_detect: Option<u64>,
    /// Longest time from the first injected fault to the safe action or the first step of the ramp to it, control
    /// periods; in every episode with a fault that lasts as long.
    pub max_time_to_safe: Option<u64>,
    /// Longest row of periods in which the actuators had neither a new decision nor a safe action.
    pub max_action_age: Option<u64>,
    /// Every applied action is finite and within the bounds of its head.
    pub action_bounds: Option<bool>,
    /// Largest distance between the applied action and the policy's decision on the true observation, fraction of the
    /// range of the action.
    pub max_action_error: Option<f64>,
    /// Most periods with the safe action.
    pub max_safe_periods: Option<u64>,
    /// Most entries of the node into SAFE.
    pub max_safe_entries: Option<u64>,
    /// Fewest injected faults; 1 where there are faults.
    pub min_injected: Option<u64>,
    /// Largest worst-case bus load, per cent.
    pub max_bus_load: Option<f64>,
}

/// One criterion and what was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Criterion {
    /// Key in the scenario.
    pub name: &'static str,
    /// What was asked for.
    pub limit: String,
    /// What was found.
    pub found: String,
    /// Whether it holds.
    pub passed: bool,
}

/// All criteria of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Verdict {
    /// True where all hold.
    pub passed: bool,
    /// The criteria that were asked for.
    pub criteria: Vec<Criterion>,
}

impl Verdict {
    /// Those that were missed, a line each.
    #[must_use]
    pub fn missed(&self) -> Vec<String> {
        let missed = self.criteria.iter().filter(|c| !c.passed);
        missed.map(|c| format!("{}: required {}, found {}", c.name, c.limit, c.found)).collect()
    }
}

impl Criteria {
    /// These, and those of `base` where these say nothing.
    #[must_use]
    pub fn or(self, base: &Self) -> Self {
        Self {
            min_return: self.min_return.or(base.min_return),
            min_return_ratio: self.min_return_ratio.or(base.min_return_ratio),
            max_time_to_detect: self.max_time_to_detect.or(base.max_time_to_detect),
            max_time_to_safe: self.max_time_to_safe.or(base.max_time_to_safe),
            max_action_age: self.max_action_age.or(base.max_action_age),
            action_bounds: self.action_bounds.or(base.action_bounds),
            max_action_error: self.max_action_error.or(base.max_action_error),
            max_safe_periods: self.max_safe_periods.or(base.max_safe_periods),
            max_safe_entries: self.max_safe_entries.or(base.max_safe_entries),
            min_injected: self.min_injected.or(base.min_injected),
            max_bus_load: self.max_bus_load.or(base.max_bus_load),
        }
    }

    /// The criteria that make sense for a run without faults.
    #[must_use]
    pub fn without_faults(self) -> Self {
        Self { max_time_to_detect: None, max_time_to_safe: None, max_action_error: None, min_injected: None, ..self }
    }

    /// Judges a run. `nominal` is the mean return of the same run without faults; without it
    /// [`min_return_ratio`](Self::min_return_ratio) compares the run with itself where it has no faults, and is missed
    /// where it has.
    #[must_use]
    pub fn judge(&self, result: &RunResult, nominal: Option<f64>) -> Verdict {
        let mut v = Verdict { passed: true, criteria: Vec::new() };
        let e = &result.episodes;
        if let Some(limit) = self.min_return {
            v.at_least("min_return", limit, Some(result.returns.mean));
        }
        if let Some(limit) = self.min_return_ratio {
            let clean = if result.faults.is_empty() { Some(result.returns.mean) } else { nominal };
            let ratio = clean.map(|nominal| return_ratio(result.returns.mean, nominal));
            v.at_least("min_return_ratio", limit, ratio);
        }
        let hit: Vec<_> =
            e.iter().filter_map(|e| e.faults.filter(|f| f.first_tick.is_some()).map(|f| (e, f))).collect();
        if let Some(limit) = self.max_time_to_detect {
            let due = hit.iter().filter(|(e, f)| lasts(e, f.first_tick, limit) || f.detected_after.is_some());
            v.all_within("max_time_to_detect", limit, due.map(|(_, f)| f.detected_after));
        }
        if let Some(limit) = self.max_time_to_safe {
            let due = hit.iter().filter(|(e, f)| lasts(e, f.first_tick, limit) || f.safe_after.is_some());
            v.all_within("max_time_to_safe", limit, due.map(|(_, f)| f.safe_after));
        }
        if let Some(limit) = self.max_action_age {
            v.at_most("max_action_age", limit, e.iter().map(|e| e.max_action_age).max().unwrap_or(0));
        }
        if self.action_bounds == Some(true) {
            v.at_most("action_bounds", 0, e.iter().map(|e| e.out_of_bounds).sum());
        }
        if let Some(limit) = self.max_action_error {
            let worst = hit.iter().map(|(_, f)| f.worst_action_error).fold(0.0, f64::max);
            v.push("max_action_error", format!("at most {limit}"), format!("{worst:.4}"), worst <= limit);
        }
        if let Some(limit) = self.max_safe_periods {
            v.at_most("max_safe_periods", limit, e.iter().map(|e| e.safe).sum());
        }
        if let Some(limit) = self.max_safe_entries {
            let found = result.node.map(|n| u64::from(n.safe_entries));
            let text = found.map_or_else(|| "not told by this target".to_owned(), |n| n.to_string());
            v.push("max_safe_entries", format!("at most {limit}"), text, found.is_some_and(|n| n <= limit));
        }
        let injected: u64 = result.faults.iter().map(|f| f.injected).sum();
        let least = if result.faults.is_empty() { self.min_injected } else { Some(self.min_injected.unwrap_or(1)) };
        if let Some(limit) = least {
            v.push("min_injected", format!("at least {limit}"), injected.to_string(), injected >= limit);
        }
        for f in result.faults.iter().filter(|f| f.injected == 0 && result.faults.len() > 1) {
            v.push("min_injected", "at least 1".into(), format!("0 of `{}`", f.fault.name), false);
        }
        if let Some(limit) = self.max_bus_load {
            let load = result.bus.load.total_percent;
            v.push("max_bus_load", format!("at most {limit} %"), format!("{load:.1} %"), load <= limit);
        }
        v
    }
}

/// The episode went on for `limit` periods after the fault, so that the limit could be missed.
fn lasts(e: &EpisodeResult, first_tick: Option<u64>, limit: u64) -> bool {
    first_tick.is_some_and(|t| e.steps > t + limit)
}

/// Part of the nominal return that is left; 1 where it is not lower, also for returns that are not positive.
#[must_use]
pub fn return_ratio(found: f64, nominal: f64) -> f64 {
    if nominal > 0.0 {
        found / nominal
    } else if found >= nominal {
        1.0
    } else {
        nominal / found
    }
}

impl Verdict {
    fn push(&mut self, name: &'static str, limit: String, found: String, passed: bool) {
        self.passed &= passed;
        self.criteria.push(Criterion { name, limit, found, passed });
    }

    fn at_least(&mut self, name: &'static str, limit: f64, found: Option<f64>) {
        let text = found.map_or_else(|| "nothing to compare with".to_owned(), |f| format!("{f:.4}"));
        self.push(name, format!("at least {limit}"), text, found.is_some_and(|f| f >= limit));
    }

    fn at_most(&mut self, name: &'static str, limit: u64, found: u64) {
        self.push(name, format!("at most {limit}"), found.to_string(), found <= limit);
    }

    /// Every value is there and within the limit.
    fn all_within(&mut self, name: &'static str, limit: u64, found: impl Iterator<Item = Option<u64>>) {
        let all: Vec<_> = found.collect();
        let never = all.iter().filter(|f| f.is_none()).count();
        let worst = all.iter().flatten().max();
        let text = match (never, worst) {
            (0, Some(w)) => w.to_string(),
            (0, None) => "no episode with a fault that lasted".to_owned(),
            (n, _) => format!("never in {n} of {} episodes", all.len()),
        };
        self.push(name, format!("at most {limit}"), text, never == 0 && worst.is_some_and(|w| *w <= limit));
    }
}
