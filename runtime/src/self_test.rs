//! The self-test vectors of a file.

/// One vector: observation, latent and action.
#[derive(Clone, Copy)]
pub(crate) struct SelfTest<'a> {
    /// The observation, in native units.
    pub(crate) observation: &'a [[u8; 4]],
    /// The latent that must be chosen.
    pub(crate) latent: u16,
    /// The values that the slots must take.
    pub(crate) actions: &'a [[u8; 4]],
}

/// The vectors in file order; `vectors` was checked by `load`.
pub(crate) fn self_test_vectors(vectors: &[u8], obs_dim: usize, slots: usize) -> impl Iterator<Item = SelfTest<'_>> {
    let mut rest = vectors.as_chunks::<4>().0;
    core::iter::from_fn(move || {
        let (observation, after) = rest.split_at_checked(obs_dim)?;
        let (&[low, high, ..], after) = after.split_first()?;
        let (actions, after) = after.split_at_checked(slots)?;
        rest = after;
        Some(SelfTest { observation, latent: u16::from_le_bytes([low, high]), actions })
    })
}
