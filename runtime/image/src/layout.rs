//! Where a policy may lie: erase blocks, the region that is free for it, the place the core starts from.

use std::ops::Range;

use crate::format::check_address;
use crate::{Chip, ImageError};

/// Erase blocks of one size that follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bank {
    /// Address of the first one.
    pub start: u32,
    /// Bytes of each: what one erase command clears.
    pub block: u32,
    /// How many.
    pub count: u32,
}

impl Bank {
    const fn end(&self) -> u64 {
        self.start as u64 + self.block as u64 * self.count as u64
    }
}

/// One erase block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// Address of its first byte.
    pub address: u32,
    /// Its length in bytes.
    pub len: u32,
}

/// The erase blocks that a policy takes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Placement {
    /// Blocks by rising address; all of them are erased before the policy is written.
    pub blocks: Vec<Block>,
    /// Bytes of these blocks behind the policy, erased and unused.
    pub unused: u64,
}

/// Erase blocks and limits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    banks: Vec<Bank>,
    region: Option<Range<u32>>,
    boot: Option<u32>,
}

impl Layout {
    /// The flash of a chip.
    #[must_use]
    pub fn of_chip(chip: &Chip) -> Self {
        Self { banks: chip.banks.to_vec(), region: None, boot: Some(chip.boot) }
    }

    /// Blocks of one size that fill `region`, first and first address behind it.
    ///
    /// # Errors
    /// [`ImageError::Layout`] for a size that is not a multiple of 16 or a region that holds no whole number of blocks.
    pub fn uniform(block: u32, region: Range<u32>) -> Result<Self, ImageError> {
        if block == 0 || !block.is_multiple_of(crate::ADDRESS_ALIGN) {
            let (found, expected) = (format!("{block} bytes"), "a multiple of 16 bytes");
            return Err(ImageError::Layout { what: "erase block", found, expected });
        }
        let len = check_region(&region)?;
        if !len.is_multiple_of(block) {
            let found = format!("{len} bytes in blocks of {block}");
            return Err(ImageError::Layout { what: "region", found, expected: "a whole number of erase blocks" });
        }
        Ok(Self { banks: vec![Bank { start: region.start, block, count: len / block }], region: None, boot: None })
    }

    /// The same blocks, of which only those inside of `region` are free.
    ///
    /// # Errors
    /// [`ImageError::Layout`] for an empty region.
    pub fn within(self, region: Range<u32>) -> Result<Self, ImageError> {
        check_region(&region)?;
        Ok(Self { region: Some(region), ..self })
    }

    /// The blocks that `bytes` bytes at `address` take.
    ///
    /// # Errors
    /// What makes this a place where the policy cannot lie, with places where it can.
    pub fn place(&self, address: u32, bytes: usize) -> Result<Placement, ImageError> {
        check_address(address, bytes)?;
        let end = u64::from(address) + bytes as u64;
        if let Some(region) = &self.region
            && (address < region.start || end > u64::from(region.end))
        {
            let (what, advice) = ("the region", self.advice(bytes));
            return Err(ImageError::Outside {
                what,
                address,
                bytes,
                start: region.start,
                end: region.end.into(),
                advice,
            });
        }
        let blocks: Vec<Block> = self.blocks(address, end).collect();
        let covered: u64 = blocks.iter().map(|block| u64::from(block.len)).sum();
        let first = blocks.first().map(|block| block.address);
        let last_end = blocks.last().map_or(0, |block| u64::from(block.address) + u64::from(block.len));
        // Blocks do not overlap, so they have no gap exactly when their lengths add up.
        let whole = first.is_some_and(|first| first <= address && covered == last_end - u64::from(first));
        if !whole || last_end < end {
            let (start, flash_end) = self.flash();
            let advice = self.advice(bytes);
            return Err(ImageError::Outside { what: "flash", address, bytes, start, end: flash_end, advice });
        }
        if let Some(block) = blocks.first().filter(|block| block.address != address) {
            let advice = self.advice(bytes);
            return Err(ImageError::NotOnBlock { address, start: block.address, block: block.len, advice });
        }
        if self.boot == Some(address) {
            return Err(ImageError::Boot { address, advice: self.advice(bytes) });
        }
        match &self.region {
            Some(region) if last_end > u64::from(region.end) => {
                Err(ImageError::BlockBeyondRegion { block_end: last_end, end: region.end.into() })
            }
            _ => Ok(Placement { unused: last_end - end, blocks }),
        }
    }

    /// Addresses where a policy of this length fits and starts an erase block, the highest first: the far end of flash
    /// is least likely to be taken by the firmware.
    #[must_use]
    pub fn suggestions(&self, bytes: usize) -> Vec<u32> {
        let mut fits = Vec::new();
        for bank in self.banks.iter().rev() {
            for number in (0..bank.count).rev() {
                let address = bank.start + number * bank.block;
                if self.place_is_free(address, bytes) {
                    fits.push(address);
                    if fits.len() == 3 {
                        return fits;
                    }
                }
            }
        }
        fits
    }

    fn place_is_free(&self, address: u32, bytes: usize) -> bool {
        let end = u64::from(address) + bytes as u64;
        let blocks = self.blocks(address, end);
        let reached = blocks.fold(u64::from(address), |reached, block| {
            // A gap between banks stops here.
            if u64::from(block.address) == reached { reached + u64::from(block.len) } else { reached }
        });
        let region = self.region.as_ref();
        let inside = region.is_none_or(|region| address >= region.start && reached <= u64::from(region.end));
        inside && reached >= end && self.boot != Some(address) && check_address(address, bytes).is_ok()
    }

    fn advice(&self, bytes: usize) -> String {
        let fits: Vec<String> = self.suggestions(bytes).iter().map(|address| format!("{address:#010x}")).collect();
        if fits.is_empty() {
            "it fits nowhere there: take a smaller policy or a larger chip".to_owned()
        } else {
            format!("it fits at {}", fits.join(", "))
        }
    }

    /// Blocks that `start..end` touches.
    fn blocks(&self, start: u32, end: u64) -> impl Iterator<Item = Block> + '_ {
        self.banks.iter().flat_map(move |bank| {
            let first = start.saturating_sub(bank.start) / bank.block;
            let behind = end.min(bank.end()).saturating_sub(u64::from(bank.start)).div_ceil(u64::from(bank.block));
            (first..(behind as u32).max(first))
                .map(|number| Block { address: bank.start + number * bank.block, len: bank.block })
        })
    }

    fn flash(&self) -> (u32, u64) {
        let start = self.banks.iter().map(|bank| bank.start).min().unwrap_or(0);
        (start, self.banks.iter().map(Bank::end).max().unwrap_or(0))
    }
}

fn check_region(region: &Range<u32>) -> Result<u32, ImageError> {
    if region.start < region.end {
        Ok(region.end - region.start)
    } else {
        let found = format!("{:#010x}..{:#010x}", region.start, region.end);
        Err(ImageError::Layout { what: "region", found, expected: "FIRST..BEHIND with FIRST below BEHIND" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chip;

    fn f405() -> Layout {
        Layout::of_chip(chip("stm32f405").unwrap())
    }

    #[test]
    fn blocks_of_unequal_size() {
        // 36 kB at the fourth 16 KiB sector: it and the 64 KiB sector behind it.
        let place = f405().place(0x0800_C000, 36_864).unwrap();
        let expected = [Block { address: 0x0800_C000, len: 0x4000 }, Block { address: 0x0801_0000, len: 0x1_0000 }];
        assert_eq!(place.blocks, expected);
        assert_eq!(place.unused, 0x1_4000 - 36_864);
        let place = f405().place(0x0806_0000, 131_072).unwrap();
        assert_eq!((place.blocks.len(), place.unused), (1, 0));
        assert_eq!(f405().place(0x0806_0000, 131_088).unwrap().blocks.len(), 2);
    }

    #[test]
    fn places_where_it_cannot_lie() {
        let says = |address, bytes, words: &[&str]| {
            let error = f405().place(address, bytes).unwrap_err().to_string();
            assert!(words.iter().all(|word| error.contains(word)), "{error}");
        };
        says(0x0806_4000, 1024, &["inside of the erase block 0x08060000", "131072", "fits at 0x080e0000"]);
        says(0x0800_0000, 1024, &["core starts from"]);
        says(0x080E_0000, 131_088, &["not inside of flash", "0x08100000", "0x080c0000"]);
        says(0x2000_0000, 1024, &["not inside of flash"]);
        says(0x07FF_0000, 1024, &["not inside of flash"]);
        says(0x0806_0004, 1024, &["multiple of 16"]);
        says(0x0806_0000, 2 << 20, &["fits nowhere"]);
    }

    #[test]
    fn a_region_keeps_the_rest_of_the_flash() {
        let slot = f405().within(0x0804_0000..0x0806_0000).unwrap();
        assert!(slot.place(0x0804_0000, 131_072).is_ok());
        assert!(matches!(slot.place(0x0806_0000, 16), Err(ImageError::Outside { what: "the region", .. })));
        assert_eq!(slot.suggestions(1000), [0x0804_0000]);
        let short = f405().within(0x0804_0000..0x0804_8000).unwrap();
        assert!(matches!(short.place(0x0804_0000, 1024), Err(ImageError::BlockBeyondRegion { .. })));
        assert!(short.suggestions(1024).is_empty());
    }

    #[test]
    fn blocks_of_one_given_size() {
        let layout = Layout::uniform(4096, 0x20_0000..0x40_0000).unwrap();
        assert_eq!(layout.place(0x20_1000, 5000).unwrap().blocks.len(), 2);
        assert!(matches!(layout.place(0x20_0800, 16), Err(ImageError::NotOnBlock { .. })));
        assert!(Layout::uniform(0, 0..4096).is_err());
        assert!(Layout::uniform(4096, 0..5000).is_err());
        assert!(Layout::uniform(4096, 8192..8192).is_err());
    }

    #[test]
    fn every_suggestion_is_a_place() {
        for chip in crate::CHIPS {
            let layout = Layout::of_chip(chip);
            for bytes in [16, 36_864, 131_088, 400_000] {
                let fits = layout.suggestions(bytes);
                assert!(!fits.is_empty(), "{}", chip.name);
                for address in fits {
                    layout.place(address, bytes).unwrap();
                }
            }
        }
    }
}
