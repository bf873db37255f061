//! Where policy images lie, as the node sees it: images to try at boot, and operations that bring a new one.

use strum::{FromRepr, IntoStaticStr, VariantArray};

use crate::coded::coded;
use crate::slots::SlotState;

/// An image to boot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Candidate<'p> {
    /// Number of its slot.
    pub slot: u8,
    /// The image; it may be followed by other bytes.
    pub image: &'p [u8],
    /// It runs on trial: unless it is confirmed, the next boot takes another.
    pub trial: bool,
}

/// Why an operation of a policy transfer was refused. The number is the one in the page byte of the reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, IntoStaticStr, VariantArray)]
#[repr(u8)]
#[strum(serialize_all = "SCREAMING_SNAKE_CASE")]
pub enum Refusal {
    /// There is no such operation.
    Unknown = 0,
    /// This node has no slot that it can write.
    NotWritable = 1,
    /// Not in this state: the node must be READY or NO_POLICY, and the slot not the one that runs.
    State = 2,
    /// The length is no policy's, or above what a slot holds.
    Length = 3,
    /// The operation does not follow from the ones before.
    Order = 4,
    /// The block is not the one that is due; BEGIN tells which is.
    Offset = 5,
    /// The block came damaged or incomplete; send it again.
    BlockCrc = 6,
    /// The flash did not take what was written.
    Flash = 7,
    /// The whole image is not the one announced.
    ImageCrc = 8,
    /// The image is not a policy that can be run.
    Load = 9,
    /// The policy does not fit the bus profile.
    Layout = 10,
    /// The policy failed its own vectors.
    SelfTest = 11,
    /// The sequence number of the policy is below that of the confirmed one.
    Older = 12,
}

coded!(Refusal);

impl Refusal {
    /// What it means, in one line.
    #[must_use]
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::Unknown => "there is no such operation",
            Self::NotWritable => "this node has no slot that it can write; use a flashing tool",
            Self::State => "not now: stop the node first; a slot whose policy runs is not written",
            Self::Length => "the length is no policy's, or more than a slot holds",
            Self::Order => "the operation does not follow from the ones before; start with LENGTH and BEGIN",
            Self::Offset => "another block is due; BEGIN tells which",
            Self::BlockCrc => "the block came damaged or incomplete; send it again",
            Self::Flash => "the flash did not take what was written; BEGIN with page 1 starts over",
            Self::ImageCrc => "the image in the slot is not the one announced; BEGIN with page 1 starts over",
            Self::Load => "the image is not a policy that this node can run",
            Self::Layout => "the policy does not fit the bus profile of the node",
            Self::SelfTest => "the policy failed its own vectors",
            Self::Older => {
                "the policy's sequence number is below that of the confirmed one; export it with a higher one"
            }
        }
    }
}

/// An operation of a policy transfer, in the order in which a host asks for them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    /// Length of the image, bytes. Answer: the most that a slot holds.
    Length(u32),
    /// CRC-32C of the image, and whether to start over. Answer: the offset at which to go on.
    Begin(u32, bool),
    /// A block begins at this offset; its bytes come in TRANSFER frames. Answer: the offset.
    Block(u32),
    /// CRC-32/ISO-HDLC of the block's bytes: write it. Answer: the offset of the next block.
    Commit(u32),
    /// Check the whole image; it is staged then. Answer: the slot.
    End,
    /// Boot the staged policy on trial. Answer: the slot.
    Activate,
    /// The policy on trial is to stay. Answer: the slot.
    Confirm,
}

/// Where policy images lie.
pub trait Store<'p> {
    /// A boot begins: the next candidate is the best again.
    fn begin_boot(&mut self);

    /// The next image to try; `None` where there is no further one.
    fn next_candidate(&mut self) -> Option<Candidate<'p>>;

    /// The policy in `slot` cannot be run, or was not confirmed in time. A trial of it is over.
    fn reject(&mut self, slot: u8);

    /// The policy in this slot runs from now on; `None` for none.
    fn running(&mut self, slot: Option<u8>);

    /// Does an operation. `check` tells whether an image may be run here, and its sequence number.
    ///
    /// # Errors
    /// Why not; nothing that can be booted has then changed.
    fn operate(
        &mut self,
        operation: Operation,
        check: &mut dyn FnMut(&'p [u8]) -> Result<(), Refusal>,
    ) -> Result<u32, Refusal>;

    /// Bytes of the open block, the `index`-th frame of it modulo 256.
    fn data(&mut self, index: u8, bytes: &[u8]);

    /// The slots, for the heartbeat.
    fn states(&self) -> [SlotState; 2];
}

/// One image that nobody can change: linked in, or flashed by a tool.
#[derive(Clone, Copy, Debug)]
pub struct Fixed<'p> {
    image: &'p [u8],
    slot: u8,
    tried: bool,
}

impl<'p> Fixed<'p> {
    /// The image, and the number of the slot that it is reported in.
    #[must_use]
    pub const fn new(image: &'p [u8], slot: u8) -> Self {
        Self { image, slot, tried: false }
    }
}

impl<'p> Store<'p> for Fixed<'p> {
    fn begin_boot(&mut self) {
        self.tried = false;
    }

    fn next_candidate(&mut self) -> Option<Candidate<'p>> {
        let first = !core::mem::replace(&mut self.tried, true);
        first.then_some(Candidate { slot: self.slot, image: self.image, trial: false })
    }

    fn reject(&mut self, _: u8) {}

    fn running(&mut self, _: Option<u8>) {}

    fn operate(&mut self, _: Operation, _: &mut dyn FnMut(&'p [u8]) -> Result<(), Refusal>) -> Result<u32, Refusal> {
        Err(Refusal::NotWritable)
    }

    fn data(&mut self, _: u8, _: &[u8]) {}

    fn states(&self) -> [SlotState; 2] {
        [SlotState::Flashed, SlotState::Empty]
    }
}

impl<'p, S: Store<'p> + ?Sized> Store<'p> for &mut S {
    fn begin_boot(&mut self) {
        (**self).begin_boot();
    }

    fn next_candidate(&mut self) -> Option<Candidate<'p>> {
        (**self).next_candidate()
    }

    fn reject(&mut self, slot: u8) {
        (**self).reject(slot);
    }

    fn running(&mut self, slot: Option<u8>) {
        (**self).running(slot);
    }

    fn operate(
        &mut self,
        operation: Operation,
        check: &mut dyn FnMut(&'p [u8]) -> Result<(), Refusal>,
    ) -> Result<u32, Refusal> {
        (**self).operate(operation, check)
    }

    fn data(&mut self, index: u8, bytes: &[u8]) {
        (**self).data(index, bytes);
    }

    fn states(&self) -> [SlotState; 2] {
        (**self).states()
    }
}
