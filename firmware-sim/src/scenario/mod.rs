//! Scenario files: what to run, what goes wrong, and what must hold all the same.
//!
//! A scenario is TOML; paths in it are relative to the file. The same file serves `gadm-sim run`, which runs all its
//! faults together, and `gadm-sim campaign`, which runs each on its own, at each of its intensities.
//!
//! ```toml
//! policy = "../../models/hopper-v5/policy.bin"
//! episodes = 5
//!
//! [[faults]]
//! layer = "frame"
//! kind = "drop"
//! p = 0.05
//! only = ["OBS"]
//! sweep = [0.01, 0.05, 0.2]
//!
//! [criteria]
//! max_action_age = 3
//! ```

mod criteria;
mod file;

pub use criteria::{Criteria, Criterion, Verdict, return_ratio};

use std::path::{Path, PathBuf};

use crate::fault::Fault;
use crate::result::RunResult;
use crate::sil::{Progress, RunOptions, run_with_progress};
use crate::{BitRate, Profile, SimError};

/// A scenario, checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// The file.
    pub path: PathBuf,
    /// Name in reports; the name of the file where it gives none.
    pub name: String,
    /// What it is about.
    pub description: String,
    /// The policy file.
    pub policy: PathBuf,
    /// Registry id of the plant; `None`: the environment that the policy names.
    pub plant: Option<String>,
    /// Episodes of a run.
    pub episodes: u64,
    /// Seed of the run.
    pub seed: u64,
    /// How values travel.
    pub profile: Profile,
    /// Bit rates.
    pub bit_rate: BitRate,
    /// The faults, as a campaign varies them.
    pub faults: Vec<Entry>,
    /// What must hold.
    pub criteria: Criteria,
    /// Seeds of a campaign, per fault and intensity.
    pub seeds: u64,
}

/// One fault of a scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// As it is run.
    pub fault: Fault,
    /// As a campaign runs it: value of the intensity, and the fault with it. At least one.
    pub sweep: Vec<(String, Fault)>,
    /// What must hold with this fault alone: the scenario's criteria with the fault's own ones.
    pub criteria: Criteria,
}

/// A run of a scenario, judged.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// The run.
    pub result: RunResult,
    /// The same run without faults; `None` where the scenario has none or no criterion needs it.
    pub nominal: Option<RunResult>,
    /// What was asked for and what was found.
    pub verdict: Verdict,
}

impl Scenario {
    /// Reads a scenario.
    ///
    /// # Errors
    /// [`SimError::Read`], or [`SimError::Scenario`] with file, line, what was expected and found.
    pub fn load(path: &Path) -> Result<Self, SimError> {
        let text = std::fs::read_to_string(path).map_err(|source| SimError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    /// As [`load`](Self::load), of a text that would stand in `path`.
    ///
    /// # Errors
    /// [`SimError::Scenario`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, SimError> {
        file::parse(text, path)
    }

    /// What `gadm-sim run` runs: all faults together.
    #[must_use]
    pub fn run_options(&self) -> RunOptions {
        RunOptions {
            plant: self.plant.clone(),
            episodes: self.episodes,
            seed: self.seed,
            profile: self.profile,
            bit_rate: self.bit_rate,
            faults: self.faults.iter().map(|e| e.fault.clone()).collect(),
            ..RunOptions::new(&self.policy)
        }
    }

    /// Judges a run of [`run_options`](Self::run_options), on whichever target. `nominal` is the same run without
    /// faults, which only a criterion about the nominal return needs.
    #[must_use]
    pub fn judge(&self, result: &RunResult, nominal: Option<&RunResult>) -> Verdict {
        let criteria = if self.faults.is_empty() { self.criteria.without_faults() } else { self.criteria };
        criteria.judge(result, nominal.map(|n| n.returns.mean))
    }

    /// True where [`judge`](Self::judge) needs the run without faults.
    #[must_use]
    pub fn needs_nominal(&self) -> bool {
        self.criteria.min_return_ratio.is_some() && !self.faults.is_empty()
    }

    /// Runs the scenario in this process and judges it. `trace` names where the run (not the nominal one) leaves its
    /// trace.
    ///
    /// # Errors
    /// As [`run`](crate::run).
    pub fn run(&self, trace: Option<PathBuf>, progress: &mut dyn FnMut(Progress)) -> Result<Outcome, SimError> {
        let options = RunOptions { trace, ..self.run_options() };
        let nominal = if self.needs_nominal() {
            let clean = RunOptions { faults: Vec::new(), trace: None, ..options.clone() };
            Some(run_with_progress(&clean, &mut |_| {})?)
        } else {
            None
        };
        let result = run_with_progress(&options, progress)?;
        let verdict = self.judge(&result, nominal.as_ref());
        Ok(Outcome { result, nominal, verdict })
    }
}
