//! CRC-32 with a table of sixteen words: a device has no 1 KiB of flash to spare for the usual one.

/// The polynomial of CRC-32/ISO-HDLC, reflected.
const POLYNOMIAL: u32 = 0xEDB8_8320;

/// What four bits do to the remainder.
static NIBBLES: [u32; 16] = nibbles();

#[expect(
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    reason = "evaluated by the compiler; indices below 16"
)]
const fn nibbles() -> [u32; 16] {
    let mut table = [0; 16];
    let mut index = 0;
    while index < 16 {
        let mut value = index as u32;
        let mut bit = 0;
        while bit < 4 {
            value = if value & 1 == 1 { (value >> 1) ^ POLYNOMIAL } else { value >> 1 };
            bit += 1;
        }
        table[index] = value;
        index += 1;
    }
    table
}

/// CRC-32/ISO-HDLC of `bytes`, the checksum of header, payload and trailer records.
#[inline(never)]
pub(crate) fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = u32::MAX;
    for &byte in bytes {
        crc ^= u32::from(byte);
        for _ in 0..2 {
            let [low, ..] = crc.to_le_bytes();
            crc = (crc >> 4) ^ NIBBLES.get(usize::from(low & 15)).copied().unwrap_or_default();
        }
    }
    !crc
}

#[cfg(test)]
mod tests {
    use super::crc32;
    use crc::{CRC_32_ISO_HDLC, Crc};
    use proptest::prelude::*;

    #[test]
    fn the_published_check_value() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
        assert_eq!(crc32(b""), 0);
    }

    proptest! {
        #[test]
        fn it_is_that_of_the_crc_crate(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            prop_assert_eq!(crc32(&bytes), Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&bytes));
        }
    }
}
