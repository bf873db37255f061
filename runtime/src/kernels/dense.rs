//! Matrix-vector product on the fused int8 stream, portable.
//!
//! A block holds 4 output rows, as two pairs of an `a` and a `b` row:
//! `[raw0, b0, raw1, b1]` (i32 start values, raw = 256 a + b), then per two columns one word of each pair, each 16-bit
//! lane being `256 a + b`, then `[M x 4]` and `[P x 4]` (i32) unless the layer is modulated. With activations x,
//! `raw += lane * x` collects `256 A + B` and `b += (lane as i8) * x` collects `B`; the difference is `256 A` exactly,
//! even when `raw` wraps, as long as |A| < 2^23.

use crate::quant::{requantise, smmlar};

const ACC_LEN: usize = 16;
const MP_LEN: usize = 32;

/// Bytes of one block of a layer with `cols` columns.
#[must_use]
pub const fn block_len(cols: u16, modulated: bool) -> usize {
    let weights = (cols as usize).next_multiple_of(16).wrapping_mul(4);
    weights.wrapping_add(if modulated { ACC_LEN } else { ACC_LEN + MP_LEN })
}

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
