//! A file that is being checked, front to back.
//!
//! The first fault is kept, and from then on there is nothing left to read: every field is 0, every slice is empty. So a
//! check is one call without a branch behind it, and `load` stays small on a device. What is read before the first fault
//! is within its limits, so loops over counts stay short whatever the bytes are.
#![deny(clippy::arithmetic_side_effects)]

use crate::error::LoadError;
use crate::image::Image;
use crate::interface::{FNV_START, fnv};
use crate::schema::{MAX_TEXT, SECTION_ALIGN, Section};

/// Where the check is, and what it found out.
pub(crate) struct Reader<'a, const PROVE: bool> {
    /// The file and its dimensions, as far as they are known.
    pub(crate) image: Image<'a>,
    /// The file up to the end of the section; empty after a fault.
    bytes: &'a [u8],
    /// First byte of the section.
    pub(crate) start: usize,
    /// Next byte to be read.
    pub(crate) at: usize,
    /// Next byte of what the fields at `at` describe: texts, streams, sections.
    pub(crate) far: usize,
    /// Hash of the interface.
    pub(crate) hash: u64,
    fault: Option<LoadError>,
    section: Section,
    /// Layer and row of the weights that are checked.
    pub(crate) layer: u16,
    pub(crate) row: usize,
}

impl<'a, const PROVE: bool> Reader<'a, PROVE> {
    pub(crate) fn new(image: Image<'a>) -> Self {
        Self {
            image,
            bytes: &[],
            start: 0,
            at: 0,
            far: 0,
            hash: FNV_START,
            fault: None,
            section: Section::Header,
            layer: 0,
            row: 0,
        }
    }

    /// The first fault.
    #[inline(never)]
    pub(crate) fn finish(&self) -> Result<Image<'a>, LoadError> {
        match self.fault {
            None => Ok(self.image),
            Some(fault) => Err(fault),
        }
    }

    /// Whether there was a fault.
    pub(crate) fn failed(&self) -> bool {
        self.fault.is_some()
    }

    /// Goes to `from..to` of the file.
    #[inline(never)]
    pub(crate) fn enter_at(&mut self, section: Section, from: usize, to: usize) {
        self.section = section;
        self.start = from;
        self.at = from;
        if !self.failed() {
            self.bytes = self.image.file.get(..to).unwrap_or_default();
        }
    }

    /// Goes to a section of the table.
    #[inline(never)]
    pub(crate) fn enter(&mut self, section: Section) {
        let from = self.image.word(section.entry()) as usize;
        let len = self.image.word(section.entry().wrapping_add(4)) as usize;
        self.enter_at(section, from, from.wrapping_add(len));
    }

    /// Keeps the first fault.
    #[cold]
    #[inline(never)]
    pub(crate) fn fail(&mut self, fault: LoadError) {
        self.bytes = &[];
        if !self.failed() {
            self.fault = Some(fault);
        }
    }

    /// Whether bytes of the section are left.
    pub(crate) fn more(&self) -> bool {
        self.at < self.bytes.len()
    }

    /// The next `len` bytes.
    #[inline(never)]
    pub(crate) fn take(&mut self, len: usize) -> &'a [u8] {
        let end = self.at.saturating_add(len);
        if let Some(bytes) = self.bytes.get(self.at..end) {
            self.at = end;
            return bytes;
        }
        self.length(end);
        &[]
    }

    /// The section should have ended at `end`.
    #[cold]
    #[inline(never)]
    fn length(&mut self, end: usize) {
        let (expected, found) = (end.wrapping_sub(self.start), self.bytes.len().wrapping_sub(self.start));
        self.fail(LoadError::SectionLength { section: self.section, expected, found });
    }

    /// The section must end here.
    #[inline(never)]
    pub(crate) fn end(&mut self) {
        if self.at != self.bytes.len() {
            self.length(self.at);
        }
    }

    /// A number of `len` bytes within `min..=max`.
    #[inline(never)]
    pub(crate) fn field(&mut self, len: usize, min: u32, max: u32) -> u32 {
        let offset = self.at;
        let found = self.take(len).iter().rev().fold(0, |value, &byte| (value << 8) | u32::from(byte));
        if (min..=max).contains(&found) {
            return found;
        }
        self.fail(LoadError::Field { section: self.section, offset, min, max, found });
        0
    }

    /// A `u16` within `min..=max`.
    #[inline(never)]
    pub(crate) fn u16(&mut self, min: usize, max: usize) -> usize {
        self.field(2, word(min), word(max)) as usize
    }

    /// Any `u32`.
    #[inline(never)]
    pub(crate) fn u32(&mut self) -> u32 {
        self.field(4, 0, u32::MAX)
    }

    /// A `u32` that must be `expected`.
    #[inline(never)]
    pub(crate) fn exactly(&mut self, expected: usize) {
        self.field(4, word(expected), word(expected));
    }

    /// A finite `f32` within `min..=max`.
    #[inline(never)]
    pub(crate) fn number(&mut self, min: f32, max: f32) -> f32 {
        let found = f32::from_bits(self.u32());
        self.require(found >= min && found <= max, found);
        found
    }

    /// The number just read must do.
    #[inline(never)]
    pub(crate) fn require(&mut self, good: bool, found: f32) {
        if !good {
            self.fail(LoadError::Number { section: self.section, offset: self.at.wrapping_sub(4), found });
        }
    }

    /// Any finite `f32`.
    #[inline(never)]
    pub(crate) fn finite(&mut self) -> f32 {
        self.number(f32::MIN, f32::MAX)
    }

    /// Finite numbers.
    #[inline(never)]
    pub(crate) fn numbers(&mut self, count: usize) {
        if PROVE {
            for _ in 0..count {
                self.finite();
            }
        } else {
            self.take(count.wrapping_mul(4));
        }
    }

    /// Two finite numbers, the first below the second by at most `widest`.
    #[inline(never)]
    pub(crate) fn range(&mut self, widest: f32) -> (f32, f32) {
        let low = self.finite();
        let high = self.finite();
        self.require(high > low && high - low <= widest, high);
        (low, high)
    }

    /// One of `0.0, 1.0, ..., count - 1`, with a positive sign.
    #[inline(never)]
    pub(crate) fn index(&mut self, count: usize) {
        let found = self.finite();
        self.require(is_index(found, count), found);
    }

    /// Bytes that only pad must be zero.
    #[inline(never)]
    pub(crate) fn zeros(&mut self, len: usize) {
        let offset = self.at;
        let bytes = self.take(len);
        if PROVE && let Some(index) = bytes.iter().position(|&byte| byte != 0) {
            self.fail(LoadError::Padding { section: self.section, offset: offset.wrapping_add(index) });
        }
    }

    /// Padding to the next multiple of 16 from the start of the file.
    #[inline(never)]
    pub(crate) fn pad(&mut self) {
        self.zeros(self.at.wrapping_neg() & (SECTION_ALIGN - 1));
    }

    /// Length of a text, which lies at `far`.
    #[inline(never)]
    pub(crate) fn text(&mut self, min: usize) {
        let len = self.u16(min, MAX_TEXT);
        self.swap();
        let offset = self.at;
        let text = self.take(len);
        if !is_text(text) {
            self.fail(LoadError::Text { section: self.section, offset });
        }
        self.hash(offset);
        self.swap();
    }

    /// A weight is larger than `most`, which is 0 in the padding.
    #[cold]
    #[inline(never)]
    pub(crate) fn weight(&mut self, most: i32) {
        let (section, layer, row) = (self.section, self.layer, short(self.row));
        self.fail(if most == 0 {
            LoadError::PaddedWeight { section, layer, row }
        } else {
            LoadError::Weight { section, layer, row }
        });
    }

    /// The magnitude that a sum may reach must be `limit` at the most.
    #[inline(never)]
    pub(crate) fn bound(&mut self, limit: u32, found: u64) {
        if found > u64::from(limit) {
            let (section, layer, row) = (self.section, self.layer, short(self.row));
            self.fail(LoadError::Bound { section, layer, row, limit: limit.into(), found: found.cast_signed() });
        }
    }

    /// Changes the places of `at` and `far`.
    #[inline(never)]
    pub(crate) fn swap(&mut self) {
        core::mem::swap(&mut self.at, &mut self.far);
    }

    /// Puts what was read from `from` on into the hash.
    #[inline(never)]
    pub(crate) fn hash(&mut self, from: usize) {
        self.hash = fnv(self.hash, self.bytes.get(from..self.at).unwrap_or_default());
    }
}

/// Offsets, lengths and products of two counts in a file fit 32 bits.
#[expect(clippy::cast_possible_truncation, reason = "as stated")]
pub(crate) fn word(value: usize) -> u32 {
    value as u32
}

/// Counts are at most 4096.
#[expect(clippy::cast_possible_truncation, reason = "as stated")]
pub(crate) const fn short(value: usize) -> u16 {
    value as u16
}

/// Whether `value` is one of `0.0, 1.0, ..., count - 1`, with a positive sign.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_precision_loss,
    reason = "what is no index does not come back as the same bits"
)]
pub(crate) fn is_index(value: f32, count: usize) -> bool {
    let index = value as usize;
    index < count && (index as f32).to_bits() == value.to_bits()
}

/// Whether `bytes` are UTF-8 without control characters (U+0000 to U+001F, U+007F to U+009F).
///
/// Source: The Unicode Standard, table 3-7, well-formed UTF-8 byte sequences.
#[inline(never)]
fn is_text(bytes: &[u8]) -> bool {
    // Continuation bytes that are still to come, and the range of the next one.
    let (mut left, mut range) = (0u8, 0x80..=0xBF);
    for &byte in bytes {
        if left > 0 {
            if !range.contains(&byte) {
                return false;
            }
            left = left.wrapping_sub(1);
            range = 0x80..=0xBF;
            continue;
        }
        left = match byte {
            0x20..=0x7E => 0,
            0xC2..=0xDF => 1,
            0xE0..=0xEF => 2,
            0xF0..=0xF4 => 3,
            _ => return false,
        };
        range = match byte {
            0xC2 | 0xE0 => 0xA0..=0xBF,
            0xED => 0x80..=0x9F,
            0xF0 => 0x90..=0xBF,
            0xF4 => 0x80..=0x8F,
            _ => range,
        };
    }
    left == 0
}

#[cfg(test)]
mod tests {
    use super::{is_index, is_text};
    use proptest::prelude::*;

    fn expected(bytes: &[u8]) -> bool {
        core::str::from_utf8(bytes).is_ok_and(|text| !text.chars().any(char::is_control))
    }

    #[test]
    fn every_character_is_text_or_a_control_character() {
        for character in '\0'..=char::MAX {
            let mut bytes = [0; 4];
            let bytes = character.encode_utf8(&mut bytes).as_bytes();
            assert_eq!(is_text(bytes), !character.is_control(), "{character:?}");
        }
    }

    #[test]
    fn every_sequence_of_three_bytes_is_as_the_core_library_says() {
        for word in 0..1u32 << 24 {
            let [a, b, c, _] = word.to_le_bytes();
            assert_eq!(is_text(&[a, b, c]), expected(&[a, b, c]), "{a:02x} {b:02x} {c:02x}");
        }
    }

    #[test]
    fn indices_are_whole_and_not_negative() {
        assert!(is_index(0.0, 1) && is_index(2.0, 3) && is_index(1023.0, 1024));
        assert!(!is_index(-0.0, 1) && !is_index(3.0, 3) && !is_index(0.5, 3) && !is_index(-1.0, 3));
        assert!(!is_index(65535.0, 65535) && !is_index(f32::NAN, 3) && !is_index(1e30, 1024));
    }

    proptest! {
        #[test]
        fn longer_sequences_are_as_the_core_library_says(
            bytes in proptest::collection::vec(prop_oneof![any::<u8>(), 0x7Fu8..=0xC3, 0xE0u8..=0xF5], 0..9)
        ) {
            prop_assert_eq!(is_text(&bytes), expected(&bytes));
        }
    }
}
