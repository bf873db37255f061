//! The set of latents that the confidence network allows, and the rule that makes it, in integers.

use crate::argmax::top;
use crate::kernels::{ONE, exp2_below};
use crate::schema::MAX_LATENTS;
use core::hint::select_unpredictable;

const WORDS: usize = MAX_LATENTS / 32;

/// A set of latents, at most [`MAX_LATENTS`] of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LatentMask {
    bits: [u32; WORDS],
}

impl LatentMask {
    /// The empty set.
    #[must_use]
    pub const fn empty() -> Self {
        Self { bits: [0; WORDS] }
    }

    /// The latents `0..count`; a count beyond [`MAX_LATENTS`] gives all.
    #[must_use]
    pub fn full(count: u16) -> Self {
        let mut mask = Self::empty();
        for latent in 0..count {
            mask.insert(latent);
        }
        mask
    }

    /// The words of the set, latent 0 in the lowest bit of the first.
    pub(crate) fn words(&self) -> &[u32; WORDS] {
        &self.bits
    }

    /// Adds a latent; one beyond [`MAX_LATENTS`] is ignored.
    pub fn insert(&mut self, latent: u16) {
        if let Some(word) = self.bits.get_mut(usize::from(latent >> 5)) {
            *word |= 1 << (latent & 31);
        }
    }

    /// Whether the set holds `latent`.
    #[must_use]
    pub fn contains(&self, latent: u16) -> bool {
        self.bits.get(usize::from(latent >> 5)).is_some_and(|word| (word >> (latent & 31)) & 1 == 1)
    }

    /// Number of latents in the set.
    #[must_use]
    pub fn len(&self) -> usize {
        self.bits.iter().fold(0, |sum: usize, word| sum.wrapping_add(word.count_ones() as usize))
    }

    /// Whether the set holds nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.bits.iter().fold(0, |all, word| all | word) == 0
    }

    /// The latents of the set, rising.
    pub fn iter(&self) -> impl Iterator<Item = u16> + '_ {
        (0u16..=255).filter(|&latent| self.contains(latent))
    }
}

/// `softmax(logits)_k > num / den`.
///
/// Source: the mask of the GADM paper, `M(s)[k] = C(s)[k] > beta`, with the rules for an empty mask: first all latents
/// if the confidences are equal within 1e-6 (an untrained predictor), else the most confident latent alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MaskRule {
    /// Numerator of the threshold, below `den`.
    pub(crate) num: u32,
    /// Denominator of the threshold, at most 2^24.
    pub(crate) den: u32,
    /// Fraction bits of the logits, in log2 units.
    pub(crate) frac_bits: u32,
}

impl MaskRule {
    /// Takes those that the rule does not allow out of the `allowed`, which are all, and says whether the rules for an empty
    /// mask made the set. `logits` are `i32` as words; they are overwritten with the exponentials. No branch depends on their
    /// values.
    pub(crate) fn restrict(self, logits: &mut [u32], allowed: &mut LatentMask) -> bool {
        // `load` keeps logits below 2^30 in magnitude, so that differences fit.
        let (most_confident, top) = top(logits);
        exp2_below(logits, top, self.frac_bits);
        let mut sum = 0u64;
        let mut least = ONE;
        for &e in logits.iter() {
            sum = sum.wrapping_add(u64::from(e));
            least = least.min(e);
        }
        // At most 256 * 2^30 * 2^24 = 2^62.
        let threshold = sum.wrapping_mul(u64::from(self.num));
        let den = u64::from(self.den);
        // Nothing passes what the most confident latent, whose exponential is 1, does not pass.
        let fallback = u64::from(ONE).wrapping_mul(den) <= threshold;
        let equal = u64::from(ONE.wrapping_sub(least)).wrapping_mul(1_000_000) < sum;
        let enough = select_unpredictable(fallback & equal, 0, threshold.wrapping_add(1));
        for (word, logits) in allowed.bits.iter_mut().zip(logits.chunks(32)) {
            let mut bit = 1u32;
            for &e in logits {
                let below = u64::from(e).wrapping_mul(den) < enough;
                *word &= !select_unpredictable(below, bit, 0);
                bit = bit.wrapping_shl(1);
            }
        }
        // Without the fallback it is among them.
        allowed.insert(most_confident);
        fallback
    }
}

#[cfg(test)]
mod tests {
    use super::{LatentMask, MaskRule};

    const F: u32 = 16;

    /// Logits in log2 units with 16 fraction bits.
    fn allowed(probabilities: &[f64], num: u32, den: u32) -> (std::vec::Vec<u16>, bool) {
        let mut logits: std::vec::Vec<u32> =
            probabilities.iter().map(|p| ((p.log2() * 65536.0).round() as i32).cast_unsigned()).collect();
        let mut mask = LatentMask::full(logits.len() as u16);
        let fallback = MaskRule { num, den, frac_bits: F }.restrict(&mut logits, &mut mask);
        (mask.iter().collect(), fallback)
    }

    #[test]
    fn latents_above_the_threshold_are_allowed() {
        assert_eq!(allowed(&[0.568, 0.273, 0.158, 0.001], 1, 4), (vec![0, 1], false));
        assert_eq!(allowed(&[0.734, 0.089, 0.089, 0.088], 1, 4), (vec![0], false));
        assert_eq!(allowed(&[0.376, 0.312, 0.312, 1e-9], 1, 4), (vec![0, 1, 2], false));
    }

    #[test]
    fn the_threshold_is_strict() {
        assert_eq!(allowed(&[0.5, 0.25, 0.25], 1, 4), (vec![0], false));
        assert_eq!(allowed(&[0.5, 0.25, 0.25], 1, 5), (vec![0, 1, 2], false));
    }

    #[test]
    fn an_untrained_predictor_allows_everything_and_says_so() {
        assert_eq!(allowed(&[0.25; 4], 1, 4), (vec![0, 1, 2, 3], true));
    }

    #[test]
    fn otherwise_an_empty_mask_takes_the_most_confident_lowest_latent() {
        assert_eq!(allowed(&[0.2, 0.3, 0.3, 0.2], 3, 8), (vec![1], true));
    }

    #[test]
    fn sets_hold_up_to_256_latents() {
        let mut mask = LatentMask::empty();
        mask.insert(0);
        mask.insert(255);
        mask.insert(256);
        assert_eq!(mask.iter().collect::<std::vec::Vec<_>>(), [0, 255]);
        assert_eq!(LatentMask::full(256).len(), 256);
        assert_eq!(LatentMask::full(33).len(), 33);
        assert!(!mask.contains(1));
    }
}
