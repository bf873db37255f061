//! Argmax over the allowed latents; ties go to the lowest.

use crate::mask::LatentMask;
use core::hint::select_unpredictable;

/// The largest value so far and where it is. Four values a turn of two loops below: on a Cortex-M a turn costs as much as
/// half a value.
#[derive(Clone, Copy)]
struct Best {
    value: i32,
    index: u16,
}

impl Best {
    #[inline(always)]
    fn take(&mut self, value: i32, index: u16) {
        if value > self.value {
            *self = Self { value, index };
        }
    }
}

/// Latent and logit of the largest of the allowed `logits` (`i32` as words, above `i32::MIN`).
pub(crate) fn masked_argmax(logits: &[u32], allowed: &LatentMask) -> (u16, i32) {
    let mut best = Best { value: i32::MIN, index: 0 };
    let mut first = 0u16;
    for (&bits, logits) in allowed.words().iter().zip(logits.chunks(32)) {
        let mut bits = bits;
        for &word in logits {
            // The time must not depend on the set.
            best.take(select_unpredictable(bits & 1 == 1, word.cast_signed(), i32::MIN), first);
            bits >>= 1;
            first = first.wrapping_add(1);
        }
    }
    (best.index, best.value)
}

/// Index and value of the largest logit, lowest on a tie; `(0, i32::MIN)` of none.
pub(crate) fn top(logits: &[u32]) -> (u16, i32) {
    let mut best = Best { value: i32::MIN, index: 0 };
    let mut first = 0u16;
    let (fours, rest) = logits.as_chunks::<4>();
    for four in fours {
        let [a, b, c, d] = four.map(u32::cast_signed);
        best.take(a, first);
        best.take(b, first.wrapping_add(1));
        best.take(c, first.wrapping_add(2));
        best.take(d, first.wrapping_add(3));
        first = first.wrapping_add(4);
    }
    for (&word, index) in rest.iter().zip(first..) {
        best.take(word.cast_signed(), index);
    }
    (best.index, best.value)
}

/// The largest logit; `i32::MIN` of none.
pub(crate) fn largest(logits: &[u32]) -> i32 {
    let (fours, rest) = logits.as_chunks::<4>();
    let mut best = i32::MIN;
    for four in fours {
        let [a, b, c, d] = four.map(u32::cast_signed);
        best = best.max(a).max(b).max(c).max(d);
    }
    rest.iter().fold(best, |best, word| best.max(word.cast_signed()))
}

#[cfg(test)]
mod tests {
    use super::{largest, masked_argmax, top};
    use crate::mask::LatentMask;

    fn words(values: &[i32]) -> std::vec::Vec<u32> {
        values.iter().map(|value| value.cast_unsigned()).collect()
    }

    #[test]
    fn ties_go_to_the_lowest() {
        assert_eq!(top(&words(&[-3, 5, 5, 1])), (1, 5));
        assert_eq!(top(&words(&[i32::MIN, i32::MIN])), (0, i32::MIN));
        assert_eq!(masked_argmax(&words(&[-3, 5, 5, 1]), &LatentMask::full(4)), (1, 5));
    }

    #[test]
    fn every_place_of_every_length_is_found() {
        for len in 1..=70usize {
            for (place, index) in (0..len).zip(0_u16..) {
                let mut values = std::vec![-7; len];
                values[place] = -3;
                let values = words(&values);
                let found = (index, -3);
                assert_eq!(top(&values), found);
                assert_eq!(largest(&values), -3);
                assert_eq!(masked_argmax(&values, &LatentMask::full(70)), found);
            }
        }
    }

    #[test]
    fn latents_outside_of_the_set_do_not_count() {
        let mut allowed = LatentMask::empty();
        allowed.insert(0);
        allowed.insert(3);
        assert_eq!(masked_argmax(&words(&[-3, 5, 5, -2]), &allowed), (3, -2));
    }
}
