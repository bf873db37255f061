//! What can go wrong in the trainer.

use std::fmt::Display;
use std::path::PathBuf;

/// Error of the trainer library.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A setting out of range.
    #[error("config `{key}`: expected {expected}, found {found}")]
    Config {
        /// Dotted key.
        key: String,
        /// What is allowed.
        expected: String,
        /// What was given.
        found: String,
    },
    /// A loss or a value is not finite.
    #[error(
        "{what} is not finite at env step {env_step}, update {update}; the batch is in {}: lower the learning rate or look \
         for extreme observations there",
        batch.display()
    )]
    NotFinite {
        /// Which number.
        what: String,
        /// Environment steps so far.
        env_step: u64,
        /// Updates so far.
        update: u64,
        /// Where the batch was saved.
        batch: PathBuf,
    },
    /// The run folder exists.
    #[error("run folder {} already exists: pass --resume to continue it, or another --out", path.display())]
    RunExists {
        /// The folder.
        path: PathBuf,
    },
    /// Another process trains in the run folder.
    #[error("{} is in use by another `gadm train`: wait for it, stop it, or choose another --out", path.display())]
    RunLocked {
        /// The folder.
        path: PathBuf,
    },
    /// Nothing to resume.
    #[error("{} holds no checkpoint to resume: start it without --resume, or check the path", path.display())]
    NothingToResume {
        /// The folder.
        path: PathBuf,
    },
    /// The configuration of a run was changed before resuming.
    #[error("run {} was started with another configuration ({detail}): resume it without changes, or start a new run", path.display())]
    ConfigChanged {
        /// The folder.
        path: PathBuf,
        /// The first difference.
        detail: String,
    },
    /// A checkpoint that cannot be used.
    #[error("checkpoint {}: {reason}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// A file with recorded actions that cannot be used.
    #[error("data file {}: {reason}", path.display())]
    Data {
        /// The file.
        path: PathBuf,
        /// What is wrong with it and what was expected.
        reason: String,
    },
    /// A file operation failed.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// On which path.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The policy cannot be exported.
    #[error("export: {0}")]
    Export(String),
    /// A policy file cannot be used.
    #[error("policy: {0}")]
    Policy(String),
    /// The environment.
    #[error(transparent)]
    Env(#[from] gadm_envs::EnvError),
    /// Stored parameters do not fit.
    #[error(transparent)]
    Import(#[from] crate::nn::ImportError),
    /// The configuration file.
    #[error(transparent)]
    ConfigFile(#[from] crate::config::ConfigError),
    /// The metrics files.
    #[error(transparent)]
    Metrics(#[from] crate::metrics::MetricsError),
    /// A file could not be written.
    #[error(transparent)]
    Write(#[from] crate::atomic::AtomicWriteError),
    /// A device that cannot evaluate the networks.
    #[error("device `{device}`: {reason}")]
    Device {
        /// As it was named.
        device: String,
        /// Why not, and what to do.
        reason: String,
    },
    /// The tensor library.
    #[error("candle: {0}")]
    Candle(#[from] candle_core::Error),
}

impl TrainError {
    /// A setting out of range.
    pub fn config(key: &str, expected: &str, found: impl Display) -> Self {
        Self::Config { key: key.to_owned(), expected: expected.to_owned(), found: found.to_string() }
    }

    /// The same setting, in a table that lies within another one.
    #[must_use]
    pub fn within(self, table: &str) -> Self {
        match self {
            Self::Config { key, expected, found } => Self::Config { key: format!("{table}.{key}"), expected, found },
            other => other,
        }
    }

    /// Wraps an I/O error with what was tried on which path.
    pub fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }
}
