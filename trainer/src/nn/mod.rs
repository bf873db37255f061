//! Networks: flat parameters, fused layers with hand-written gradients, the same layers on a candle device, the optimiser.

pub mod adam;
pub mod device;
pub mod graph;
pub mod kernel;
pub mod net;
#[cfg(test)]
mod oracle;
pub mod pack;
pub mod parallel;
pub mod params;
pub mod stack;
pub mod vector;

pub use adam::{Adam, AdamConfig, Decay};
pub use device::Engine;
pub use graph::{DenseParams, Graph, Packed, Slot, Weights, Workspace, argmax, declare_dense};
pub use net::Net;
pub use params::{ImportError, Init, ParamLayout, Params};
pub use stack::{Stack, normal};
