//! Learns GADM action discretisations and DQN policies, and exports them for microcontrollers.

pub mod action_space;
pub mod algo;
pub mod atomic;
pub mod bench;
pub mod card;
pub mod config;
pub mod discretizer;
pub mod error;
pub mod explain;
pub mod export;
pub mod metrics;
pub mod nn;
pub mod paper;
pub mod plot;
pub mod replay;
pub mod report;
pub mod runner;
pub mod seed;

pub use error::TrainError;
