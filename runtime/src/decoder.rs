//! Head values to actions: tanh, categorical expectation with snap, types and switches.

use crate::argmax::{largest, top};
use crate::interface::{ACTION_LEN, action_head};
use crate::kernels::{ONE, exp2_below};
use crate::net::{
    ENCODING_CATEGORICAL, ENCODING_SWITCH, ENCODING_TANH, ENCODING_TYPES, HEAD_LEN, SNAP_ANY, SNAP_EDGES,
};
use core::hint::select_unpredictable;

/// Gives `sink` one value per slot, in native units. `logits` are the rows of the head layer, `i32` as words, in log2
/// units with `frac_bits` fraction bits.
pub(crate) fn emit_heads(
    heads: &[[u8; HEAD_LEN]],
    actions: &[[u8; ACTION_LEN]],
    frac_bits: u32,
    logits: &mut [u32],
    mut sink: impl FnMut(usize, f32),
) {
    let mut rest = logits;
    for (slot, (head, record)) in heads.iter().zip(actions).enumerate() {
        let &[kind, snap, low, high] = head;
        let rows = usize::from(u16::from_le_bytes([low, high]));
        let (rows, after) = rest.split_at_mut_checked(rows).unwrap_or_default();
        rest = after;
        let raw = match kind {
            ENCODING_TANH => tanh(rows.first().map_or(0, |&word| word.cast_signed()), frac_bits),
            ENCODING_CATEGORICAL => categorical(rows, frac_bits, snap),
            ENCODING_TYPES => f32::from(top(rows).0),
            ENCODING_SWITCH => f32::from(u8::from(rows.first().is_some_and(|&word| word.cast_signed() > 0))),
            _ => 0.0,
        };
        sink(slot, action_head(record).denormalise(raw));
    }
}

/// `tanh` of a logit: `(1 - e) / (1 + e)` with `e = exp(-2 |l|)`, the exponential in fixed point and one division.
fn tanh(logit: i32, frac_bits: u32) -> f32 {
    // The logit is below 2^30 in magnitude.
    let mut e = [0u32.wrapping_sub(logit.unsigned_abs().wrapping_mul(2))];
    exp2_below(&mut e, 0, frac_bits);
    let [e] = e;
    signed(u64::from(ONE.wrapping_sub(e)), u64::from(ONE.wrapping_add(e)), logit < 0)
}

/// Expectation of the softmax over atoms at `-1 + 2 j / (J - 1)`, or an atom itself under the snap rule. No branch
/// depends on the logits: the expectation is always computed.
///
/// Source: GADM paper, extreme action regression; probability 0.9 or more snaps.
fn categorical(logits: &mut [u32], frac_bits: u32, snap: u8) -> f32 {
    let last = u32::try_from(logits.len()).unwrap_or(u32::MAX).wrapping_sub(1);
    exp2_below(logits, largest(logits), frac_bits);
    let (sum, moment) = moments(logits);
    // The atom of the largest logit, if the rule allows it. Only that atom can hold 0.9; there is one such atom then.
    let (found, atom) = match snap {
        SNAP_ANY => (true, first_one(logits)),
        SNAP_EDGES => {
            let is_one = |e: Option<&u32>| e.copied().unwrap_or(0) == ONE;
            let low = is_one(logits.first());
            let high = is_one(logits.last());
            (low | high, select_unpredictable(low, 0, last))
        }
        _ => (false, 0),
    };
    let sure = u64::from(ONE).wrapping_mul(10) >= sum.wrapping_mul(9);
    let snaps = found & sure;
    let (last, atom) = (u64::from(last), u64::from(atom));
    // sum_j e_j (2 j - last) / (last * sum_j e_j), and atom j at (2 j - last) / last, which is its e_j alone.
    let twice = select_unpredictable(snaps, atom, moment).wrapping_mul(2);
    let scale = select_unpredictable(snaps, 1, sum);
    let centre = scale.wrapping_mul(last);
    signed(twice.abs_diff(centre), centre, twice < centre)
}

/// Index of the first exponential that is 1.
fn first_one(exponentials: &[u32]) -> u32 {
    let (mut first, mut j) = (0, u32::try_from(exponentials.len()).unwrap_or(u32::MAX));
    for &e in exponentials.iter().rev() {
        j = j.wrapping_sub(1);
        if e == ONE {
            first = j;
        }
    }
    first
}

/// `sum_j e_j` and `sum_j j e_j`, by sums from the end: the sum of all partial sums but the last is the moment.
fn moments(exponentials: &[u32]) -> (u64, u64) {
    let (mut sum, mut moment) = (0u64, 0u64);
    let mut add = |e: u32| {
        moment = moment.wrapping_add(sum);
        sum = sum.wrapping_add(u64::from(e));
    };
    let (rest, fours) = exponentials.as_rchunks::<4>();
    for &[a, b, c, d] in fours.iter().rev() {
        add(d);
        add(c);
        add(b);
        add(a);
    }
    for &e in rest.iter().rev() {
        add(e);
    }
    (sum, moment)
}

/// `n / d`, negated where `negative`, as the quotient of the nearest `f32`s: both conversions and the division are IEEE,
/// so the bits are the same everywhere. 0 for `d = 0`.
#[expect(clippy::cast_precision_loss, reason = "rounds to the nearest f32, as stated")]
fn signed(n: u64, d: u64, negative: bool) -> f32 {
    let quotient = n as f32 / d.max(1) as f32;
    f32::from_bits(quotient.to_bits() | (u32::from(negative) << 31))
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
