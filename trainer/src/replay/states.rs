//! Observations of the replay buffer, each held once: the successor of one transition is the start of a later one.
//!
//! Rows are recognised by their bits among those that were added last, so nothing upstream has to say which observation is
//! which; a row that is not recognised is held a second time, which costs memory and changes nothing else.

/// Numbers that are allocated together: 16 MiB, so that huge pages of the system round little up.
const CHUNK: usize = 1 << 22;
/// Slots of the table of rows added last, as a power of two.
const RECENT_BITS: u32 = 12;
const NONE: u32 = u32::MAX;

/// Observations with the number of transitions that use each.
#[derive(Clone, Debug)]
pub struct States {
    width: usize,
    /// Rows of a chunk.
    per_chunk: usize,
    chunks: Vec<Box<[f32]>>,
    uses: Vec<u16>,
    free: Vec<u32>,
    /// Row by hash of its bits; an older row gives way to a newer one.
    recent: Vec<u32>,
}

impl States {
    /// An empty set of rows of `width` numbers.
    pub fn new(width: usize) -> Self {
        let per_chunk = (CHUNK / width.max(1)).max(1);
        Self {
            width,
            per_chunk,
            chunks: Vec::new(),
            uses: Vec::new(),
            free: Vec::new(),
            recent: vec![NONE; 1 << RECENT_BITS],
        }
    }

    /// Numbers of a row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// A row.
    ///
    /// # Panics
    /// Where there is none of that number.
    pub fn row(&self, row: u32) -> &[f32] {
        let at = row as usize % self.per_chunk * self.width;
        &self.chunks[row as usize / self.per_chunk][at..at + self.width]
    }

    /// Holds `values` for one more use, and returns their row.
    ///
    /// # Panics
    /// Beyond 2^32 - 1 rows.
    pub fn hold(&mut self, values: &[f32]) -> u32 {
        debug_assert_eq!(values.len(), self.width);
        // Rotate, mix, multiply per number; the product's highest bits depend on all bits below.
        let mix = |h: u64, v: &f32| (h.rotate_left(5) ^ u64::from(v.to_bits())).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let slot = (values.iter().fold(0, mix) >> (64 - RECENT_BITS)) as usize;
        let known = self.recent[slot];
        let same = |row: &[f32]| row.iter().zip(values).all(|(a, b)| a.to_bits() == b.to_bits());
        if known != NONE {
            let uses = self.uses[known as usize];
            if uses > 0 && uses < u16::MAX && same(self.row(known)) {
                self.uses[known as usize] += 1;
                return known;
            }
        }
        let row = self.free.pop().unwrap_or_else(|| {
            let row = self.uses.len();
            if row.is_multiple_of(self.per_chunk) {
                self.chunks.push(vec![0.0; self.per_chunk * self.width].into());
                self.uses.reserve_exact(self.per_chunk);
            }
            self.uses.push(0);
            u32::try_from(row).ok().filter(|&row| row != NONE).expect("fewer than 2^32 - 1 rows")
        });
        self.uses[row as usize] = 1;
        let at = row as usize % self.per_chunk * self.width;
        self.chunks[row as usize / self.per_chunk][at..at + self.width].copy_from_slice(values);
        self.recent[slot] = row;
        row
    }

    /// Ends one use of a row; the last one frees it.
    pub fn release(&mut self, row: u32) {
        let uses = &mut self.uses[row as usize];
        *uses -= 1;
        if *uses == 0 {
            self.free.push(row);
        }
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        let words = self.chunks.len() * self.per_chunk * self.width + self.free.capacity() + self.recent.len();
        4 * words + 2 * self.uses.capacity()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_rows_are_one_until_the_last_use_ends() {
        let mut states = States::new(2);
        let a = states.hold(&[1.0, 2.0]);
        let b = states.hold(&[1.0, 3.0]);
        assert_ne!(a, b);
        assert_eq!(states.hold(&[1.0, 2.0]), a);
        states.release(a);
        assert_eq!((states.row(a), states.row(b)), (&[1.0, 2.0][..], &[1.0, 3.0][..]));
        states.release(a);
        let c = states.hold(&[5.0, 5.0]);
        assert_eq!(c, a, "its place is used again");
        assert_eq!(states.row(c), [5.0, 5.0]);
        assert_ne!(states.hold(&[1.0, 2.0]), a, "and what was there is not recognised any more");
    }

    #[test]
    fn bits_count() {
        let mut states = States::new(1);
        let (plus, minus) = (states.hold(&[0.0]), states.hold(&[-0.0]));
        assert_ne!(plus, minus);
        assert!(states.row(minus)[0].is_sign_negative());
    }
}
