//! Mask and heads in `f32`, the counterpart of `mask.rs` and `decoder.rs`.

use crate::interface::{ACTION_LEN, action_head};
use crate::mask::LatentMask;
use crate::net::{ENCODING_CATEGORICAL, ENCODING_SWITCH, ENCODING_TANH, ENCODING_TYPES, Net, SNAP_ANY, SNAP_EDGES};

/// Index and value of the largest of `values`, lowest index on a tie.
pub(crate) fn argmax(values: impl Iterator<Item = (u16, f32)>) -> (u16, f32) {
    values.fold((0, f32::NEG_INFINITY), |best, next| if next.1 > best.1 { next } else { best })
}

/// Replaces logits by `exp(logit - largest)` and returns the sum.
fn exponentials(logits: &mut [f32]) -> f32 {
    let top = logits.iter().copied().fold(f32::NEG_INFINITY, |a, b| if b > a { b } else { a });
    let mut sum = 0.0;
    for value in logits.iter_mut() {
        *value = libm::expf(*value - top);
        sum += *value;
    }
    sum
}

/// The allowed set and whether the empty-mask rule made it; `logits` are overwritten.
pub(crate) fn allowed((num, den): (u32, u32), logits: &mut [f32]) -> (LatentMask, bool) {
    let best = argmax((0u16..).zip(logits.iter().copied())).0;
    let sum = exponentials(logits);
    #[expect(clippy::cast_precision_loss, reason = "at most 2^24, so exact")]
    let (num, den) = (num as f32, den as f32);
    let mut mask = LatentMask::empty();
    for (latent, e) in (0u16..).zip(logits.iter()) {
        if e * den > sum * num {
            mask.insert(latent);
        }
    }
    if !mask.is_empty() {
        return (mask, false);
    }
    let least = logits.iter().copied().fold(f32::INFINITY, |a, b| if b < a { b } else { a });
    if 1.0 - least < 1e-6 * sum {
        return (LatentMask::full(crate::reader::short(logits.len())), true);
    }
    mask.insert(best);
    (mask, true)
}

/// Gives `sink` one value per slot, in native units; a table decoder has no logits.
pub(crate) fn emit(
    decoder: &Net<'_>,
    actions: &[[u8; ACTION_LEN]],
    latent: u16,
    logits: &mut [f32],
    sink: &mut dyn FnMut(usize, f32),
) {
    let mut rest = logits;
    for (slot, (head, record)) in decoder.slots(latent, actions.len()).iter().zip(actions).enumerate() {
        let &[kind, snap, low, high] = head;
        let raw = if decoder.layers.is_empty() {
            f32::from_le_bytes(*head)
        } else {
            let rows = usize::from(u16::from_le_bytes([low, high]));
            let (rows, after) = rest.split_at_mut_checked(rows).unwrap_or_default();
            rest = after;
            let first = rows.first().copied().unwrap_or_default();
            match kind {
                ENCODING_TANH => libm::tanhf(first),
                ENCODING_CATEGORICAL => categorical(rows, snap),
                ENCODING_TYPES => f32::from(argmax((0u16..).zip(rows.iter().copied())).0),
                ENCODING_SWITCH => f32::from(u8::from(first > 0.0)),
                _ => 0.0,
            }
        };
        sink(slot, action_head(record).denormalise(raw));
    }
}

/// Expectation over atoms on -1..=1, or an atom of probability 0.9 or more under the snap rule.
fn categorical(logits: &mut [f32], snap: u8) -> f32 {
    let last = crate::reader::short(logits.len().saturating_sub(1));
    let support = |j: u16| -1.0 + 2.0 * f32::from(j) / f32::from(last);
    let atom = argmax((0u16..).zip(logits.iter().copied())).0;
    let sum = exponentials(logits);
    let snaps = snap == SNAP_ANY || (snap == SNAP_EDGES && (atom == 0 || atom == last));
    if snaps && 1.0 >= 0.9 * sum {
        return support(atom);
    }
    (0u16..).zip(logits.iter()).map(|(j, e)| e * support(j)).sum::<f32>() / sum
}
