//! Argmax over the allowed latents; ties go to the lowest.

use crate::mask::LatentMask;

/// Latent and logit of the largest of the allowed `logits` (`i32` as words).
pub(crate) fn masked_argmax(logits: &[u32], allowed: &LatentMask) -> (u16, i32) {
    let mut best = (0, i32::MIN);
    for (latent, word) in (0u16..).zip(logits) {
        let value = word.cast_signed();
        if value > best.1 && allowed.contains(latent) {
            best = (latent, value);
        }
    }
    best
}

/// Index of the largest logit, lowest on a tie.
pub(crate) fn argmax(logits: &[u32]) -> u16 {
    let mut best = (0, i32::MIN);
    for (index, word) in (0u16..).zip(logits) {
        if word.cast_signed() > best.1 {
            best = (index, word.cast_signed());
        }
    }
    best.0
}

#[cfg(test)]
mod tests {
    use super::{argmax, masked_argmax};
    use crate::mask::LatentMask;

    fn words(values: &[i32]) -> std::vec::Vec<u32> {
        values.iter().map(|value| value.cast_unsigned()).collect()
    }

    #[test]
    fn ties_go_to_the_lowest() {
        assert_eq!(argmax(&words(&[-3, 5, 5, 1])), 1);
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
