//! A section that is being checked: reads that know where they are, so that errors can say so.

use crate::error::LoadError;
use crate::fields::{f32_at, u16_at, u32_at};
use crate::schema::{MAX_TEXT, SECTION_ALIGN, Section};

/// Bytes of one section and their place in the file.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Part<'a> {
    pub(crate) section: Section,
    pub(crate) bytes: &'a [u8],
    /// Offset of the first byte from the start of the file.
    pub(crate) base: usize,
}

impl<'a> Part<'a> {
    /// Offset from the start of the file.
    pub(crate) fn offset(&self, at: usize) -> usize {
        self.base.saturating_add(at)
    }

    /// The section must have exactly this length.
    pub(crate) fn exactly(&self, expected: usize) -> Result<(), LoadError> {
        if self.bytes.len() == expected { Ok(()) } else { Err(self.short(expected)) }
    }

    fn short(&self, expected: usize) -> LoadError {
        LoadError::SectionLength { section: self.section, expected, found: self.bytes.len() }
    }

    /// `len` bytes at `at`.
    pub(crate) fn slice(&self, at: usize, len: usize) -> Result<&'a [u8], LoadError> {
        let slice = self.bytes.get(at..).and_then(|rest| rest.get(..len));
        slice.ok_or(self.short(at.saturating_add(len)))
    }

    /// A `u16` within `min..=max`.
    pub(crate) fn u16(&self, at: usize, min: u16, max: u16) -> Result<u16, LoadError> {
        let found = u16_at(self.bytes, at).ok_or(self.short(at.saturating_add(2)))?;
        if (min..=max).contains(&found) {
            Ok(found)
        } else {
            Err(self.field(at, u32::from(min), u32::from(max), u32::from(found)))
        }
    }

    /// A `u32` within `min..=max`.
    pub(crate) fn u32(&self, at: usize, min: u32, max: u32) -> Result<u32, LoadError> {
        let found = u32_at(self.bytes, at).ok_or(self.short(at.saturating_add(4)))?;
        if (min..=max).contains(&found) { Ok(found) } else { Err(self.field(at, min, max, found)) }
    }

    fn field(&self, at: usize, min: u32, max: u32, found: u32) -> LoadError {
        LoadError::Field { section: self.section, offset: self.offset(at), min, max, found }
    }

    /// A finite `f32` for which `allowed` holds.
    pub(crate) fn number(&self, at: usize, allowed: impl Fn(f32) -> bool) -> Result<f32, LoadError> {
        let found = f32_at(self.bytes, at).ok_or(self.short(at.saturating_add(4)))?;
        if found.is_finite() && allowed(found) {
            Ok(found)
        } else {
            Err(LoadError::Number { section: self.section, offset: self.offset(at), found })
        }
    }

    /// Text without control characters, at most [`MAX_TEXT`] bytes.
    pub(crate) fn text(&self, at: usize, len: usize) -> Result<&'a str, LoadError> {
        let error = LoadError::Text { section: self.section, offset: self.offset(at) };
        if len > MAX_TEXT {
            return Err(error);
        }
        let text = core::str::from_utf8(self.slice(at, len)?).map_err(|_| error)?;
        if text.chars().any(char::is_control) { Err(error) } else { Ok(text) }
    }

    /// Bytes that only pad must be zero.
    pub(crate) fn zeros(&self, at: usize, len: usize) -> Result<(), LoadError> {
        match self.slice(at, len)?.iter().position(|&byte| byte != 0) {
            None => Ok(()),
            Some(index) => {
                Err(LoadError::Padding { section: self.section, offset: self.offset(at).saturating_add(index) })
            }
        }
    }

    /// A slice that the file says lies at the next aligned offset after `cursor` (both relative to the section) and has
    /// `len` bytes; offset and length are stored at `at`. Checks the padding in between and returns the new cursor.
    pub(crate) fn placed(&self, at: usize, cursor: usize, len: usize) -> Result<(&'a [u8], usize), LoadError> {
        let start = self.offset(cursor).checked_next_multiple_of(SECTION_ALIGN).unwrap_or(usize::MAX);
        let start32 = u32::try_from(start).unwrap_or(u32::MAX);
        let len32 = u32::try_from(len).unwrap_or(u32::MAX);
        self.u32(at, start32, start32)?;
        self.u32(at.saturating_add(4), len32, len32)?;
        let start = start.saturating_sub(self.base);
        self.zeros(cursor, start.saturating_sub(cursor))?;
        Ok((self.slice(start, len)?, start.saturating_add(len)))
    }
}
