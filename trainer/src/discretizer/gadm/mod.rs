//! GADM: the action model (encoder, code table, decoder) and the confidence predictor.

pub mod codetable;
pub mod confidence;
pub mod config;
pub mod loss;
pub mod model;

pub use confidence::Confidence;
pub use config::{ActionModelConfig, ConfidenceConfig, Fusion, Trunk};
pub use model::{ActionModel, ActionModelMetrics};
