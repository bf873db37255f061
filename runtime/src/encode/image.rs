//! Bytes at an address that the runtime accepts.

use std::vec;
use std::vec::Vec;

/// Owns the bytes of a policy file at a 16-byte aligned address, which a `Vec<u8>` or `include_bytes!` does not promise.
pub struct AlignedImage {
    bytes: Vec<u8>,
    start: usize,
    len: usize,
}

const ALIGN: usize = 16;

impl AlignedImage {
    /// Copies `image` to an aligned address.
    #[must_use]
    pub fn new(image: &[u8]) -> Self {
        let mut bytes = vec![0; image.len() + ALIGN];
        let start = bytes.as_ptr().addr().next_multiple_of(ALIGN) - bytes.as_ptr().addr();
        bytes[start..start + image.len()].copy_from_slice(image);
        Self { bytes, start, len: image.len() }
    }

    /// The bytes.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[self.start..self.start + self.len]
    }

    /// The bytes, to be changed.
    pub fn as_bytes_mut(&mut self) -> &mut [u8] {
        &mut self.bytes[self.start..self.start + self.len]
    }
}

impl core::ops::Deref for AlignedImage {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        self.as_bytes()
    }
}

impl std::fmt::Debug for AlignedImage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("AlignedImage").field("len", &self.len).finish_non_exhaustive()
    }
}

impl Clone for AlignedImage {
    fn clone(&self) -> Self {
        Self::new(self.as_bytes())
    }
}
