//! Networks: flat parameters, fused layers with hand-written gradients, the optimiser, and candle as their oracle.

pub mod adam;
pub mod gemm;
pub mod graph;
pub mod oracle;
pub mod params;

pub use adam::{Adam, AdamConfig};
pub use graph::{DenseParams, Graph, Slot, Workspace, argmax, declare_dense};
pub use params::{ImportError, Init, ParamLayout, Params};
