//! A policy on its way over the bus: blocks with offset and CRC, resumable by offset.
//!
//! ```text
//! host  LENGTH n · BEGIN crc · ( BLOCK at · TRANSFER … · COMMIT crc )* · END · ACTIVATE · … · CONFIRM
//! node         max        offset    offset              next offset      slot   slot             slot
//! ```
//!
//! LENGTH to CONFIRM are REQUEST frames, each answered by a REPLY with the value below it. A block is
//! [`BLOCK`] bytes (the last may be shorter) and is written only when all of it came and its CRC is right. After a loss of
//! power, BEGIN with the same length and CRC finds the blocks that were written and answers the offset to go on from.

use crc::{CRC_32_ISCSI, Crc, NoTable};

use crate::slots::{CRC32, UNIT};
use crate::store::Refusal;

/// Bytes of a block.
pub const BLOCK: usize = 256;

/// CRC-32/ISO-HDLC of a block, as COMMIT carries it.
#[must_use]
pub fn checksum(bytes: &[u8]) -> u32 {
    CRC32.checksum(bytes)
}

/// CRC-32C (iSCSI) of a whole image, as BEGIN carries it.
///
/// That of the blocks would not do: the header of an image ends in its own CRC-32/ISO-HDLC, and data followed by their CRC
/// leave the same remainder whatever they are. Images that differ in the header only, in the sequence number say, would be
/// one and the same.
#[must_use]
pub fn image_checksum(image: &[u8]) -> u32 {
    CRC32C.checksum(image)
}

/// Without a table: it runs over an image twice, at its announcement and at its end.
const CRC32C: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISCSI);

/// Where to go on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Resume(u32);

impl Resume {
    /// All before `offset` is there.
    pub(crate) const fn complete(offset: u32) -> Self {
        Self(offset)
    }

    /// The block that holds the last written byte may have been cut off: it comes again, which changes no bit that is
    /// right already.
    pub(crate) fn after(image: &[u8], len: u32) -> Self {
        let written = image.iter().take(usize::try_from(len).unwrap_or(0)).rposition(|&b| b != 0xFF).unwrap_or(0);
        Self(u32::try_from(written - written % BLOCK).unwrap_or(0))
    }
}

/// A block to be written.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Block {
    pub(crate) slot: usize,
    pub(crate) offset: usize,
    buffer: [u8; BLOCK],
    len: usize,
}

impl Block {
    /// The bytes, up to the end of a unit; what is beyond the block is as erased flash.
    pub(crate) fn bytes(&self) -> &[u8] {
        self.buffer.get(..self.len.next_multiple_of(UNIT)).unwrap_or(&[])
    }
}

/// State of a transfer. Lives in RAM: what a loss of power must not take is in the slot.
#[derive(Clone, Debug)]
pub(crate) struct Transfer {
    len: Option<u32>,
    /// Target slot and CRC of the image, from BEGIN on.
    begun: Option<(usize, u32)>,
    next: u32,
    open: bool,
    index: u8,
    filled: usize,
    whole: bool,
    buffer: [u8; BLOCK],
}

impl Transfer {
    pub(crate) const fn new() -> Self {
        Self { len: None, begun: None, next: 0, open: false, index: 0, filled: 0, whole: true, buffer: [0xFF; BLOCK] }
    }

    pub(crate) fn announce(&mut self, len: u32) {
        *self = Self { len: Some(len), ..Self::new() };
    }

    pub(crate) fn announced(&self) -> Option<u32> {
        self.len
    }

    pub(crate) fn begin(&mut self, slot: usize, crc: u32, resume: Resume) -> u32 {
        self.begun = Some((slot, crc));
        self.next = resume.0;
        self.open = false;
        self.next
    }

    fn block_len(&self) -> usize {
        usize::try_from(self.len.unwrap_or(0).saturating_sub(self.next)).unwrap_or(0).min(BLOCK)
    }

    pub(crate) fn open_block(&mut self, offset: u32) -> Result<u32, Refusal> {
        if self.begun.is_none() {
            return Err(Refusal::Order);
        }
        if offset != self.next || self.block_len() == 0 {
            return Err(Refusal::Offset);
        }
        (self.open, self.index, self.filled, self.whole) = (true, 0, 0, true);
        self.buffer = [0xFF; BLOCK];
        Ok(offset)
    }

    /// Takes the bytes of one frame. CAN FD pads: what is beyond the end of the block is not looked at.
    pub(crate) fn data(&mut self, index: u8, bytes: &[u8]) {
        if !self.open {
            return;
        }
        let room = self.block_len().saturating_sub(self.filled);
        let taken = bytes.len().min(room);
        self.whole &= index == self.index && taken > 0;
        self.index = self.index.wrapping_add(1);
        for (place, byte) in self.buffer.iter_mut().skip(self.filled).zip(bytes.iter().take(taken)) {
            *place = *byte;
        }
        self.filled += taken;
    }

    pub(crate) fn take_block(&mut self, crc: u32) -> Result<Block, Refusal> {
        let (slot, _) = self.begun.ok_or(Refusal::Order)?;
        if !core::mem::take(&mut self.open) {
            return Err(Refusal::Order);
        }
        let len = self.block_len();
        let bytes = self.buffer.get(..len).unwrap_or(&[]);
        if !self.whole || self.filled != len || CRC32.checksum(bytes) != crc {
            return Err(Refusal::BlockCrc);
        }
        Ok(Block { slot, offset: usize::try_from(self.next).unwrap_or(0), buffer: self.buffer, len })
    }

    pub(crate) fn written(&mut self, block: &Block) -> u32 {
        self.next = self.next.saturating_add(u32::try_from(block.len).unwrap_or(0));
        self.next
    }

    /// Slot, length and CRC of an image that is all there.
    pub(crate) fn received(&self) -> Result<(usize, usize, u32), Refusal> {
        let ((slot, crc), len) = self.begun.zip(self.len).ok_or(Refusal::Order)?;
        if self.next < len {
            return Err(Refusal::Offset);
        }
        Ok((slot, usize::try_from(len).unwrap_or(0), crc))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(len: u32) -> Transfer {
        let mut t = Transfer::new();
        t.announce(len);
        t.begin(0, 0, Resume::complete(0));
        t.open_block(0).unwrap();
        t
    }

    #[test]
    fn a_block_is_taken_only_when_all_of_it_came_in_order_and_its_crc_is_right() {
        let crc = CRC32.checksum(&[7; 16]);
        let mut t = open(16);
        t.data(0, &[7; 7]);
        t.data(1, &[7; 7]);
        t.data(2, &[7; 5]); // padded
        let block = t.take_block(crc).unwrap();
        assert_eq!((block.bytes().len(), &block.bytes()[..16]), (UNIT, &[7; 16][..]));
        assert_eq!(block.bytes()[16], 0xFF);
        assert_eq!(t.written(&block), 16);
        for damage in 0..4 {
            let mut t = open(16);
            t.data(0, &[7; 7]);
            match damage {
                0 => {}
                1 => t.data(2, &[7; 9]),
                2 => t.data(1, &[8; 9]),
                _ => (1..4).for_each(|i| t.data(i, &[7; 7])), // one frame too many
            }
            assert_eq!(t.take_block(crc).err(), Some(Refusal::BlockCrc), "{damage}");
            assert_eq!(t.take_block(crc).err(), Some(Refusal::Order), "closed after the attempt");
        }
    }

    #[test]
    fn operations_out_of_order_are_refused() {
        let mut t = Transfer::new();
        assert_eq!(t.open_block(0), Err(Refusal::Order));
        assert_eq!(t.received(), Err(Refusal::Order));
        t.announce(512);
        t.begin(1, 0, Resume::complete(256));
        assert_eq!(t.open_block(0), Err(Refusal::Offset));
        assert_eq!(t.received(), Err(Refusal::Offset));
        assert_eq!(t.open_block(256), Ok(256));
    }

    #[test]
    fn a_transfer_goes_on_at_the_block_that_was_written_last() {
        let mut image = [0xFF; 1024];
        assert_eq!(Resume::after(&image, 1024).0, 0);
        image[0] = 1;
        assert_eq!(Resume::after(&image, 1024).0, 0);
        image[600] = 1;
        assert_eq!(Resume::after(&image, 1024).0, 512);
        image[1000] = 0; // marks, beyond the image
        assert_eq!(Resume::after(&image, 700).0, 512);
    }
}
