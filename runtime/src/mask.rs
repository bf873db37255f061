//! The set of latents that the confidence network allows.

use crate::schema::MAX_LATENTS;

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
        self.bits.iter().all(|&word| word == 0)
    }

    /// The latents of the set, rising.
    pub fn iter(&self) -> impl Iterator<Item = u16> + '_ {
        (0u16..=255).filter(|&latent| self.contains(latent))
    }
}
