//! The self-test vectors of a file.

use crate::fields::{f32_at, u16_at};

/// Bytes of one vector.
fn self_test_len(obs_dim: usize, slots: usize) -> usize {
    obs_dim.wrapping_add(slots).wrapping_add(1).wrapping_mul(4)
}

/// One vector: observation, latent and action.
#[derive(Clone, Copy)]
pub(crate) struct SelfTest<'a> {
    bytes: &'a [u8],
    obs_dim: usize,
    /// The latent that must be chosen.
    pub(crate) latent: u16,
}

impl<'a> SelfTest<'a> {
    /// The observation, in native units.
    pub(crate) fn observation(self) -> impl Iterator<Item = f32> + use<'a> {
        let bytes = self.bytes.get(..self.obs_dim.wrapping_mul(4)).unwrap_or_default();
        bytes.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes))
    }

    /// The value that slot `slot` must take.
    pub(crate) fn action(self, slot: usize) -> f32 {
        let at = self.obs_dim.wrapping_add(1).wrapping_add(slot).wrapping_mul(4);
        f32_at(self.bytes, at).unwrap_or_default()
    }
}

/// The vectors in file order; `vectors` was checked by `load`.
pub(crate) fn self_test_vectors(vectors: &[u8], obs_dim: usize, slots: usize) -> impl Iterator<Item = SelfTest<'_>> {
    let len = self_test_len(obs_dim, slots);
    let mut rest = vectors;
    core::iter::from_fn(move || {
        let (bytes, after) = rest.split_at_checked(len)?;
        rest = after;
        Some(SelfTest { bytes, obs_dim, latent: u16_at(bytes, obs_dim.wrapping_mul(4))? })
    })
}

/// Whether two values differ in any bit.
pub(crate) fn slot_differs(expected: f32, found: f32) -> bool {
    expected.to_bits() != found.to_bits()
}
