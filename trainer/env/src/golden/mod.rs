//! Recorded trajectories of the reference programs, and their replay through our environments.
//!
//! A recording is a gzip-compressed JSON document; `tests/golden/envs/README.md` describes the format. [`check`] starts
//! our environment from each recorded state, applies the recorded actions at the precision they were recorded with, and
//! compares every observation, reward, state and flag.

mod recording;
mod replay;

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::EnvError;

/// Why a recording cannot be replayed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GoldenError {
    /// The file cannot be read or unpacked.
    #[error("{path}: cannot read: {source}; expected a gzip-compressed JSON recording")]
    Read {
        /// File.
        path: PathBuf,
        /// Reason.
        source: std::io::Error,
    },
    /// Unpacked, the file is larger than any recording.
    #[error("{path}: unpacks to more than {limit} bytes; not a recording")]
    TooLarge {
        /// File.
        path: PathBuf,
        /// Limit, bytes.
        limit: u64,
    },
    /// Not a document of the recording format.
    #[error("{path}: not a recording: {source}")]
    Json {
        /// File.
        path: PathBuf,
        /// Reason, with line and column.
        source: serde_json::Error,
    },
    /// A newer or older format.
    #[error("{path}: format {found}, expected 1")]
    Format {
        /// File.
        path: PathBuf,
        /// Format number found.
        found: u64,
    },
    /// A recording of an environment that this crate does not hold.
    #[error("{path}: recorded from `{name}`, {reason}")]
    NotOffered {
        /// File.
        path: PathBuf,
        /// The reference's name for it.
        name: String,
        /// Why there is no such environment here.
        reason: String,
    },
    /// Something in the document does not fit the environment or the rest of the document.
    #[error("{path}: {place}: {message}")]
    Content {
        /// File.
        path: PathBuf,
        /// Trajectory, step and key.
        place: String,
        /// What was expected and found.
        message: String,
    },
    /// The environment cannot be made.
    #[error("{path}: {source}")]
    Env {
        /// File.
        path: PathBuf,
        /// Reason.
        source: EnvError,
    },
}

/// How a recording is replayed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Replay {
    /// Each trajectory from its start to its end. MuJoCo must give equal bits, which needs the processor family and the
    /// engine build of the recording. Always so where the recording holds random draws of the steps (LunarLander).
    WholeRun,
    /// From every recorded state two steps, comparing the second one, within 1e-9. For MuJoCo on another processor:
    /// there a difference of 1e-16 grows to order 10 within a run.
    FromEachState,
}

/// A step of a trajectory; step 0 is the reset.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Place {
    /// Name of the trajectory.
    pub trajectory: String,
    /// Number of steps done.
    pub step: usize,
}

/// The largest difference of one quantity.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// `observation`, `reward`, `reward_f32_actions` or `state`; `before_contact` is all of them up to the first contact of
    /// LunarLander, where the arithmetic is the reference's.
    pub quantity: &'static str,
    /// Numbers compared.
    pub compared: u64,
    /// Numbers that differ in any bit.
    pub unequal: u64,
    /// Largest absolute difference; infinite where one of the two is not a number.
    pub largest: f64,
    /// Where it is; `None` where nothing differs.
    pub at: Option<Place>,
    /// Largest difference allowed; 0 asks for equal bits.
    pub tolerance: f64,
}

impl Comparison {
    /// Whether the quantity is within its tolerance.
    pub fn passed(&self) -> bool {
        if self.tolerance == 0.0 { self.unequal == 0 } else { self.largest <= self.tolerance }
    }
}

/// A flag that differs from the recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FlagDifference {
    /// Where.
    pub at: Place,
    /// `terminated` or `truncated`.
    pub flag: &'static str,
    /// Recorded value; ours is the other one.
    pub recorded: bool,
}

/// Result of replaying one recording.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GoldenReport {
    /// File.
    pub path: PathBuf,
    /// Registry id of our environment.
    pub id: String,
    /// The reference's name for it.
    pub reference: String,
    /// How it was replayed.
    pub replay: Replay,
    /// Number of trajectories.
    pub trajectories: usize,
    /// Number of recorded steps.
    pub steps: usize,
    /// Differences by quantity.
    pub comparisons: Vec<Comparison>,
    /// First differing flag.
    pub first_flag: Option<FlagDifference>,
}

impl GoldenReport {
    /// Whether all quantities are within their tolerances and all flags are equal.
    pub fn passed(&self) -> bool {
        self.first_flag.is_none() && self.comparisons.iter().all(Comparison::passed)
    }

    /// The comparison of that quantity, if the recording has it.
    pub fn comparison(&self, quantity: &str) -> Option<&Comparison> {
        self.comparisons.iter().find(|c| c.quantity == quantity)
    }
}

/// Replays a recording through our environment of that name: the whole run, or from each state where the recording is
/// one of MuJoCo from another processor family.
///
/// # Errors
/// [`GoldenError`] where the file is not a recording, not of an environment of this crate, or not consistent. A file
/// that can be replayed but differs is no error: see [`GoldenReport::passed`].
pub fn check(path: &Path) -> Result<GoldenReport, GoldenError> {
    replay::check(path, None)
}

/// Like [`check`], replayed in the given way.
///
/// # Errors
/// As [`check`].
pub fn check_by(path: &Path, how: Replay) -> Result<GoldenReport, GoldenError> {
    replay::check(path, Some(how))
}
