//! `no_std` inference of one GADM policy.
#![no_std]
#![forbid(unsafe_code)]

#[cfg(feature = "encode")]
extern crate std;

#[cfg(feature = "encode")]
pub mod encode;
mod error;
mod interface;
mod mask;
mod policy;
mod provenance;
pub mod schema;
mod scratch;
pub mod space;

pub use error::{ActError, LoadError, SelfTestError};
pub use interface::{ActionSignal, ObservationSignal};
pub use mask::LatentMask;
pub use policy::{Decision, Policy};
pub use provenance::{Provenance, ReturnStats};
pub use schema::{Header, PolicySpec, WeightKind};
pub use scratch::{Scratch, scratch_words};
pub use space::ActionHead;
