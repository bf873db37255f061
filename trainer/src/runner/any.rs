//! A run of any algorithm, as the training loop drives it.

use std::path::Path;

use super::baseline::BaselineRun;
use super::bookkeeping::{Counters, NotFinite, Window};
use super::run::Run;
use crate::algo::Actor;
use crate::config::{Algorithm, TrackConfig, TrainConfig};
use crate::error::TrainError;
use crate::metrics::Record;

/// A run in memory, whatever learns in it.
pub trait AnyRun {
    /// Settings.
    fn config(&self) -> &TrainConfig;

    /// Changes the number of steps to do and what is tracked, the settings that may change when a run is resumed.
    fn extend(&mut self, steps: u64, track: TrackConfig);

    /// Counters.
    fn counters(&self) -> &Counters;

    /// Counters, for the best and last return.
    fn counters_mut(&mut self) -> &mut Counters;

    /// Sums since the last record.
    fn window(&self) -> &Window;

    /// What the next round does, for people.
    fn phase(&self) -> &'static str;

    /// Reads what the run needs besides its configuration.
    ///
    /// # Errors
    /// For a file that is missing or does not fit.
    fn prepare(&mut self) -> Result<(), TrainError>;

    /// One round: collection, then updates.
    ///
    /// # Errors
    /// [`NotFinite`] where a loss, a gradient or a weight is not a finite number; environment errors.
    fn round(&mut self) -> Result<Result<(), NotFinite>, TrainError>;

    /// The metric record of everything since the last one, and a fresh window.
    fn record(&mut self) -> Record;

    /// The policy as evaluations see it.
    fn actor(&mut self) -> &mut dyn Actor;

    /// Puts the averages of the networks in their place where there are some (`track.average`); once more puts them back.
    fn swap_averages(&mut self) {}

    /// Writes the whole state.
    ///
    /// # Errors
    /// [`TrainError::Checkpoint`] with the cause; the old file is then untouched.
    fn save(&mut self, dir: &Path) -> Result<(), TrainError>;

    /// Writes the networks alone, as the file `name` among the checkpoints: what an evaluation and an export need.
    ///
    /// # Errors
    /// As [`save`](Self::save).
    fn save_networks(&mut self, dir: &Path, name: &str) -> Result<(), TrainError>;

    /// True when the configured steps are done.
    fn finished(&self) -> bool {
        self.counters().env_steps >= self.config().steps
    }
}

/// A run at step 0 of whatever `config.algo` names.
///
/// # Errors
/// For an unknown environment or impossible settings.
pub fn new_run(config: TrainConfig) -> Result<Box<dyn AnyRun>, TrainError> {
    Ok(match config.algo {
        Algorithm::GadmDqn => Box::new(Run::new(config)?),
        _ => Box::new(BaselineRun::new(config)?),
    })
}

/// The part of [`AnyRun`] that only hands out fields: `config`, `counters`, `window`.
macro_rules! any_run_fields {
    () => {
        fn config(&self) -> &TrainConfig {
            &self.config
        }

        fn extend(&mut self, steps: u64, track: $crate::config::TrackConfig) {
            self.config.steps = steps;
            self.config.track = track;
        }

        fn counters(&self) -> &Counters {
            &self.counters
        }

        fn counters_mut(&mut self) -> &mut Counters {
            &mut self.counters
        }

        fn window(&self) -> &Window {
            &self.window
        }
    };
}
pub(super) use any_run_fields;
