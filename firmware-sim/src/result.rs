//! What a run found out.

use gadm_node::Counters;
use serde::Serialize;

use crate::bus::load::{BitRate, Load};
use crate::fault::{Fault, Span};
use crate::target::Timing;

/// Version of the JSON form of [`RunResult`].
pub const RESULT_VERSION: u32 = 1;

/// One episode.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EpisodeResult {
    /// Number, from 0.
    pub episode: u64,
    /// Seed of the plant's reset.
    pub seed: u64,
    /// Sum of the rewards.
    #[serde(rename = "return")]
    pub ret: f64,
    /// Control periods.
    pub steps: u64,
    /// Ended by the environment's own rules.
    pub terminated: bool,
    /// Cut by a time limit.
    pub truncated: bool,
    /// Periods in which the node repeated its last action.
    pub held: u64,
    /// Periods with the safe action or a step of the ramp to it.
    pub safe: u64,
    /// Periods without an action set of the node.
    pub missing: u64,
    /// Decisions in which the mask left no latent.
    pub fallback: u64,
    /// Decisions in which an observation or action was cut to its limits.
    pub clipped: u64,
    /// Periods with the flag `late`.
    pub late: u64,
    /// Longest row of periods in which the actuators had neither a new decision nor a safe action.
    pub max_action_age: u64,
    /// Periods in which an applied action was not finite or beyond the bounds of its head.
    pub out_of_bounds: u64,
    /// What faults did; `None` in a run without.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub faults: Option<EpisodeFaults>,
    /// When faults were injected.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub fault_spans: Vec<Span>,
}

/// What faults did to one episode. Times in control periods from the first injected fault on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EpisodeFaults {
    /// Tick of the first injected fault; `None` where there was none.
    pub first_tick: Option<u64>,
    /// Time to the first sign of it: a flag, a missing answer, a counter or the heartbeat; `None` = never.
    pub detected_after: Option<u64>,
    /// Time to the safe action, or the first step of the ramp to it, at the actuators; `None` = never.
    pub safe_after: Option<u64>,
    /// Largest distance of an applied action from the policy's decision on the true observation, from the first fault on,
    /// as a fraction of the range of the action.
    pub worst_action_error: f64,
}

/// A fault of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FaultReport {
    /// The fault as the scenario has it.
    #[serde(flatten)]
    pub fault: Fault,
    /// How often it was injected.
    pub injected: u64,
    /// What is counted: frames, ticks, …
    pub counts: &'static str,
}

/// Mean and spread of the returns.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ReturnSummary {
    /// Mean.
    pub mean: f64,
    /// Sample standard deviation (n − 1); 0 for one episode.
    pub sd: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Episodes.
    pub n: u64,
}

impl ReturnSummary {
    /// Of at least one return; all zero without any.
    #[must_use]
    pub fn of(returns: &[f64]) -> Self {
        let n = returns.len().max(1) as f64;
        let mean = returns.iter().sum::<f64>() / n;
        let squares: f64 = returns.iter().map(|r| (r - mean).powi(2)).sum();
        let sd = if returns.len() > 1 { (squares / (n - 1.0)).sqrt() } else { 0.0 };
        let fold = |f: fn(f64, f64) -> f64| returns.iter().copied().reduce(f).unwrap_or(0.0);
        Self { mean, sd, min: fold(f64::min), max: fold(f64::max), n: returns.len() as u64 }
    }
}

/// The policy of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PolicySummary {
    /// Environment it was trained for, by its own record.
    pub environment: String,
    /// Hash of its interface, hexadecimal.
    pub interface_hash: String,
    /// CRC-32 of its payload, hexadecimal.
    pub crc32: String,
    /// Number of latents.
    pub num_latents: u16,
    /// Bytes of the file.
    pub bytes: usize,
}

/// What was on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BusSummary {
    /// Bit rates.
    pub bit_rate: BitRate,
    /// Worst-case load of one control period.
    pub load: Load,
    /// Worst-case load of the frames that were sent, over the whole run, per cent of virtual time.
    pub measured_percent: f64,
    /// Frames.
    pub frames: u64,
    /// Frames of the node that the plant dropped.
    pub plant_errors: u64,
}

/// A whole run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunResult {
    /// Version of this record, [`RESULT_VERSION`].
    pub version: u32,
    /// The policy.
    pub policy: PolicySummary,
    /// The plant.
    pub plant: String,
    /// Where the node ran.
    pub target: String,
    /// Name of the bus profile.
    pub profile: &'static str,
    /// Seed of the run.
    pub seed: u64,
    /// Mean and spread.
    pub returns: ReturnSummary,
    /// The episodes.
    pub episodes: Vec<EpisodeResult>,
    /// Latents that were chosen at least once.
    pub latents_used: usize,
    /// How often each latent was chosen.
    pub latent_counts: Vec<u64>,
    /// Control periods of all episodes.
    pub steps: u64,
    /// Virtual time, seconds.
    pub virtual_s: f64,
    /// The node's counters; `None` where the target tells frames only.
    pub node: Option<Counters>,
    /// The faults that were asked for, in the order of the scenario.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub faults: Vec<FaultReport>,
    /// The bus.
    pub bus: BusSummary,
    /// How well real time was kept; `None` in lockstep.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timing: Option<Timing>,
    /// What a person should know.
    pub warnings: Vec<String>,
}

impl RunResult {
    /// The returns, in order.
    #[must_use]
    pub fn returns(&self) -> Vec<f64> {
        self.episodes.iter().map(|e| e.ret).collect()
    }

    /// The result as a table for people.
    #[must_use]
    pub fn table(&self) -> String {
        use std::fmt::Write as _;
        let sum = |f: fn(&EpisodeResult) -> u64| self.episodes.iter().map(f).sum::<u64>();
        let r = &self.returns;
        let mut text = String::new();
        let mut row = |name: &str, value: String| {
            // Writing to a String cannot fail.
            let _ = writeln!(text, "  {name:<18} {value}");
        };
        row("plant", format!("{}, profile {}, node {}", self.plant, self.profile, self.target));
        row("return", format!("{:.2} ± {:.2}  (min {:.2}, max {:.2}, n {})", r.mean, r.sd, r.min, r.max, r.n));
        row("steps", format!("{} = {:.2} s of virtual time", self.steps, self.virtual_s));
        row("latents used", format!("{} of {}", self.latents_used, self.policy.num_latents));
        row("mask fallbacks", sum(|e| e.fallback).to_string());
        row("clipped", sum(|e| e.clipped).to_string());
        row(
            "held, late, safe",
            format!("{}, {}, {} (missing {})", sum(|e| e.held), sum(|e| e.late), sum(|e| e.safe), sum(|e| e.missing)),
        );
        let load = &self.bus.load;
        let rate = self.bus.bit_rate;
        let rate = if self.profile == "fd-f32" {
            format!("{}/{} kbit/s", rate.nominal / 1000, rate.data / 1000)
        } else {
            format!("{} kbit/s", rate.nominal / 1000)
        };
        row(
            "bus load",
            format!(
                "{:.1} % at {rate}, worst case ({} OBS + {} ACT frames a period: {:.1} %)",
                load.total_percent, load.observation_frames, load.action_frames, load.sets_percent
            ),
        );
        if let Some(t) = &self.timing {
            let ms = |us: f64| us / 1e3;
            let (l, j) = (&t.latency_us, &t.jitter_us);
            row(
                "real time",
                format!(
                    "{} x, {} periods, {} unanswered, {} overruns, answers take {:.1} % of the period",
                    t.factor, t.periods, t.unanswered, t.overruns, t.load_percent
                ),
            );
            row("latency", format!("p50 {:.3} ms, p99 {:.3} ms, max {:.3} ms", ms(l.p50), ms(l.p99), ms(l.max)));
            row("jitter", format!("p50 {:.3} ms, p99 {:.3} ms, max {:.3} ms", ms(j.p50), ms(j.p99), ms(j.max)));
        }
        for f in &self.faults {
            row("fault", format!("{}: {} {} injected", f.fault.name, f.injected, f.counts));
        }
        for warning in &self.warnings {
            row("warning", warning.clone());
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::ReturnSummary;

    #[test]
    fn summary_of_known_numbers() {
        let s = ReturnSummary::of(&[1.0, 2.0, 3.0, 4.0]);
        assert_eq!((s.mean, s.min, s.max, s.n), (2.5, 1.0, 4.0, 4));
        assert!((s.sd - (5.0_f64 / 3.0).sqrt()).abs() < 1e-12);
        assert_eq!(ReturnSummary::of(&[7.0]).sd, 0.0);
        assert_eq!(ReturnSummary::of(&[]).n, 0);
    }
}
