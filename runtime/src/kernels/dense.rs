//! Matrix-vector product on the fused int8 stream.
//!
//! A block holds 4 output rows, as two pairs of an `a` and a `b` row:
//! `[raw0, b0, raw1, b1]` (i32 start values, raw = 256 a + b), then per two columns one word of each pair, each 16-bit
//! lane being `256 a + b`, then `[M x 4]` and `[P x 4]` (i32) unless the layer is modulated. With activations x,
//! `raw += lane * x` collects `256 A + B` and `b += (lane as i8) * x` collects `B`; the difference is `256 A` exactly,
//! even when `raw` wraps, as long as |A| < 2^23.
//!
//! The functions here check what a kernel relies on, so that they are safe to call with anything: where a stream or an
//! input is too short, a stream is not aligned to 4 bytes, or a width is none of the format's, the outputs are zero.

#[cfg(armv7em)]
use super::armv7em as kernel;
#[cfg(not(armv7em))]
use super::portable as kernel;

const ACC_LEN: usize = 16;
const MP_LEN: usize = 32;

/// Bytes of one block of a layer with `cols` columns.
#[must_use]
pub const fn block_len(cols: u16, modulated: bool) -> usize {
    let weights = (cols as usize).next_multiple_of(16).wrapping_mul(4);
    weights.wrapping_add(if modulated { ACC_LEN } else { ACC_LEN + MP_LEN })
}

/// Whether `bytes` holds `blocks` parts of `len` bytes and starts at a multiple of 4 in memory.
fn holds(bytes: &[u8], blocks: usize, len: usize) -> bool {
    blocks.checked_mul(len).is_some_and(|len| len <= bytes.len()) && bytes.as_ptr().addr().is_multiple_of(4)
}

/// Whether there is an activation for every column, the padding included.
fn covers(x: &[u32], cols: u16) -> bool {
    cols > 0 && x.len() >= usize::from(cols).next_multiple_of(16) / 2
}

/// A ReLU layer: activations `x` to activations of `bits` bits (8 or 10), two words of `out` a block.
pub fn hidden_layer(stream: &[u8], cols: u16, bits: u32, x: &[u32], out: &mut [u32]) {
    let blocks = out.as_chunks::<2>().0.len();
    if (bits == 8 || bits == 10) && covers(x, cols) && holds(stream, blocks, block_len(cols, false)) {
        kernel::hidden_layer(stream, cols, bits, x, out);
    } else {
        out.fill(0);
    }
}

/// A ReLU layer whose multipliers and offsets come from `modulation`, the table of one latent (32 bytes a block).
pub fn modulated_layer(stream: &[u8], cols: u16, bits: u32, modulation: &[u8], x: &[u32], out: &mut [u32]) {
    let blocks = out.as_chunks::<2>().0.len();
    let fits = holds(stream, blocks, block_len(cols, true)) && holds(modulation, blocks, MP_LEN);
    if (bits == 8 || bits == 10) && covers(x, cols) && fits {
        kernel::modulated_layer(stream, cols, bits, modulation, x, out);
    } else {
        out.fill(0);
    }
}

/// A linear layer: activations `x` to `i32` logits, stored as words, four a block.
pub fn linear_layer(stream: &[u8], cols: u16, x: &[u32], out: &mut [u32]) {
    let blocks = out.as_chunks::<4>().0.len();
    if covers(x, cols) && holds(stream, blocks, block_len(cols, false)) {
        kernel::linear_layer(stream, cols, x, out);
    } else {
        out.fill(0);
    }
}
