//! Environments of the GADM project: the tasks that are learned, and the plants that a policy drives over a bus.
//!
//! ```
//! # fn main() -> Result<(), gadm_envs::EnvError> {
//! let mut env = gadm_envs::make("moving")?;
//! let mut obs = vec![0.0; env.spec().obs_dim()];
//! env.reset(7, &mut obs);
//! let step = env.step(&[0.0, 1.0, 0.0], &mut obs); // type 0 accelerates, with full power
//! assert!(!step.terminated);
//! assert!(gadm_envs::make("hoper-v5").is_err());
//! # Ok(())
//! # }
//! ```
//!
//! [`make`] gives one environment by its id, [`VecEnv`] a row of them with automatic reset, and [`golden::check`]
//! replays recordings of the reference programs. Physics and rewards are computed in f64; observations, actions and
//! networks are f32. Which environment follows which reference, and where it differs, is in the book's page
//! "Environments".

mod classic;
mod env;
mod error;
pub mod golden;
mod hybrid;
#[cfg(feature = "box2d")]
mod lunar;
#[cfg(feature = "mujoco")]
mod mujoco;
mod registry;
pub mod render;
mod sampling;
mod seed;
mod task;
mod vec_env;
mod watched;
mod wrappers;

pub use classic::toy_dataset::{toy_dataset, toy_square};
pub use classic::toy_env::{RewardConvention, StartState, ToyOptions};
pub use env::{ActionSignal, ArgumentMask, Disturbance, Env, EnvSpec, EnvState, ObservationSignal, Step};
pub use error::EnvError;
#[cfg(feature = "mujoco")]
pub use mujoco::plant::warning_count as mujoco_warning_count;
pub use registry::{EnvOptions, ids, make, make_with};
pub use seed::episode_seed;
pub use vec_env::{EpisodeEnd, SlotState, StepBatch, VecEnv, VecEnvState, reset_seed};
pub use watched::{Watched, Watcher};
pub use wrappers::{ExtraDims, TimeLimit};
