//! Two policy slots in flash: which one to boot, and what was decided about each, safe against loss of power at any word.
//!
//! A slot is a run of erase sectors. The image lies at its start, [`MARKS_LEN`] bytes of marks at its end:
//!
//! | unit | mark | written |
//! | --- | --- | --- |
//! | 0 | record: generation, length and CRC-32C of the image to come, CRC-32 over these | after the erasure, before the first block |
//! | 1 | staged | when the whole image was received and checked |
//! | 2 | trial | when it is to be booted for the first time |
//! | 3 | confirmed | when it proved itself |
//! | 4 | revoked | when it did not |
//!
//! A mark is a number and its complement, so a mark that was being written when the power went is none. Marks are only
//! ever added, and every step from "old policy boots" to "new policy boots" is the writing of one mark: confirmed. What
//! boots is the confirmed policy of highest sequence number (then generation) that loads and passes its own vectors. A
//! slot without any marks was written by a flashing tool and counts as confirmed.
//!
//! Nothing is copied or swapped, unlike with boot loaders whose program must lie at one address: policies run in place.

use core::cmp::Reverse;

use crc::{CRC_32_ISO_HDLC, Crc};
use strum::{FromRepr, IntoStaticStr, VariantArray};

use crate::coded::coded;
use crate::policy::load;
use crate::store::{Candidate, Operation, Refusal, Store};
use crate::transfer::{Resume, Transfer, image_checksum};

pub(crate) const CRC32: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// What is programmed at once: a multiple of the program width of common flash (4 to 32 bytes).
pub const UNIT: usize = 32;
/// Bytes at the end of a slot that hold its marks.
pub const MARKS_LEN: usize = 8 * UNIT;
/// Time after its boot in which a policy on trial must be confirmed, microseconds of the node's time.
pub const TRIAL_US: u64 = 60_000_000;
/// Shortest image: header and section table.
const MIN_IMAGE: usize = 128;

/// The flash did not do what was asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FlashError;

impl core::fmt::Display for FlashError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the flash did not erase or program")
    }
}

impl core::error::Error for FlashError {}

/// Two policy slots in memory-mapped flash. Erased bytes are 0xFF; programming only clears bits.
pub trait Flash<'p> {
    /// Bytes of a slot, a multiple of [`UNIT`].
    fn slot_len(&self) -> usize;

    /// Erase sectors of a slot, in the order of their addresses.
    fn sectors(&self) -> usize;

    /// Slots can be written. Without, a flashing tool is the only way.
    fn writable(&self) -> bool {
        true
    }

    /// The bytes of slot 0 or 1 as they are now. The caller does not look at them any more after it had that slot
    /// programmed or erased, but asks again.
    fn image(&self, slot: usize) -> &'p [u8];

    /// Programs `bytes` at `offset` in a slot, both multiples of [`UNIT`]. A bit that is to be set where it is clear stays
    /// clear; flash with error correction may refuse to program a unit twice.
    ///
    /// # Errors
    /// Where the flash reports one.
    fn program(&mut self, slot: usize, offset: usize, bytes: &[u8]) -> Result<(), FlashError>;

    /// Erases one sector. A board with a watchdog feeds it meanwhile.
    ///
    /// # Errors
    /// Where the flash reports one.
    fn erase(&mut self, slot: usize, sector: usize) -> Result<(), FlashError>;
}

/// What the marks say about a slot. The number is the one on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, IntoStaticStr, VariantArray)]
#[repr(u8)]
#[strum(serialize_all = "lowercase")]
pub enum SlotState {
    /// Erased.
    Empty = 0,
    /// An image without marks: written by a flashing tool; counts as confirmed.
    Flashed = 1,
    /// A transfer was begun and not ended.
    Receiving = 2,
    /// Received and checked.
    Staged = 3,
    /// To be booted, or booted, for the first time.
    Trial = 4,
    /// Proven; may be booted at any time.
    Confirmed = 5,
    /// Failed, or not confirmed in time.
    Revoked = 6,
    /// Marks without sense, as an erasure leaves that was cut off.
    Damaged = 7,
}

coded!(SlotState);

impl SlotState {
    /// The policy may be booted without being asked for.
    const fn boots(self) -> bool {
        matches!(self, Self::Flashed | Self::Confirmed)
    }
}

/// A mark that is set once.
#[derive(Clone, Copy)]
enum Mark {
    Staged = 1,
    Trial = 2,
    Confirmed = 3,
    Revoked = 4,
}

impl Mark {
    /// Bytes of the mark: a number, its complement, the rest of the unit erased.
    fn bytes(self) -> [u8; UNIT] {
        let number = 0x4741_4400 | self as u32;
        let mut unit = [0xFF; UNIT];
        for (place, byte) in unit.iter_mut().zip(number.to_le_bytes().into_iter().chain((!number).to_le_bytes())) {
            *place = byte;
        }
        unit
    }
}

/// The record of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Record {
    generation: u32,
    len: u32,
    crc: u32,
}

impl Record {
    fn bytes(self) -> [u8; UNIT] {
        let mut unit = [0xFF; UNIT];
        let fields = [self.generation, self.len, self.crc].map(u32::to_le_bytes);
        let check = CRC32.checksum(fields.as_flattened()).to_le_bytes();
        for (place, byte) in unit.iter_mut().zip(fields.as_flattened().iter().copied().chain(check)) {
            *place = byte;
        }
        unit
    }

    fn read(unit: &[u8; UNIT]) -> Option<Self> {
        let (words, _) = unit.as_chunks::<4>();
        let mut numbers = words.iter().map(|&word| u32::from_le_bytes(word));
        let record = Self { generation: numbers.next()?, len: numbers.next()?, crc: numbers.next()? };
        (record.bytes() == *unit).then_some(record)
    }
}

/// All that a slot's bytes say about it.
#[derive(Clone, Copy, Debug)]
struct Slot {
    state: SlotState,
    record: Option<Record>,
}

/// Neither written nor torn. Emulators fill memory with zeros.
fn blank(bytes: &[u8]) -> bool {
    bytes.iter().all(|&b| b == 0xFF) || bytes.iter().all(|&b| b == 0)
}

impl Slot {
    fn read(bytes: &[u8]) -> Self {
        let marks = bytes.len().checked_sub(MARKS_LEN).and_then(|at| bytes.get(at..)).unwrap_or(&[]);
        let (units, _) = marks.as_chunks::<UNIT>();
        let is_set = |mark: Mark| units.get(mark as usize).is_some_and(|unit| *unit == mark.bytes());
        let record = units.first().and_then(Record::read);
        let state = match record {
            None if !blank(marks) || units.is_empty() => SlotState::Damaged,
            None if bytes.get(..MIN_IMAGE).is_none_or(blank) => SlotState::Empty,
            None => SlotState::Flashed,
            Some(_) if is_set(Mark::Revoked) => SlotState::Revoked,
            Some(_) if is_set(Mark::Confirmed) => SlotState::Confirmed,
            Some(_) if is_set(Mark::Trial) => SlotState::Trial,
            Some(_) if is_set(Mark::Staged) => SlotState::Staged,
            Some(_) => SlotState::Receiving,
        };
        Self { state, record }
    }
}

/// Two slots as the [`Store`] of a node.
#[derive(Debug)]
pub struct Slots<F> {
    flash: F,
    transfer: Transfer,
    /// To be booted next, once.
    pending: Option<usize>,
    on_trial: Option<usize>,
    running: Option<usize>,
    /// Failed since power-on.
    rejected: [bool; 2],
    /// Offered in this boot.
    offered: [bool; 2],
}

impl<F> Slots<F> {
    /// The slots of `flash`.
    pub const fn new(flash: F) -> Self {
        Self {
            flash,
            transfer: Transfer::new(),
            pending: None,
            on_trial: None,
            running: None,
            rejected: [false; 2],
            offered: [false; 2],
        }
    }

    /// The flash.
    pub fn flash_mut(&mut self) -> &mut F {
        &mut self.flash
    }

    fn is_rejected(&self, slot: usize) -> bool {
        self.rejected.get(slot).copied().unwrap_or(true)
    }
}

/// The other slot.
const fn other(slot: usize) -> usize {
    1 - (slot & 1)
}

impl<F> Slots<F> {
    fn slot<'p>(&self, slot: usize) -> Slot
    where
        F: Flash<'p>,
    {
        Slot::read(self.flash.image(slot))
    }

    /// Sequence number of the policy in a slot; `None` where it does not load.
    fn sequence<'p>(&self, slot: usize) -> Option<u32>
    where
        F: Flash<'p>,
    {
        load(self.flash.image(slot)).ok().map(|policy| policy.header().policy_seq)
    }

    /// The slot whose policy boots by itself, and the policy's sequence number.
    fn best<'p>(&self) -> Option<(usize, u32)>
    where
        F: Flash<'p>,
    {
        let usable = [0, 1].into_iter().filter(|&s| !self.is_rejected(s)).filter_map(|s| {
            let slot = self.slot(s);
            let sequence = slot.state.boots().then(|| self.sequence(s))??;
            Some((sequence, slot.record.map_or(0, |r| r.generation), s))
        });
        usable.max_by_key(|&(sequence, generation, s)| (sequence, generation, Reverse(s))).map(|(seq, _, s)| (s, seq))
    }

    /// CRC-32 of the payload of the policy that boots by itself; 0 where there is none.
    pub fn policy_crc<'p>(&self) -> u32
    where
        F: Flash<'p>,
    {
        let image = self.best().map(|(slot, _)| self.flash.image(slot));
        image.and_then(|image| load(image).ok()).map_or(0, |policy| policy.header().payload_crc32)
    }

    fn mark<'p>(&mut self, slot: usize, mark: Mark) -> Result<(), Refusal>
    where
        F: Flash<'p>,
    {
        self.write(slot, self.flash.slot_len().saturating_sub(MARKS_LEN) + UNIT * mark as usize, &mark.bytes())
    }

    /// Programs and reads back.
    fn write<'p>(&mut self, slot: usize, offset: usize, bytes: &[u8]) -> Result<(), Refusal>
    where
        F: Flash<'p>,
    {
        self.flash.program(slot, offset, bytes).map_err(|FlashError| Refusal::Flash)?;
        let found = self.flash.image(slot).get(offset..).and_then(|rest| rest.get(..bytes.len()));
        if found == Some(bytes) { Ok(()) } else { Err(Refusal::Flash) }
    }

    /// Where a transfer goes: never to the slot that boots by itself.
    fn target<'p>(&self, len: u32, crc: u32) -> usize
    where
        F: Flash<'p>,
    {
        if let Some((best, _)) = self.best() {
            return other(best);
        }
        let same = |s: &usize| self.slot(*s).record.is_some_and(|r| (r.len, r.crc) == (len, crc));
        [1, 0].into_iter().find(same).unwrap_or(1)
    }

    /// The next slot that was not offered in this boot. What should boot and does not load comes first, so that it is
    /// noticed; what is empty comes last.
    fn next_by_itself<'p>(&self) -> Option<usize>
    where
        F: Flash<'p>,
    {
        let left = [0, 1].into_iter().filter(|&s| self.offered.get(s) == Some(&false));
        let ordered = left.filter_map(|s| {
            let slot = self.slot(s);
            let order = match (slot.state, self.sequence(s)) {
                (SlotState::Empty, _) => (0, 0, 0),
                (state, _) if !state.boots() => return None,
                (_, None) => (2, 0, 0),
                (_, Some(sequence)) => (1, sequence, slot.record.map_or(0, |r| r.generation)),
            };
            Some((order, s))
        });
        ordered.max_by_key(|&(order, s)| (order, Reverse(s))).map(|(_, s)| s)
    }

    fn begin<'p>(&mut self, crc: u32, anew: bool) -> Result<u32, Refusal>
    where
        F: Flash<'p>,
    {
        let len = self.transfer.announced().ok_or(Refusal::Order)?;
        let target = self.target(len, crc);
        if self.running == Some(target) {
            return Err(Refusal::State);
        }
        let slot = self.slot(target);
        let same = slot.record.is_some_and(|r| (r.len, r.crc) == (len, crc)) && !anew;
        let resume = match slot.state {
            SlotState::Receiving if same => Resume::after(self.flash.image(target), len),
            SlotState::Staged | SlotState::Trial if same => Resume::complete(len),
            _ => {
                self.clear(target)?;
                let generations = [0, 1].map(|s| self.slot(s).record.map_or(0, |r| r.generation));
                let generation = generations.into_iter().max().unwrap_or(0).saturating_add(1);
                let marks = self.flash.slot_len().saturating_sub(MARKS_LEN);
                self.write(target, marks, &Record { generation, len, crc }.bytes())?;
                Resume::complete(0)
            }
        };
        if let Some(rejected) = self.rejected.get_mut(target) {
            *rejected = false;
        }
        Ok(self.transfer.begin(target, crc, resume))
    }

    /// Erases a slot. Its header is spoilt first and its marks go last, so that at no moment an old image is there
    /// without the marks that tell what it is.
    fn clear<'p>(&mut self, slot: usize) -> Result<(), Refusal>
    where
        F: Flash<'p>,
    {
        let failed = |FlashError| Refusal::Flash;
        if !self.flash.image(slot).get(..UNIT).is_none_or(blank) {
            // Flash that refuses this erases its first sector at once, which spoils the header too.
            let _refused = self.flash.program(slot, 0, &[0; UNIT]);
        }
        for sector in 0..self.flash.sectors() {
            self.flash.erase(slot, sector).map_err(failed)?;
        }
        if self.flash.image(slot).iter().all(|&b| b == 0xFF) { Ok(()) } else { Err(Refusal::Flash) }
    }

    fn commit<'p>(&mut self, crc: u32) -> Result<u32, Refusal>
    where
        F: Flash<'p>,
    {
        let block = self.transfer.take_block(crc)?;
        self.write(block.slot, block.offset, block.bytes())?;
        Ok(self.transfer.written(&block))
    }

    fn end<'p>(&mut self, check: &mut dyn FnMut(&'p [u8]) -> Result<(), Refusal>) -> Result<u32, Refusal>
    where
        F: Flash<'p>,
    {
        let (target, len, crc) = self.transfer.received()?;
        let image = self.flash.image(target).get(..len).ok_or(Refusal::Length)?;
        if image_checksum(image) != crc {
            return Err(Refusal::ImageCrc);
        }
        check(image)?;
        let sequence = self.sequence(target).ok_or(Refusal::Load)?;
        if self.best().is_some_and(|(_, confirmed)| sequence < confirmed) {
            return Err(Refusal::Older);
        }
        if self.slot(target).state == SlotState::Receiving {
            self.mark(target, Mark::Staged)?;
        }
        self.transfer = Transfer::new();
        Ok(number(target))
    }

    fn activate<'p>(&mut self) -> Result<u32, Refusal>
    where
        F: Flash<'p>,
    {
        let ready = |s: &usize| matches!(self.slot(*s).state, SlotState::Staged | SlotState::Trial);
        let slot = [0, 1].into_iter().find(ready).ok_or(Refusal::Order)?;
        if self.running == Some(slot) {
            return Err(Refusal::State);
        }
        if self.slot(slot).state == SlotState::Staged {
            self.mark(slot, Mark::Trial)?;
        }
        self.pending = Some(slot);
        Ok(number(slot))
    }

    fn confirm<'p>(&mut self) -> Result<u32, Refusal>
    where
        F: Flash<'p>,
    {
        let slot = self.on_trial.filter(|&s| self.running == Some(s)).ok_or(Refusal::Order)?;
        self.mark(slot, Mark::Confirmed)?;
        self.on_trial = None;
        Ok(number(slot))
    }
}

fn number(slot: usize) -> u32 {
    u32::try_from(slot).unwrap_or(0)
}

impl<'p, F: Flash<'p>> Store<'p> for Slots<F> {
    fn begin_boot(&mut self) {
        self.offered = [false; 2];
        self.on_trial = None;
        self.running = None;
    }

    fn next_candidate(&mut self) -> Option<Candidate<'p>> {
        let slot = if let Some(slot) = self.pending.take() {
            self.on_trial = Some(slot);
            slot
        } else {
            self.next_by_itself()?
        };
        if let Some(offered) = self.offered.get_mut(slot) {
            *offered = true;
        }
        let trial = self.on_trial == Some(slot);
        Some(Candidate { slot: u8::try_from(slot).unwrap_or(0), image: self.flash.image(slot), trial })
    }

    fn reject(&mut self, slot: u8) {
        let slot = usize::from(slot);
        if let Some(rejected) = self.rejected.get_mut(slot) {
            *rejected = true;
        }
        if self.on_trial == Some(slot) {
            self.on_trial = None;
            // Where this fails, the slot stays on trial, and that is not booted by itself either.
            let _unmarked = self.mark(slot, Mark::Revoked);
        }
    }

    fn running(&mut self, slot: Option<u8>) {
        self.running = slot.map(usize::from);
    }

    fn operate(
        &mut self,
        operation: Operation,
        check: &mut dyn FnMut(&'p [u8]) -> Result<(), Refusal>,
    ) -> Result<u32, Refusal> {
        if !self.flash.writable() {
            return Err(Refusal::NotWritable);
        }
        match operation {
            Operation::Length(len) => {
                let most = self.flash.slot_len().saturating_sub(MARKS_LEN);
                let len_fits = usize::try_from(len).is_ok_and(|l| (MIN_IMAGE..=most).contains(&l));
                if !len_fits || !len.is_multiple_of(16) {
                    return Err(Refusal::Length);
                }
                self.transfer.announce(len);
                Ok(u32::try_from(most).unwrap_or(u32::MAX))
            }
            Operation::Begin(crc, anew) => self.begin(crc, anew),
            Operation::Block(offset) => self.transfer.open_block(offset),
            Operation::Commit(crc) => self.commit(crc),
            Operation::End => self.end(check),
            Operation::Activate => self.activate(),
            Operation::Confirm => self.confirm(),
        }
    }

    fn data(&mut self, index: u8, bytes: &[u8]) {
        self.transfer.data(index, bytes);
    }

    fn states(&self) -> [SlotState; 2] {
        [0, 1].map(|s| self.slot(s).state)
    }
}
