//! The kernels in portable Rust: the reference of every other one, and the kernels of all targets that have no other.

use super::exp2::exp2_neg;
use crate::quant::{requantise, smmlar};

/// `[256 A0, B0, 256 A1, B1]` of one block: start values and weights against activations.
#[inline(always)]
fn sums(start: [i32; 4], weights: &[u8], x: &[u32]) -> [i32; 4] {
    let (columns, _) = weights.as_chunks::<64>();
    let (x, _) = x.as_chunks::<8>();
    let [mut raw0, mut b0, mut raw1, mut b1] = start;
    // One word of each pair per word of x. Independent lanes let a vectorising compiler use multiply-add of pairs.
    let mut raw = [0i32; 16];
    let mut low = [0i32; 16];
    for (columns, x) in columns.iter().zip(x) {
        let (words, _) = columns.as_chunks::<4>();
        let mut lanes = [0i16; 32];
        for (lane, &[w0, w1, w2, w3]) in lanes.as_chunks_mut::<2>().0.iter_mut().zip(words) {
            *lane = [i16::from_le_bytes([w0, w1]), i16::from_le_bytes([w2, w3])];
        }
        let mut values = [0i16; 32];
        for (value, &x) in values.as_chunks_mut::<4>().0.iter_mut().zip(x) {
            let [x0, x1, x2, x3] = x.to_le_bytes();
            let (even, odd) = (i16::from_le_bytes([x0, x1]), i16::from_le_bytes([x2, x3]));
            *value = [even, odd, even, odd];
        }
        for (((raw, low), &[w0, w1]), &[x0, x1]) in
            raw.iter_mut().zip(low.iter_mut()).zip(lanes.as_chunks::<2>().0).zip(values.as_chunks::<2>().0)
        {
            let whole = mul(w0, x0).wrapping_add(mul(w1, x1));
            let half = mul(low_byte(w0), x0).wrapping_add(mul(low_byte(w1), x1));
            *raw = raw.wrapping_add(whole);
            *low = low.wrapping_add(half);
        }
    }
    for &[pair0, pair1] in raw.as_chunks::<2>().0 {
        raw0 = raw0.wrapping_add(pair0);
        raw1 = raw1.wrapping_add(pair1);
    }
    for &[pair0, pair1] in low.as_chunks::<2>().0 {
        b0 = b0.wrapping_add(pair0);
        b1 = b1.wrapping_add(pair1);
    }
    [raw0.wrapping_sub(b0), b0, raw1.wrapping_sub(b1), b1]
}

#[inline(always)]
fn mul(w: i16, x: i16) -> i32 {
    i32::from(w).wrapping_mul(i32::from(x))
}

/// The `b` weight of a lane, sign-extended.
#[inline(always)]
fn low_byte(lane: i16) -> i16 {
    let [low, _] = lane.to_le_bytes();
    i16::from(low.cast_signed())
}

#[inline(always)]
fn four(words: [[u8; 4]; 4]) -> [i32; 4] {
    words.map(i32::from_le_bytes)
}

/// Four words of 32 bits off the front.
#[inline(always)]
fn take_four(bytes: &[u8]) -> ([i32; 4], &[u8]) {
    match bytes.split_first_chunk::<16>() {
        Some((head, rest)) => {
            let mut words = [[0; 4]; 4];
            for (word, bytes) in words.iter_mut().zip(head.as_chunks::<4>().0) {
                *word = *bytes;
            }
            (four(words), rest)
        }
        None => ([0; 4], bytes),
    }
}

/// Weights of one block off the front.
#[inline(always)]
fn take_weights(bytes: &[u8], cols: u16) -> (&[u8], &[u8]) {
    bytes.split_at_checked(usize::from(cols).next_multiple_of(16).wrapping_mul(4)).unwrap_or_default()
}

/// Two activations in a word, the first in the low half.
#[inline(always)]
fn pack(first: i32, second: i32) -> u32 {
    (first.cast_unsigned() & 0xFFFF) | (second.cast_unsigned() << 16)
}

#[inline(always)]
fn store_hidden(bits: u32, acc: [i32; 4], m: [i32; 4], p: [i32; 4], out: &mut [u32; 2]) {
    let ([a0, b0, a1, b1], [ma0, mb0, ma1, mb1], [pa0, pb0, pa1, pb1]) = (acc, m, p);
    *out = [
        pack(requantise(bits, a0, ma0, pa0), requantise(bits, b0, mb0, pb0)),
        pack(requantise(bits, a1, ma1, pa1), requantise(bits, b1, mb1, pb1)),
    ];
}

/// A ReLU layer: activations `x` to activations of `bits` bits, two words of `out` a block.
pub fn hidden_layer(stream: &[u8], cols: u16, bits: u32, x: &[u32], out: &mut [u32]) {
    let mut stream = stream;
    for out in out.as_chunks_mut::<2>().0 {
        let (start, rest) = take_four(stream);
        let (weights, rest) = take_weights(rest, cols);
        let (m, rest) = take_four(rest);
        let (p, rest) = take_four(rest);
        stream = rest;
        store_hidden(bits, sums(start, weights, x), m, p, out);
    }
}

/// A ReLU layer whose multipliers and offsets come from `modulation`, the table of one latent.
pub fn modulated_layer(stream: &[u8], cols: u16, bits: u32, modulation: &[u8], x: &[u32], out: &mut [u32]) {
    let (mut stream, mut modulation) = (stream, modulation);
    for out in out.as_chunks_mut::<2>().0 {
        let (start, rest) = take_four(stream);
        let (weights, rest) = take_weights(rest, cols);
        stream = rest;
        let (m, rest) = take_four(modulation);
        let (p, rest) = take_four(rest);
        modulation = rest;
        store_hidden(bits, sums(start, weights, x), m, p, out);
    }
}

/// A linear layer: activations `x` to `i32` logits, stored as words, four a block.
pub fn linear_layer(stream: &[u8], cols: u16, x: &[u32], out: &mut [u32]) {
    let mut stream = stream;
    for out in out.as_chunks_mut::<4>().0 {
        let (start, rest) = take_four(stream);
        let (weights, rest) = take_weights(rest, cols);
        let (m, rest) = take_four(rest);
        let (p, rest) = take_four(rest);
        stream = rest;
        let acc = sums(start, weights, x);
        for (((out, acc), m), p) in out.iter_mut().zip(acc).zip(m).zip(p) {
            *out = smmlar(acc, m, p).cast_unsigned();
        }
    }
}

/// As `dense::layer`, whose checks have passed.
#[cfg(not(armv7em))]
pub(super) fn layer(stream: &[u8], cols: u16, bits: u32, modulation: Option<&[u8]>, x: &[u32], out: &mut [u32]) {
    match modulation {
        Some(table) => modulated_layer(stream, cols, bits, table, x, out),
        None if bits > 10 => linear_layer(stream, cols, x, out),
        None => hidden_layer(stream, cols, bits, x, out),
    }
}

/// Replaces logits (`i32` as words) by `2^-(top - logit)` as Q30; see [`exp2_neg`].
pub fn exp2_below(logits: &mut [u32], top: i32, frac_bits: u32) {
    for word in logits {
        *word = exp2_neg(top.wrapping_sub(word.cast_signed()).cast_unsigned(), frac_bits);
    }
}

#[cfg(test)]
mod tests {
    use super::{hidden_layer, linear_layer, modulated_layer, pack, sums};
    use crate::kernels::block_len;
    use std::vec::Vec;

    /// A block of one pair of columns (padded to 16): rows with weights (1, 2), (3, -4), (-5, 6), (127, -127), start
    /// values 10, 20, 30, 40, multipliers that pass the sums on, offsets 0, 1, 2, 3.
    fn block(constants: bool) -> Vec<u8> {
        let lane = |a: i16, b: i16| a * 256 + b;
        let mut bytes = Vec::new();
        for start in [10 * 256 + 20, 20, 30 * 256 + 40, 40i32] {
            bytes.extend(start.to_le_bytes());
        }
        for value in [lane(1, 3), lane(2, -4), lane(-5, 127), lane(6, -127)] {
            bytes.extend(value.to_le_bytes());
        }
        bytes.resize(16 + 64, 0);
        if constants {
            for word in [1 << 24, 1 << 30, 1 << 24, 1 << 30, 0, 1, 2, 3i32] {
                bytes.extend(word.to_le_bytes());
            }
        }
        bytes
    }

    fn input(first: i16, second: i16) -> [u32; 8] {
        let mut x = [0; 8];
        x[0] = pack(i32::from(first), i32::from(second));
        x
    }

    #[test]
    fn a_block_can_be_checked_by_hand() {
        let stream = block(true);
        assert_eq!(stream.len(), block_len(2, false));
        let mut out = [0u32; 4];
        linear_layer(&stream, 2, &input(100, -7), &mut out);
        // A0 = 10 + 100 - 14, B0 = 20 + 300 + 28, A1 = 30 - 500 - 42, B1 = 40 + 12700 + 889
        // times 2^24 * 256 / 2^32 = 1 in `a` rows and 1/4 in `b` rows, plus the offset.
        assert_eq!(out.map(u32::cast_signed), [96, 88, -510, 3410]);
    }

    #[test]
    fn hidden_outputs_are_shifted_clamped_and_packed() {
        let mut out = [0u32; 2];
        hidden_layer(&block(true), 2, 8, &input(100, -7), &mut out);
        assert_eq!(out, [6 | (5 << 16), 213 << 16]);
    }

    #[test]
    fn a_modulated_layer_takes_its_constants_from_the_table() {
        let stream = block(true);
        let mut plain = [0u32; 2];
        hidden_layer(&stream, 2, 10, &input(100, -7), &mut plain);
        let mut modulated = [0u32; 2];
        modulated_layer(&block(false), 2, 10, &stream[80..], &input(100, -7), &mut modulated);
        assert_eq!(plain, modulated);
    }

    #[test]
    fn sums_are_exact_when_the_raw_accumulator_wraps() {
        // a = 127, b = -127 in 16 columns of the largest input.
        let lane: i16 = 127 * 256 - 127;
        let weights: Vec<u8> = (0..32).flat_map(|_| lane.to_le_bytes()).collect();
        let (start_a, start_b) = (4_000_000i32, 2_000_000_000i32);
        let raw = (256 * start_a).wrapping_add(start_b);
        let [a, b, ..] = sums([raw, start_b, 0, 0], &weights, &[pack(2047, 2047); 8]);
        assert_eq!(a, 256 * (start_a + 16 * 127 * 2047));
        assert_eq!(b, start_b - 16 * 127 * 2047);
        assert!(a.checked_add(b).is_none(), "256 A + B does not fit, so the raw accumulator wrapped");
    }
}
