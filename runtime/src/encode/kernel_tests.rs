//! The packed kernels against sums in `i64` that know nothing of packing.

use super::int_model::IntLayer;
use crate::kernels::{hidden_layer, linear_layer, modulated_layer};
use proptest::prelude::*;
use std::vec;
use std::vec::Vec;

/// Activations two to a word, with rubbish in the padding, which must not count.
fn packed(x: &[i16]) -> Vec<u32> {
    let mut x = x.to_vec();
    x.resize(x.len().next_multiple_of(16), 0x5555);
    x.chunks_exact(2)
        .map(|pair| u32::from(pair[0].cast_unsigned()) | u32::from(pair[1].cast_unsigned()) << 16)
        .collect()
}

/// `(256 A or B) * M`, rounded high word, plus P.
fn smmlar_oracle(layer: &IntLayer, constants: &[(i32, i32)], x: &[i16]) -> Vec<i64> {
    (0..layer.rows)
        .map(|row| {
            let weights = &layer.weights[row * layer.cols..(row + 1) * layer.cols];
            let sum: i64 = weights.iter().zip(x).map(|(w, x)| i64::from(*w) * i64::from(*x)).sum();
            let lift = if row % 2 == 0 { 256 } else { 1 };
            let acc = i64::from(layer.start[row]) + sum * lift;
            assert!(i32::try_from(acc).is_ok(), "the case must keep the bound");
            let (m, p) = constants[row];
            ((i128::from(acc) * i128::from(m) + (i128::from(p) << 32) + (1 << 31)) >> 32) as i64
        })
        .collect()
}

fn hidden_oracle(layer: &IntLayer, constants: &[(i32, i32)], x: &[i16]) -> Vec<u16> {
    let top = (1i64 << layer.bits) - 1;
    smmlar_oracle(layer, constants, x).iter().map(|v| (v >> 4).clamp(0, top) as u16).collect()
}

fn unpack(words: &[u32], rows: usize) -> Vec<u16> {
    words.iter().flat_map(|word| [*word as u16, (word >> 16) as u16]).take(rows).collect()
}

fn words(rows: usize) -> Vec<u32> {
    vec![0; rows.next_multiple_of(4) / 2]
}

fn layer(rows: usize, cols: usize, latents: usize) -> impl Strategy<Value = (IntLayer, Vec<i16>)> {
    let constant = (-(1i32 << 20)..1 << 20, -(1i32 << 12)..1 << 12);
    (
        proptest::collection::vec(-127i8..=127, rows * cols),
        proptest::collection::vec(-(1i32 << 20)..1 << 20, rows),
        proptest::collection::vec(proptest::collection::vec(constant, rows), latents),
        proptest::collection::vec(-2048i16..=2047, cols),
        prop_oneof![Just(8u16), Just(10u16)],
    )
        .prop_map(move |(weights, start, constants, x, bits)| {
            let start = start.iter().enumerate().map(|(row, s)| if row % 2 == 0 { s * 256 } else { *s }).collect();
            (IntLayer { rows, cols, bits, weights, start, constants }, x)
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    /// Every width from 1 to 17 columns and rows, odd ones included.
    #[test]
    fn every_small_shape_equals_the_oracle(seed_rows in 1usize..=17, (layer, x) in (1usize..=17).prop_flat_map(|cols| layer(17, cols, 2))) {
        for rows in [seed_rows, 17] {
            let mut part = layer.clone();
            part.rows = rows;
            part.weights.truncate(rows * part.cols);
            part.start.truncate(rows);
            part.constants.iter_mut().for_each(|list| list.truncate(rows));
            check(&part, &x);
        }
    }

    #[test]
    fn wide_layers_equal_the_oracle((layer, x) in (100usize..=200).prop_flat_map(|cols| layer(6, cols, 1))) {
        let mut layer = layer;
        layer.start.iter_mut().for_each(|start| *start = 0);
        // Keeps |A| below 2^23 for any draw.
        let x: Vec<i16> = x.iter().map(|x| x / 8).collect();
        check(&layer, &x);
    }
}

fn check(layer: &IntLayer, x: &[i16]) {
    let (stream, _) = layer.pack(false);
    let mut out = words(layer.rows);
    hidden_layer(&stream, layer.cols as u16, u32::from(layer.bits), &packed(x), &mut out);
    assert_eq!(unpack(&out, layer.rows), hidden_oracle(layer, &layer.constants[0], x));

    let mut logits = vec![0; layer.rows.next_multiple_of(4)];
    linear_layer(&stream, layer.cols as u16, &packed(x), &mut logits);
    let found: Vec<i64> = logits.iter().take(layer.rows).map(|word| i64::from(word.cast_signed())).collect();
    assert_eq!(found, smmlar_oracle(layer, &layer.constants[0], x));

    let (stream, table) = layer.pack(true);
    let len = table.len() / layer.constants.len();
    for (latent, constants) in layer.constants.iter().enumerate() {
        modulated_layer(
            &stream,
            layer.cols as u16,
            u32::from(layer.bits),
            &table[latent * len..],
            &packed(x),
            &mut out,
        );
        assert_eq!(unpack(&out, layer.rows), hidden_oracle(layer, constants, x));
    }
}

#[test]
fn all_shapes_up_to_17_by_17() {
    let mut state = 1u32;
    let mut next = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state >> 8
    };
    for rows in 1..=17 {
        for cols in 1..=17 {
            let weights = (0..rows * cols).map(|_| (next() % 255) as i8).map(|w| w.max(-127)).collect();
            let start = (0..rows).map(|row| (next() % 100_000) as i32 * if row % 2 == 0 { 256 } else { 1 } / 16 * 16);
            let start: Vec<i32> =
                start.enumerate().map(|(row, s)| if row % 2 == 0 { s / 256 * 256 } else { s }).collect();
            let constants = vec![(0..rows).map(|_| (next() as i32 % 200_000, 8)).collect()];
            let layer = IntLayer { rows, cols, bits: 10, weights, start, constants };
            let x: Vec<i16> = (0..cols).map(|_| (next() % 4096) as i16 - 2048).collect();
            check(&layer, &x);
        }
    }
}

/// Raw accumulators wrap again and again; the difference stays exact.
#[test]
fn forced_wraps_do_not_change_a_result() {
    let mut wrapped = 0;
    for bias in [-8_000_000i32, -1_000_000, 0, 1_000_000, 8_000_000] {
        for b_start in [-2_000_000_000i32, -5, 2_000_000_000] {
            let cols = 32;
            let weights: Vec<i8> =
                (0..4 * cols).map(|i| if i % 5 == 0 { 127 } else { -127 + (i % 250) as i8 % 100 }).collect();
            let start = vec![bias * 256, b_start, bias * 256, -b_start];
            let constants = vec![vec![(1 << 20, 8), (1 << 12, 8), (-(1 << 20), 8), (-(1 << 12), 8)]];
            let layer = IntLayer { rows: 4, cols, bits: 10, weights, start, constants };
            wrapped += usize::from((bias * 256).checked_add(b_start).is_none());
            check(&layer, &vec![37; cols]);
        }
    }
    assert!(wrapped >= 4, "only {wrapped} of the starts wrap");
}
