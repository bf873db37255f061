//! The policy slots of the board.

use gadm_node::settings::SETTINGS_LEN;
use gadm_node::slots::{Flash, FlashError};

use crate::board::{SETTINGS, SLOTS, Span, WRITABLE};

/// Erase unit. That of the STM32F405's upper sectors; the SSRAM of the MPS2 boards is given the same.
const SECTOR_LEN: usize = 0x2_0000;

/// The slots of the board. On the MPS2 boards they lie in SSRAM, which this gives the rules of flash: erasing sets all
/// bits of a sector, programming only clears bits. There is one per program.
#[derive(Debug)]
pub struct BoardFlash(());

impl BoardFlash {
    /// Takes the slots.
    ///
    /// # Safety
    /// At most once in a program, and nothing else in it looks at the addresses of the slots.
    #[must_use]
    pub const unsafe fn take() -> Self {
        Self(())
    }

    fn span(slot: usize) -> Span {
        let [first, second] = SLOTS;
        if slot == 0 { first } else { second }
    }

    fn word(slot: usize, offset: usize) -> Result<*mut u32, FlashError> {
        let span = Self::span(slot);
        if !WRITABLE || offset % 4 != 0 || offset >= span.len {
            return Err(FlashError);
        }
        Ok(core::ptr::with_exposed_provenance_mut(span.address + offset))
    }
}

impl<'p> Flash<'p> for BoardFlash {
    fn slot_len(&self) -> usize {
        Self::span(0).len
    }

    fn sectors(&self) -> usize {
        Self::span(0).len / SECTOR_LEN
    }

    fn writable(&self) -> bool {
        WRITABLE
    }

    fn image(&self, slot: usize) -> &'p [u8] {
        let Span { address, len } = Self::span(slot);
        // SAFETY: memory of the board that is always there, so any lifetime will do. It changes only in `program` and `erase`, and the caller looks
        // at a slot again after it changed it, by the contract of `Flash`; nothing else writes it, by that of `take`.
        unsafe { core::slice::from_raw_parts(core::ptr::with_exposed_provenance(address), len) }
    }

    fn program(&mut self, slot: usize, offset: usize, bytes: &[u8]) -> Result<(), FlashError> {
        for (index, chunk) in bytes.as_chunks::<4>().0.iter().enumerate() {
            let word = Self::word(slot, offset + 4 * index)?;
            // SAFETY: a word of a writable slot, checked by `word`.
            unsafe { word.write_volatile(word.read_volatile() & u32::from_le_bytes(*chunk)) }
        }
        Ok(())
    }

    fn erase(&mut self, slot: usize, sector: usize) -> Result<(), FlashError> {
        for offset in (0..SECTOR_LEN).step_by(4) {
            let word = Self::word(slot, sector * SECTOR_LEN + offset)?;
            // SAFETY: a word of a writable slot, checked by `word`.
            unsafe { word.write_volatile(u32::MAX) }
        }
        Ok(())
    }
}

/// The bytes of the settings record.
#[must_use]
pub fn settings() -> &'static [u8; SETTINGS_LEN] {
    // SAFETY: memory of the board that is always there and that the program does not write.
    unsafe { &*core::ptr::with_exposed_provenance(SETTINGS) }
}
