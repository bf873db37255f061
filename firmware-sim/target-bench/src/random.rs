//! Random layers, as a policy file holds them.

use gadm_runtime::kernels::block_len;

/// Xorshift.
pub struct Random(pub u32);

impl Random {
    /// All 32 bits.
    pub fn next(&mut self) -> u32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 17;
        self.0 ^= self.0 << 5;
        self.0
    }

    /// In `0..n`.
    pub fn below(&mut self, n: u32) -> u32 {
        ((u64::from(self.next()) * u64::from(n)) >> 32) as u32
    }

    /// In `-n..=n`.
    pub fn within(&mut self, n: i32) -> i32 {
        self.below(2 * n.cast_unsigned() + 1).cast_signed() - n
    }
}

/// Fills `words` with the blocks of a layer and returns how many words it took. Padding of columns and rows is zero, as
/// in a file. `largest` bounds the weights, `start` the start values of `a` rows; those of `b` rows may be anything.
pub fn fill(
    words: &mut [u32],
    random: &mut Random,
    rows: usize,
    cols: u16,
    modulated: bool,
    largest: i32,
    start: i32,
) -> usize {
    let len = block_len(cols, modulated) / 4;
    for block in 0..rows.div_ceil(4) {
        let words = &mut words[block * len..(block + 1) * len];
        words.fill(0);
        for row in 0..4.min(rows - 4 * block) {
            let value = if row % 2 == 0 { random.within(start) * 256 } else { random.within(1_900_000_000) };
            let pair = row / 2;
            // [raw0, b0, raw1, b1] with raw = 256 a + b.
            words[2 * pair] = words[2 * pair].wrapping_add(value.cast_unsigned());
            if row % 2 == 1 {
                words[2 * pair + 1] = value.cast_unsigned();
            }
            for col in 0..usize::from(cols) {
                let weight = random.within(largest) * if row % 2 == 0 { 256 } else { 1 };
                let word = &mut words[4 + col / 2 * 2 + pair];
                let shift = 16 * (col % 2) as u32;
                let lane = (*word >> shift) as u16;
                let lane = lane.wrapping_add(weight as u16);
                *word = *word & !(0xFFFF << shift) | u32::from(lane) << shift;
            }
        }
        if !modulated {
            constants(&mut words[len - 8..], random);
        }
    }
    rows.div_ceil(4) * len
}

/// `[M x 4] [P x 4]` of a block.
pub fn constants(words: &mut [u32], random: &mut Random) {
    for (index, word) in words.iter_mut().enumerate() {
        *word = random.within(if index < 4 { 1 << 22 } else { 1 << 14 }).cast_unsigned();
    }
}

/// The words as bytes.
pub fn bytes(words: &[u32]) -> &[u8] {
    // SAFETY: any byte of a `u32` is a valid `u8`, and the length is that of the words.
    unsafe { core::slice::from_raw_parts(words.as_ptr().cast(), words.len() * 4) }
}
