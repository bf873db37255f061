//! Kernels and their contracts. All are integer only, so every build gives the same bits.
//!
//! `load` guarantees, per layer: rows padded to 4 and columns to 16 in the stream; weights in -127..=127, padding zero;
//! no accumulator of an `a` row reaches 2^23, no `SMMLAR` result reaches 2^30, for any activation in range; differences
//! of logits below 2^31. Activations are `i16`, two to a word, low half first, so that a kernel may read them in natural
//! order. A kernel may use any order of summation: sums wrap, and only the final value is bounded.
//!
//! Targets of the Armv7E-M architecture (Cortex-M4 and M7, `thumbv7em-*`) use the kernels of `armv7em.rs`, all others
//! those of [`portable`]. The choice is made in `build.rs`, because the name of the architecture is not visible to `cfg`.
#![deny(clippy::float_arithmetic)]

#[cfg(armv7em)]
mod armv7em;
mod dense;
mod exp2;
pub mod portable;

#[cfg(armv7em)]
pub use armv7em::exp2_below;
pub(crate) use dense::layer;
pub use dense::{block_len, hidden_layer, linear_layer, modulated_layer};
pub use exp2::{ONE, exp2_neg};
#[cfg(not(armv7em))]
pub use portable::exp2_below;
