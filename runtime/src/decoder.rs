//! Head values to actions: tanh, categorical expectation with snap, types and switches.

use crate::argmax::top;
use crate::interface::{ACTION_LEN, action_head};
use crate::kernels::{ONE, exp2_below};
use crate::net::{ENCODING_CATEGORICAL, ENCODING_TANH, ENCODING_TYPES, HEAD_LEN, Net, SNAP_ANY, SNAP_EDGES, SNAP_NONE};
use crate::reader::word;
use crate::space::ActionHead;
use core::hint::select_unpredictable;

/// Gives `sink` one value per slot, in native units. `logits` are the rows of the head layer, `i32` as words, in log2
/// units; a table decoder has none.
pub(crate) fn emit(
    decoder: &Net<'_>,
    actions: &[[u8; ACTION_LEN]],
    latent: u16,
    logits: &mut [u32],
    mut sink: impl FnMut(usize, f32),
) {
    let mut rest = logits;
    for (slot, (head, record)) in decoder.slots(latent, actions.len()).iter().zip(actions).enumerate() {
        let raw = if decoder.layers.is_empty() {
            f32::from_le_bytes(*head)
        } else {
            let &[.., low, high] = head;
            let rows = usize::from(u16::from_le_bytes([low, high]));
            let (rows, after) = core::mem::take(&mut rest).split_at_mut_checked(rows).unwrap_or_default();
            rest = after;
            value(*head, decoder.frac_bits, rows)
        };
        let value = match action_head(record) {
            head @ ActionHead::Continuous { .. } => head.denormalise(raw),
            ActionHead::Discrete { n } => index(raw, n),
            ActionHead::Binary => index(raw, 2),
        };
        sink(slot, value);
    }
}

/// One of `0.0, 1.0, ..., n - 1`; `raw` is that unless the file is wrong.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as it should")]
fn index(raw: f32, n: u16) -> f32 {
    f32::from((raw as u16).min(n.saturating_sub(1)))
}

/// What a head says, before its range.
fn value(head: [u8; HEAD_LEN], frac_bits: u32, logits: &mut [u32]) -> f32 {
    let [kind, snap, ..] = head;
    let first = logits.first().map_or(0, |&word| word.cast_signed());
    if kind == ENCODING_CATEGORICAL {
        categorical(logits, frac_bits, snap)
    } else if kind == ENCODING_TANH {
        tanh(first, frac_bits)
    } else {
        let index = if kind == ENCODING_TYPES { top(logits).0 } else { u16::from(first > 0) };
        f32::from(index)
    }
}

/// `tanh` of a logit below 2^30 in magnitude: the expectation over the atoms -1 and 1 at half the distance,
/// `(1 - e) / (1 + e)` with `e = exp(-2 |l|)` for a positive one.
fn tanh(logit: i32, frac_bits: u32) -> f32 {
    categorical(&mut [logit.wrapping_neg().cast_unsigned(), logit.cast_unsigned()], frac_bits, SNAP_NONE)
}

/// Expectation of the softmax over atoms at `-1 + 2 j / (J - 1)`, or an atom itself under the snap rule. No branch
/// depends on the logits: the expectation is always computed.
///
/// Source: GADM paper, extreme action regression; probability 0.9 or more snaps.
#[inline(never)]
#[expect(clippy::needless_bitwise_bool, reason = "a lazy operator is a branch")]
fn categorical(logits: &mut [u32], frac_bits: u32, snap: u8) -> f32 {
    let last = word(logits.len()).wrapping_sub(1);
    let (atom, largest) = top(logits);
    exp2_below(logits, largest, frac_bits);
    let (sum, moment) = moments(logits);
    // Only the largest atom can hold 0.9, and no other one is as large then.
    let atom = u32::from(atom);
    let allowed = (snap == SNAP_ANY) | ((snap == SNAP_EDGES) & ((atom == 0) | (atom == last)));
    let snaps = allowed & (u64::from(ONE).wrapping_mul(10) >= sum.wrapping_mul(9));
    // sum_j e_j (2 j - last) / (last * sum_j e_j), and atom j at (2 j - last) / last, which is its e_j alone.
    let twice = select_unpredictable(snaps, atom.into(), moment).wrapping_mul(2);
    let scale = select_unpredictable(snaps, 1, sum);
    let centre = scale.wrapping_mul(last.into());
    let quotient = nearest(twice.abs_diff(centre)) / nearest(centre.max(1));
    f32::from_bits(quotient.to_bits() | (u32::from(twice < centre) << 31))
}

/// `sum_j e_j` and `sum_j j e_j`.
fn moments(exponentials: &[u32]) -> (u64, u64) {
    let (mut sum, mut moment) = (0u64, 0u64);
    for (j, &e) in (0u32..).zip(exponentials) {
        sum = sum.wrapping_add(e.into());
        moment = moment.wrapping_add(u64::from(j).wrapping_mul(e.into()));
    }
    (sum, moment)
}

/// `n as f32`, the nearest one, in a third of the code that the compiler calls for it.
#[inline(never)]
#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    reason = "rounds to the nearest f32, as stated"
)]
fn nearest(n: u64) -> f32 {
    let (high, low) = ((n >> 32) as u32, n as u32);
    // The highest 32 bits; whether a bit was lost is left in the lowest, which is below what f32 keeps.
    let shift = 32u32.wrapping_sub(high.leading_zeros());
    let lost = low & 1u32.wrapping_shl(shift).wrapping_sub(1);
    let bits = (n >> shift) as u32 | u32::from(lost != 0);
    bits as f32 * f32::from_bits(shift.wrapping_add(127) << 23)
}

#[cfg(test)]
mod tests {
    use super::{categorical, moments, tanh};
    use crate::net::{SNAP_ANY, SNAP_EDGES, SNAP_NONE};
    use std::vec::Vec;

    const F: u32 = 20;

    fn fixed(l: f64) -> i32 {
        (l * std::f64::consts::LOG2_E * f64::from(1 << F)).round() as i32
    }

    fn logits(values: &[f64]) -> Vec<u32> {
        values.iter().map(|&l| fixed(l).cast_unsigned()).collect()
    }

    #[test]
    fn tanh_is_within_a_millionth() {
        for i in -4000..=4000 {
            let l = f64::from(i) / 400.0;
            assert!((f64::from(tanh(fixed(l), F)) - l.tanh()).abs() < 1e-6, "{l}");
        }
        assert_eq!(tanh(0, F), 0.0);
        assert_eq!(tanh(1 << 29, F), 1.0);
        assert_eq!(tanh(-(1 << 29), F), -1.0);
    }

    #[test]
    fn the_expectation_is_that_of_the_softmax() {
        let values = [0.3f64, -1.2, 2.0, 0.7, -0.1];
        let sum: f64 = values.iter().map(|l| l.exp()).sum();
        let mean: f64 = values.iter().enumerate().map(|(j, l)| l.exp() / sum * (j as f64 * 0.5 - 1.0)).sum();
        assert!((f64::from(categorical(&mut logits(&values), F, SNAP_ANY)) - mean).abs() < 1e-6);
        assert_eq!(categorical(&mut logits(&[1.0, 1.0, 1.0]), F, SNAP_NONE), 0.0);
    }

    /// Three atoms, the named one with probability `p`.
    fn with_probability(atom: usize, p: f64) -> Vec<u32> {
        let mut values = [((1.0 - p) / 2.0).ln(); 3];
        values[atom] = p.ln();
        logits(&values)
    }

    #[test]
    fn an_atom_of_nine_tenths_snaps_by_the_rule() {
        assert_eq!(categorical(&mut with_probability(2, 0.901), F, SNAP_EDGES), 1.0);
        assert_eq!(categorical(&mut with_probability(0, 0.901), F, SNAP_EDGES), -1.0);
        assert_eq!(categorical(&mut with_probability(1, 0.901), F, SNAP_ANY), 0.0);
        assert!((categorical(&mut with_probability(2, 0.901), F, SNAP_NONE) - 0.8515).abs() < 1e-4);
        assert!((categorical(&mut with_probability(2, 0.899), F, SNAP_EDGES) - 0.8485).abs() < 1e-4);
    }

    #[test]
    fn an_inner_atom_does_not_snap_by_the_edge_rule() {
        let mut values = [-3.0; 5];
        values[3] = 4.0;
        let expectation = categorical(&mut logits(&values), F, SNAP_EDGES);
        assert!(expectation != 0.5 && (expectation - 0.5).abs() < 0.01);
        assert_eq!(categorical(&mut logits(&values), F, SNAP_ANY), 0.5);
    }

    #[test]
    fn moments_are_those_of_the_definition() {
        for len in 0..12u32 {
            let values: Vec<u32> = (0..len).map(|j| j * j + 3).collect();
            let sum = values.iter().map(|&e| u64::from(e)).sum();
            let moment = (0u64..).zip(&values).map(|(j, &e)| j * u64::from(e)).sum();
            assert_eq!(moments(&values), (sum, moment));
        }
    }

    #[test]
    fn snapped_atoms_are_equally_spaced() {
        let snapped = |atom: usize| {
            let mut values = [-9.0; 5];
            values[atom] = 9.0;
            categorical(&mut logits(&values), F, SNAP_ANY)
        };
        assert_eq!([0, 1, 2, 3, 4].map(snapped), [-1.0, -0.5, 0.0, 0.5, 1.0]);
    }
}
