//! Metrics of a run: names ([`keys`]), the record that carries them, and where they go.
//!
//! | sink | file | for |
//! | --- | --- | --- |
//! | [`JsonlSink`] | `metrics.jsonl` | programs; the same bytes for the same configuration and seed |
//! | [`JsonlSink`] | `timing.jsonl` | rates and wall-clock time, which no seed repeats |
//! | [`TensorBoardSink`] | `events.out.tfevents.*` | TensorBoard |

pub mod jsonl;
pub mod keys;
pub mod tensorboard;

pub use jsonl::{JsonlSink, read_jsonl};
pub use tensorboard::TensorBoardSink;

use std::path::PathBuf;

/// Metrics at one point of a run: values in the order they were added.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Environment steps taken when the record was made ([`keys::ENV_STEPS`]).
    pub step: u64,
    /// Names from [`keys`] with their values.
    pub values: Vec<(&'static str, f64)>,
}

impl Record {
    /// An empty record at `step` environment steps.
    pub fn new(step: u64) -> Self {
        Self { step, values: Vec::new() }
    }

    /// Adds `value` under `key`, a constant of [`keys`].
    pub fn push(&mut self, key: &'static str, value: f64) {
        self.values.push((key, value));
    }

    /// [`Self::push`] for chains.
    #[must_use]
    pub fn with(mut self, key: &'static str, value: f64) -> Self {
        self.push(key, value);
        self
    }

    /// The value under `key`, if there is one.
    pub fn get(&self, key: &str) -> Option<f64> {
        self.values.iter().find(|(name, _)| *name == key).map(|(_, value)| *value)
    }
}

/// A metric could not be written or read back.
#[derive(Debug, thiserror::Error)]
pub enum MetricsError {
    /// The file system refused.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// A name that is not in [`keys::ALL`].
    #[error("unknown metric `{key}` at environment step {step}: add it to the table in metrics/keys.rs")]
    UnknownKey {
        /// The name.
        key: &'static str,
        /// The record's step.
        step: u64,
    },
    /// A name that a record holds twice, or that is the abscissa itself.
    #[error("metric `{key}` occurs twice in the record of environment step {step}")]
    DuplicateKey {
        /// The name.
        key: &'static str,
        /// The record's step.
        step: u64,
    },
    /// Records must come in the order of their steps.
    #[error("record of environment step {found} after one of step {last}: records must come in order")]
    StepWentBack {
        /// Step of the last record written.
        last: u64,
        /// Step of the refused record.
        found: u64,
    },
    /// A line of the file is not a record.
    #[error("{}:{line}: not a metrics record ({reason}); restore the file or remove the line", path.display())]
    BadLine {
        /// The file.
        path: PathBuf,
        /// Line number from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// A run folder already holds metrics.
    #[error("{} exists: choose another run folder or resume this run", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
}

impl MetricsError {
    /// For `map_err`: an error of the operating system while doing `action` to `path`.
    fn io(action: &'static str, path: &std::path::Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self::Io { action, path, source }
    }
}

/// Checks names and their uniqueness before anything is written.
fn check(record: &Record) -> Result<(), MetricsError> {
    for (i, (key, _)) in record.values.iter().enumerate() {
        if !keys::is_known(key) {
            return Err(MetricsError::UnknownKey { key, step: record.step });
        }
        if *key == keys::ENV_STEPS || record.values[..i].iter().any(|(other, _)| other == key) {
            return Err(MetricsError::DuplicateKey { key, step: record.step });
        }
    }
    Ok(())
}
