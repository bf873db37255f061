//! Parts of a set, collected until the set is complete.

use crate::codec::Part;

/// What a part did to the set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pushed {
    /// Taken; parts are still missing.
    Incomplete,
    /// Taken; the set is complete now.
    Complete,
    /// This part of this set was there already; ignored.
    Duplicate,
}

/// Collects the parts of one set of at most `N` values in at most 128 parts.
///
/// A set is complete when all its parts came with the same sequence number. A part with another number starts a new
/// set; an incomplete one is then dropped as torn, and counted.
#[derive(Clone, Debug)]
pub struct Assembler<const N: usize> {
    seq: Option<u16>,
    seen: u128,
    missing: usize,
    values: [f32; N],
    torn: u32,
}

impl<const N: usize> Default for Assembler<N> {
    fn default() -> Self {
        Self { seq: None, seen: 0, missing: 0, values: [0.0; N], torn: 0 }
    }
}

impl<const N: usize> Assembler<N> {
    /// Takes one part of a set of `parts` parts.
    pub fn push(&mut self, part: &Part, parts: usize) -> Pushed {
        if self.seq != Some(part.seq) {
            self.abandon();
            self.seq = Some(part.seq);
            self.seen = 0;
            self.missing = parts;
        }
        let bit = u32::try_from(part.part).ok().and_then(|p| 1_u128.checked_shl(p)).unwrap_or(0);
        if self.seen & bit != 0 || self.missing == 0 {
            return Pushed::Duplicate;
        }
        self.seen |= bit;
        self.missing -= 1;
        for (slot, value) in self.values.iter_mut().skip(part.first).zip(&part.values) {
            *slot = *value;
        }
        if self.missing == 0 { Pushed::Complete } else { Pushed::Incomplete }
    }

    /// Drops the set; counts it as torn where it was incomplete.
    pub fn abandon(&mut self) {
        if self.seq.take().is_some() && self.missing > 0 {
            self.torn = self.torn.saturating_add(1);
        }
    }

    /// Sequence number of the set under way or complete.
    #[must_use]
    pub fn seq(&self) -> Option<u16> {
        self.seq
    }

    /// The values of the complete set with that sequence number.
    #[must_use]
    pub fn complete(&self, seq: u16, dim: usize) -> Option<&[f32]> {
        if self.seq == Some(seq) && self.missing == 0 { self.values.get(..dim) } else { None }
    }

    /// Sets dropped as incomplete.
    #[must_use]
    pub fn torn(&self) -> u32 {
        self.torn
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(seq: u16, part: usize) -> Part {
        let mut values = heapless::Vec::new();
        values.push(part as f32).unwrap();
        Part { seq, part, first: part, values }
    }

    #[test]
    fn parts_in_any_order_make_a_set_and_duplicates_do_not() {
        let mut a = Assembler::<4>::default();
        assert_eq!(a.push(&part(7, 2), 3), Pushed::Incomplete);
        assert_eq!(a.push(&part(7, 2), 3), Pushed::Duplicate);
        assert_eq!(a.push(&part(7, 0), 3), Pushed::Incomplete);
        assert_eq!(a.complete(7, 3), None);
        assert_eq!(a.push(&part(7, 1), 3), Pushed::Complete);
        assert_eq!(a.complete(7, 3), Some(&[0.0, 1.0, 2.0][..]));
        assert_eq!(a.push(&part(7, 1), 3), Pushed::Duplicate);
        assert_eq!(a.complete(8, 3), None);
        assert_eq!(a.torn(), 0);
    }

    #[test]
    fn a_new_sequence_tears_an_incomplete_set() {
        let mut a = Assembler::<4>::default();
        a.push(&part(1, 0), 2);
        a.push(&part(2, 0), 2);
        assert_eq!(a.torn(), 1);
        a.push(&part(2, 1), 2);
        a.push(&part(3, 0), 2);
        assert_eq!(a.torn(), 1, "a complete set is not torn");
        a.abandon();
        a.abandon();
        assert_eq!(a.torn(), 2);
    }
}
