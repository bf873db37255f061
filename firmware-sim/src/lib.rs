//! Software in the loop: a policy node drives a simulated plant over a CAN bus, in virtual time.
//!
//! The plant is an environment of `gadm-envs`, the node is `gadm-node`, and all that passes between them are frames. A
//! run is a function of policy, plant, profile and seed: the same seed gives the same trace, byte for byte, and in
//! profile `fd-f32` the same returns as `gadm eval` on the policy file, bit for bit.
//!
//! ```no_run
//! use gadm_sim::{RunOptions, run};
//!
//! # fn main() -> Result<(), gadm_sim::SimError> {
//! let result = run(&RunOptions { episodes: 5, seed: 1, ..RunOptions::new("policy.bin") })?;
//! println!("{:.1} ± {:.1}", result.returns.mean, result.returns.sd);
//! # Ok(())
//! # }
//! ```
//!
//! | module | holds |
//! | --- | --- |
//! | [`sil`] | the loop |
//! | [`plant_node`], [`host`] | the other two participants |
//! | [`target`], [`rung`] | where the node runs, and over which bus |
//! | [`bus`] | loopback, candump traces, load |
//! | [`fault`], [`scenario`], [`campaign`] | what goes wrong, what to run and what must hold; many of them |
//! | [`soak`] | a long run |
//! | [`dbc`] | the messages of a policy as a CAN database |
//! | [`install`] | a new policy for a node, over its bus |
//! | [`decode`] | frames as named signals |
//! | `mcap` | a trace for Foxglove (feature `mcap`) |
//! | [`replay`] | a trace through the policy again |
//! | [`result`] | what a run found out |
//! | [`report`] | pages that show it |
//! | [`monitor`] | a bus as a person watches it |

#![cfg_attr(test, allow(clippy::unwrap_used, reason = "a test may fail loudly"))]

pub mod bus;
pub mod campaign;
pub mod dbc;
pub mod decode;
mod error;
pub mod fault;
pub mod host;
pub mod install;
pub mod interface;
#[cfg(feature = "mcap")]
pub mod mcap;
pub mod monitor;
pub mod plant_node;
pub mod replay;
pub mod report;
pub mod result;
pub mod rung;
pub mod scenario;
pub mod sil;
pub mod soak;
pub mod target;

pub use bus::load::BitRate;
pub use error::SimError;
pub use gadm_envs::episode_seed;
pub use gadm_node::Profile;
pub use result::{EpisodeResult, ReturnSummary, RunResult};
pub use sil::{Progress, RunOptions, run, run_with_progress, simulate};
