//! Argmax over the allowed latents; ties go to the lowest.

use crate::mask::LatentMask;

/// Latent and logit of the largest of the allowed `logits` (`i32` as words, above `i32::MIN`).
pub(crate) fn masked_argmax(logits: &[u32], allowed: &LatentMask) -> (u16, i32) {
    let mut best = (0, i32::MIN);
    let mut latent = 0u16;
    for (&bits, logits) in allowed.words().iter().zip(logits.chunks(32)) {
        let mut bits = bits;
        for word in logits {
            let value = if bits & 1 == 1 { word.cast_signed() } else { i32::MIN };
            bits >>= 1;
            if value > best.1 {
                best = (latent, value);
            }
            latent = latent.wrapping_add(1);
        }
    }
    best
}

/// Index and value of the largest logit, lowest on a tie; `(0, 0)` of none.
pub(crate) fn top(logits: &[u32]) -> (u16, i32) {
    let mut best = (0, logits.first().map_or(0, |word| word.cast_signed()));
    for (index, word) in (0u16..).zip(logits) {
        if word.cast_signed() > best.1 {
            best = (index, word.cast_signed());
        }
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
        assert_eq!(masked_argmax(&words(&[-3, 5, 5, 1]), &LatentMask::full(4)), (1, 5));
    }

    #[test]
    fn latents_outside_of_the_set_do_not_count() {
        let mut allowed = LatentMask::empty();
        allowed.insert(0);
        allowed.insert(3);
        assert_eq!(masked_argmax(&words(&[-3, 5, 5, -2]), &allowed), (3, -2));
    }
}
