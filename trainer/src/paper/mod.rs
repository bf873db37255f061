//! The paper's figures, made again by one command: a list of runs, their execution, statistics, drawing, and tables.
//!
//! A figure is data ([`figure`]); a [`plan`] makes of it the runs with their configurations and folders; [`state`] says which
//! of them are there; [`one`] does one of them, however often it is stopped; [`pool`] does many in processes of their own, and
//! [`submit`] hands them to a cluster; [`table`] and [`draw`] make of the run folders what people read, with [`flights`] (episodes
//! of LunarLander's snapshots), [`landing`] and [`toy`] (latents of a state) for what returns do not show.

pub mod columns;
pub mod draw;
pub mod figure;
pub mod flights;
pub mod landing;
pub mod one;
pub mod plan;
pub mod pool;
pub mod state;
pub mod stats;
pub mod submit;
pub mod table;
pub mod toy;

use std::path::PathBuf;

use crate::atomic::AtomicWriteError;
use crate::config::ConfigError;
use crate::error::TrainError;
use crate::plot::PlotError;

/// A figure could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PaperError {
    /// An environment that this program does not have.
    #[error(
        "{figure} needs the environment `{env}`, which this build of gadm does not have ({reason}); leave it out with --only"
    )]
    Environment {
        /// The figure.
        figure: &'static str,
        /// The environment.
        env: &'static str,
        /// What making it said.
        reason: String,
    },
    /// More steps are needed for anything to be learned.
    #[error("--steps {steps}: {run} collects {warmup} random steps first; give more than that")]
    TooShort {
        /// The run.
        run: String,
        /// Steps asked for.
        steps: u64,
        /// Its random steps.
        warmup: u64,
    },
    /// `--only` picks nothing.
    #[error("--only {pattern}: no run of {figure} has that in its name, such as {example}")]
    NothingPicked {
        /// What was given.
        pattern: String,
        /// The figure.
        figure: &'static str,
        /// A name.
        example: String,
    },
    /// An index beyond the list.
    #[error("{figure} has {runs} runs with these options: expected an index from 0 to {}, found {index}", runs.saturating_sub(1))]
    NoSuchRun {
        /// The figure.
        figure: &'static str,
        /// How many there are.
        runs: usize,
        /// What was given.
        index: usize,
    },
    /// A run folder of the right name with another configuration.
    #[error("{} holds a run with another configuration ({detail}): move it away, or give another --out", path.display())]
    OtherConfiguration {
        /// The folder.
        path: PathBuf,
        /// The first difference.
        detail: String,
    },
    /// A cluster's command failed.
    #[error("{command}: {reason}")]
    Submit {
        /// What was called.
        command: String,
        /// What went wrong, and what to do.
        reason: String,
    },
    /// Training, or a file operation.
    #[error(transparent)]
    Train(#[from] Box<TrainError>),
    /// A configuration.
    #[error(transparent)]
    Config(#[from] Box<ConfigError>),
    /// Drawing.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// Writing.
    #[error(transparent)]
    Write(#[from] AtomicWriteError),
}

impl From<TrainError> for PaperError {
    fn from(error: TrainError) -> Self {
        Self::Train(Box::new(error))
    }
}

impl PaperError {
    /// Wraps an I/O error with what was tried on which path.
    fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        move |source| TrainError::io(action, path)(source).into()
    }
}
