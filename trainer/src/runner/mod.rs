//! A training run: collection, updates, evaluation, checkpoints.

pub mod agent;
pub mod any;
pub mod averages;
pub mod baseline;
pub mod bookkeeping;
pub mod checkpoint;
pub mod evaluate;
pub mod origin;
pub mod progress;
pub mod run;
pub mod train;

pub use agent::Agent;
pub use any::{AnyRun, new_run};
pub use baseline::BaselineRun;
pub use evaluate::{
    Evaluation, check_fit, evaluate, evaluate_in, evaluate_policy, evaluate_policy_in, evaluate_recorded,
    evaluate_watched,
};
pub use run::Run;
pub use train::{Outcome, TrainOptions, train};
