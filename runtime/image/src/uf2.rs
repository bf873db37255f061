//! UF2, 256 data bytes a block.
//!
//! Source: Microsoft, USB Flashing Format (UF2), README of microsoft/uf2: section "File format", flags, family numbers.
//! Written here, because the crates for it read only or have not been kept.

use crate::{ERASED, Format, ImageError, Segment};

const BLOCK: usize = 512;
const HEAD: usize = 32;
/// Data bytes of a written block: what every boot loader takes (the ROM of the RP2040 takes nothing else).
const DATA: usize = 256;
const MAX_DATA: usize = 476;
const MAGIC_0: u32 = 0x0A32_4655;
const MAGIC_1: u32 = 0x9E5D_5157;
const MAGIC_END: u32 = 0x0AB1_6F30;
const NOT_MAIN_FLASH: u32 = 0x0000_0001;
const FILE_CONTAINER: u32 = 0x0000_1000;
const FAMILY_PRESENT: u32 = 0x0000_2000;

pub(crate) fn is_uf2(content: &[u8]) -> bool {
    word(content, 0) == Some(MAGIC_0) && word(content, 4) == Some(MAGIC_1)
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes)
}

pub(crate) fn encode(address: u32, bytes: &[u8], family: Option<u32>) -> Vec<u8> {
    let count = bytes.len().div_ceil(DATA);
    let mut content = Vec::with_capacity(count * BLOCK);
    for (number, data) in bytes.chunks(DATA).enumerate() {
        let flags = if family.is_some() { FAMILY_PRESENT } else { 0 };
        let target = address + (number * DATA) as u32;
        let head =
            [MAGIC_0, MAGIC_1, flags, target, DATA as u32, number as u32, count as u32, family.unwrap_or_default()];
        let start = content.len();
        content.extend(head.iter().flat_map(|word| word.to_le_bytes()));
        content.extend_from_slice(data);
        content.resize(start + HEAD + DATA, ERASED);
        content.resize(start + BLOCK - 4, 0);
        content.extend_from_slice(&MAGIC_END.to_le_bytes());
    }
    content
}

/// Pieces and the family number. Blocks that are not for the main flash are passed over; blocks of several families in
/// one file are refused, because they are alternatives.
pub(crate) fn decode(content: &[u8]) -> Result<(Vec<Segment>, Option<u32>), ImageError> {
    let damaged = |block: usize, what: &str| ImageError::Damaged {
        format: Format::Uf2,
        place: format!("block {block}"),
        what: what.to_owned(),
    };
    let (blocks, rest) = content.as_chunks::<BLOCK>();
    if !rest.is_empty() {
        return Err(damaged(blocks.len(), "the last block is cut off"));
    }
    let mut segments: Vec<Segment> = Vec::new();
    let mut family: Option<Option<u32>> = None;
    let mut seen = vec![false; blocks.len()];
    for (index, block) in blocks.iter().enumerate() {
        let field = |at| word(block, at).expect("a block has 512 bytes");
        if field(0) != MAGIC_0 || field(4) != MAGIC_1 || field(BLOCK - 4) != MAGIC_END {
            return Err(damaged(index, "its magic numbers are wrong"));
        }
        let (flags, address, len, number, count) = (field(8), field(12), field(16) as usize, field(20), field(24));
        if count as usize != blocks.len() {
            return Err(damaged(index, &format!("it belongs to a file of {count} blocks, this has {}", blocks.len())));
        }
        match seen.get_mut(number as usize) {
            Some(seen) if !*seen => *seen = true,
            _ => return Err(damaged(index, &format!("its number {number} is there twice or beyond the count"))),
        }
        if flags & (NOT_MAIN_FLASH | FILE_CONTAINER) != 0 {
            continue;
        }
        if len > MAX_DATA {
            return Err(damaged(index, &format!("{len} data bytes, at most {MAX_DATA} fit")));
        }
        let own = (flags & FAMILY_PRESENT != 0).then(|| field(28));
        if *family.get_or_insert(own) != own {
            return Err(damaged(index, "blocks of several chip families in one file; split it"));
        }
        segments.push(Segment { address, bytes: block[HEAD..HEAD + len].to_vec() });
    }
    Ok((segments, family.flatten()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_block_byte_by_byte() {
        let content = encode(0x1010_0000, &[0xAB; 250], Some(0xE48B_FF56));
        assert_eq!(content.len(), 512);
        let head = [
            0x55, 0x46, 0x32, 0x0A, 0x57, 0x51, 0x5D, 0x9E, 0x00, 0x20, 0, 0, 0, 0, 0x10, 0x10, 0, 1, 0, 0, 0, 0, 0, 0,
            1, 0, 0, 0, 0x56, 0xFF, 0x8B, 0xE4,
        ];
        assert_eq!(content[..32], head);
        assert_eq!(content[32..282], [0xAB; 250]);
        assert_eq!(content[282..288], [ERASED; 6]);
        assert_eq!(content[508..], [0x30, 0x6F, 0xB1, 0x0A]);
    }

    #[test]
    fn what_a_block_can_lack() {
        let good = encode(0, &[1; 600], None);
        assert_eq!(decode(&good).unwrap().0.len(), 3);
        for (at, byte, word) in [(0, 0, "magic"), (508, 0, "magic"), (24, 9, "9 blocks"), (512 + 20, 0, "twice")] {
            let mut bad = good.clone();
            bad[at] = byte;
            let error = decode(&bad).unwrap_err().to_string();
            assert!(error.contains(word), "{at}: {error}");
        }
        assert!(decode(&good[..1000]).unwrap_err().to_string().contains("cut off"));
        assert!(decode(&good[..1024]).unwrap_err().to_string().contains("3 blocks"));
    }

    #[test]
    fn families_are_not_mixed() {
        let mut both = encode(0, &[1; 512], Some(7));
        both[512 + 28] = 8;
        assert!(decode(&both).unwrap_err().to_string().contains("several chip families"));
    }
}
