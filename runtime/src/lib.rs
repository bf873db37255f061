#![doc = include_str!("../README.md")]
#![no_std]
#![cfg_attr(not(armv7em), forbid(unsafe_code))]
#![cfg_attr(armv7em, deny(unsafe_code))]
#![warn(
    clippy::indexing_slicing,
    clippy::expect_used,
    clippy::panic,
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss
)]
#![cfg_attr(
    test,
    allow(
        clippy::indexing_slicing,
        clippy::expect_used,
        clippy::panic,
        clippy::unwrap_used,
        clippy::cast_possible_truncation,
        clippy::cast_precision_loss,
        clippy::cast_sign_loss,
        reason = "tests may panic and compute on the host"
    )
)]

#[cfg(any(test, feature = "encode"))]
#[cfg_attr(test, macro_use)]
extern crate std;

mod argmax;
mod crc;
mod decision;
mod decoder;
#[cfg(feature = "encode")]
pub mod encode;
mod error;
mod fields;
#[cfg(feature = "float")]
mod float;
#[cfg(feature = "float")]
mod float_heads;
mod image;
mod interface;
pub mod kernels;
mod load;
mod load_net;
mod mask;
mod net;
mod policy;
mod prove;
mod provenance;
pub mod quant;
mod reader;
pub mod schema;
mod scratch;
mod self_test;
mod sizes;
pub mod space;

pub use decision::Decision;
#[cfg(any(feature = "encode", feature = "float"))]
pub use decision::FloatDecision;
pub use error::{ActError, LoadError, SelfTestError};
#[cfg(feature = "float")]
pub use float::FloatPolicy;
pub use interface::{ActionSignal, ObservationSignal};
pub use mask::LatentMask;
pub use policy::{InputQuantiser, Policy};
pub use provenance::{Provenance, ReturnStats};
pub use schema::{Header, PolicySpec, Section, WeightKind};
pub use scratch::{Scratch, scratch_words, scratch_words_float};
pub use sizes::{LayerShape, SectionSizes};
pub use space::ActionHead;
