//! Little-endian fields at byte offsets. Out of range is `None`, so nothing here can panic.

/// The `N` bytes at `at`.
pub(crate) fn bytes_at<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..)?.first_chunk::<N>().copied()
}

/// The `u16` at `at`.
pub(crate) fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    bytes_at(bytes, at).map(u16::from_le_bytes)
}

/// The `u32` at `at`.
pub(crate) fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes_at(bytes, at).map(u32::from_le_bytes)
}

/// The `u64` at `at`.
pub(crate) fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    bytes_at(bytes, at).map(u64::from_le_bytes)
}

/// The `i32` at `at`.
pub(crate) fn i32_at(bytes: &[u8], at: usize) -> Option<i32> {
    bytes_at(bytes, at).map(i32::from_le_bytes)
}

/// The `f32` at `at`.
pub(crate) fn f32_at(bytes: &[u8], at: usize) -> Option<f32> {
    bytes_at(bytes, at).map(f32::from_le_bytes)
}

/// The part of `file` whose offset and length, two `u32`s, are at `at`.
pub(crate) fn slice_at(file: &[u8], at: usize) -> &[u8] {
    let len = u32_at(file, at.wrapping_add(4)).unwrap_or_default();
    slice_of(file, u32_at(file, at).unwrap_or_default(), len)
}

/// `len` bytes of `file` from `start` on; none where it has fewer.
#[inline(never)]
pub(crate) fn slice_of(file: &[u8], start: u32, len: u32) -> &[u8] {
    let start = start as usize;
    // A sum that wraps is below the start, which is refused as well.
    file.get(start..start.wrapping_add(len as usize)).unwrap_or_default()
}

/// The text of `len` bytes at `at`; empty where that is not text.
pub(crate) fn text_at(bytes: &[u8], at: usize, len: usize) -> &str {
    let bytes = bytes.get(at..).and_then(|rest| rest.get(..len)).unwrap_or_default();
    core::str::from_utf8(bytes).unwrap_or_default()
}
