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

use crate::schema::padded;

const ACC_LEN: usize = 16;
const MP_LEN: usize = 32;
/// Bits of a logit.
const LINEAR: u32 = 32;

/// Bytes of one block of a layer with `cols` columns.
#[must_use]
pub const fn block_len(cols: u16, modulated: bool) -> usize {
    let weights = padded(cols as usize, 16).wrapping_mul(4);
    weights.wrapping_add(if modulated { ACC_LEN } else { ACC_LEN + MP_LEN })
}

/// Whether `bytes` holds `blocks` parts of `len` bytes and starts at a multiple of 4 in memory.
fn holds(bytes: &[u8], blocks: usize, len: usize) -> bool {
    blocks.checked_mul(len).is_some_and(|len| len <= bytes.len()) && bytes.as_ptr().addr().is_multiple_of(4)
}

/// Whether there is an activation for every column, the padding included.
fn covers(x: &[u32], cols: u16) -> bool {
    cols > 0 && x.len() >= padded(cols.into(), 16) / 2
}

/// One layer of any kind: activations `x` to activations of `bits` bits (8 or 10, with the ReLU, two words of `out` a
/// block) or to `i32` logits (`bits` 32, four words a block, not modulated). Multipliers and offsets are in the stream, or
/// in `modulation`, the table of one latent (32 bytes a block).
#[inline(always)]
pub(crate) fn layer(stream: &[u8], cols: u16, bits: u32, modulation: Option<&[u8]>, x: &[u32], out: &mut [u32]) {
    let words = if bits == LINEAR { 4 } else { 2 };
    let blocks = out.len() / words;
    let known = bits == 8 || bits == 10 || (bits == LINEAR && modulation.is_none());
    let constants = modulation.is_none_or(|table| holds(table, blocks, MP_LEN));
    let fits = covers(x, cols) && holds(stream, blocks, block_len(cols, modulation.is_some()));
    if known && constants && fits {
        kernel::layer(stream, cols, bits, modulation, x, out);
    } else {
        out.fill(0);
    }
}

/// A ReLU layer: activations `x` to activations of `bits` bits (8 or 10), two words of `out` a block.
pub fn hidden_layer(stream: &[u8], cols: u16, bits: u32, x: &[u32], out: &mut [u32]) {
    layer(stream, cols, if bits == LINEAR { 0 } else { bits }, None, x, out);
}

/// A ReLU layer whose multipliers and offsets come from `modulation`, the table of one latent (32 bytes a block).
pub fn modulated_layer(stream: &[u8], cols: u16, bits: u32, modulation: &[u8], x: &[u32], out: &mut [u32]) {
    layer(stream, cols, bits, Some(modulation), x, out);
}

/// A linear layer: activations `x` to `i32` logits, stored as words, four a block.
pub fn linear_layer(stream: &[u8], cols: u16, x: &[u32], out: &mut [u32]) {
    layer(stream, cols, LINEAR, None, x, out);
}

#[cfg(test)]
mod tests {
    use super::{MP_LEN, block_len, hidden_layer, linear_layer, modulated_layer};
    use crate::kernels::{exp2_below, exp2_neg};
    use proptest::prelude::*;

    /// Words, so that the bytes start at a multiple of 4.
    fn bytes(words: &[u32]) -> std::vec::Vec<u8> {
        words.iter().flat_map(|word| word.to_le_bytes()).collect()
    }

    /// A block of 3 columns whose outputs are not zero, and what is written for a given cut and shift of its stream.
    fn outputs(stream: &[u8], table: &[u8], cols: u16, bits: u32, x: &[u32]) -> [bool; 3] {
        let (mut hidden, mut modulated, mut linear) = ([7; 2], [7; 2], [7; 4]);
        hidden_layer(stream, cols, bits, x, &mut hidden);
        modulated_layer(stream, cols, bits, table, x, &mut modulated);
        linear_layer(stream, cols, x, &mut linear);
        [hidden != [0; 2], modulated != [0; 2], linear != [0; 4]]
    }

    #[test]
    fn what_a_kernel_relies_on_is_checked() {
        let words = std::vec![0x0101_0101; block_len(3, false) / 4 + 1];
        let stream = bytes(&words);
        let table = bytes(&[0x1000_0000; MP_LEN / 4 + 1]);
        let start = stream.as_ptr().addr().next_multiple_of(4) - stream.as_ptr().addr();
        let stream = &stream[start..][..block_len(3, false)];
        let start = table.as_ptr().addr().next_multiple_of(4) - table.as_ptr().addr();
        let table = &table[start..][..MP_LEN];
        let x = [0x0010_0010; 8];
        assert_eq!(outputs(stream, table, 3, 8, &x), [true; 3]);
        assert_eq!(outputs(stream, table, 3, 10, &x), [true; 3]);
        // No such width of an activation; a linear layer has none.
        assert_eq!(outputs(stream, table, 3, 9, &x), [false, false, true]);
        assert_eq!(outputs(stream, table, 0, 8, &x), [false; 3]);
        // Columns beyond the stream, inputs that miss the padding.
        assert_eq!(outputs(stream, table, 17, 8, &[0; 16]), [false; 3]);
        assert_eq!(outputs(stream, table, 3, 8, &x[..7]), [false; 3]);
        // A byte short; the block of a modulated layer is shorter.
        let short = &stream[..stream.len() - 1];
        assert_eq!(outputs(short, table, 3, 8, &x), [false, true, false]);
        assert_eq!(outputs(&stream[..block_len(3, true) - 1], table, 3, 8, &x), [false; 3]);
        assert_eq!(outputs(stream, &table[..MP_LEN - 1], 3, 8, &x), [true, false, true]);
        // Not at a multiple of 4.
        let long = bytes(&std::vec![0x0101_0101; 64]);
        let start = long.as_ptr().addr().next_multiple_of(4) - long.as_ptr().addr();
        assert_eq!(outputs(&long[start + 2..], table, 3, 8, &x), [false; 3]);
        assert_eq!(outputs(&long[start + 4..], table, 3, 8, &x), [true; 3]);
    }

    proptest! {
        #[test]
        fn lists_of_exponentials_are_single_ones(
            logits in proptest::collection::vec(-(1i32 << 30) + 1..1 << 30, 0..70), frac_bits in 0u32..=24
        ) {
            let top = logits.iter().copied().max().unwrap_or(0);
            let mut found: std::vec::Vec<u32> = logits.iter().map(|logit| logit.cast_unsigned()).collect();
            exp2_below(&mut found, top, frac_bits);
            for (logit, e) in logits.iter().zip(found) {
                prop_assert_eq!(e, exp2_neg(top.wrapping_sub(*logit).cast_unsigned(), frac_bits));
            }
        }
    }
}
