//! Kernels and their contracts. All are integer only, so every build gives the same bits.
//!
//! `load` guarantees, per layer: rows padded to 4 and columns to 16 in the stream; weights in -127..=127, padding zero;
//! no accumulator of an `a` row reaches 2^23, no `SMMLAR` result reaches 2^30, for any activation in range. Activations
//! are `i16`, two to a word, low half first, so that a kernel may read them in natural order. A kernel may use any order
//! of summation: sums wrap, and only the final value is bounded.
#![deny(clippy::float_arithmetic)]

mod dense;
mod exp2;

pub use dense::{block_len, hidden_layer, linear_layer, modulated_layer};
pub use exp2::{ONE, exp2_neg};
