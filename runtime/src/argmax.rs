//! Argmax over the allowed latents; ties go to the lowest.

use crate::mask::LatentMask;
use core::hint::select_unpredictable;

/// Latent and logit of the largest of the allowed `logits` (`i32` as words, above `i32::MIN`); the others become `i32::MIN`.
pub(crate) fn masked_argmax(logits: &mut [u32], allowed: &LatentMask) -> (u16, i32) {
    for (&bits, logits) in allowed.words().iter().zip(logits.chunks_mut(32)) {
        let mut bits = bits;
        for word in logits {
            // The time must not depend on the set.
            *word = select_unpredictable(bits & 1 == 1, *word, i32::MIN.cast_unsigned());
            bits >>= 1;
        }
    }
    top(logits)
}

/// Index and value of the largest logit, lowest on a tie; `(0, i32::MIN)` of none.
#[inline(never)]
pub(crate) fn top(logits: &[u32]) -> (u16, i32) {
    let mut best = (0, i32::MIN);
    for (index, &word) in (0u16..).zip(logits) {
        let value = word.cast_signed();
        best = select_unpredictable(value > best.1, (index, value), best);
    }
    best
}

#[cfg(test)]
mod tests {
    use super::{masked_argmax, top};
    use crate::mask::LatentMask;

    fn words(values: &[i32]) -> std::vec::Vec<u32> {
        values.iter().map(|value| value.cast_unsigned()).collect()
    }

    #[test]
    fn ties_go_to_the_lowest() {
        assert_eq!(top(&words(&[-3, 5, 5, 1])), (1, 5));
        assert_eq!(top(&words(&[i32::MIN, i32::MIN])), (0, i32::MIN));
        assert_eq!(masked_argmax(&mut words(&[-3, 5, 5, 1]), &LatentMask::full(4)), (1, 5));
    }

    #[test]
    fn every_place_of_every_length_is_found() {
        for len in 1..=70usize {
            for (place, index) in (0..len).zip(0_u16..) {
                let mut values = std::vec![-7; len];
                values[place] = -3;
                let mut values = words(&values);
                let found = (index, -3);
                assert_eq!(top(&values), found);
                assert_eq!(masked_argmax(&mut values, &LatentMask::full(70)), found);
            }
        }
    }

    #[test]
    fn latents_outside_of_the_set_do_not_count() {
        let mut allowed = LatentMask::empty();
        allowed.insert(0);
        allowed.insert(3);
        assert_eq!(masked_argmax(&mut words(&[-3, 5, 5, -2]), &allowed), (3, -2));
    }
}
