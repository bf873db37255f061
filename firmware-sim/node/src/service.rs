//! Messages whose layout does not depend on a policy: MODE, ESTOP, TICK, REQUEST, REPLY and the heartbeats.
//!
//! All of them are classic frames in both profiles.

use strum::{FromRepr, IntoStaticStr, VariantArray};

use crate::coded::coded;
use crate::frame::{Frame, Kind, standard};
use crate::protocol::{Function, NodeId, address, identifier};

/// A classic frame of a function; every caller passes a function and payload that exist in the table.
fn make(function: Function, node: u8, payload: &[u8]) -> Frame {
    identifier(function, node, 0).and_then(|id| Frame::classic(standard(id), payload)).unwrap_or(Frame::empty())
}

/// The node number in the identifier of a data frame of that function, and its payload.
fn data(frame: &Frame, function: Function) -> Option<(u8, &[u8])> {
    let found = address(frame.standard_id()?)?;
    (found.message.function == function && frame.kind() != Kind::Remote).then(|| (found.node, frame.payload()))
}

/// The same of a classic frame of exactly `N` bytes. Kind and length are all that tells a frame of another function, whose
/// identifier was damaged on its way, from one of these.
fn read<const N: usize>(frame: &Frame, function: Function) -> Option<(u8, [u8; N])> {
    let (node, payload) = data(frame, function).filter(|_| frame.kind() == Kind::Classic)?;
    Some((node, payload.try_into().ok()?))
}

/// What MODE asks for. The numbers are those of CANopen's NMT.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, IntoStaticStr, VariantArray)]
#[repr(u8)]
#[strum(serialize_all = "lowercase")]
pub enum ModeCommand {
    /// Start control.
    Run = 1,
    /// Stop control: the safe action once, then silence.
    Stop = 2,
    /// Start again from the beginning, the policy included.
    Reset = 129,
}

coded!(ModeCommand);

/// MODE.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mode {
    /// What to do.
    pub command: ModeCommand,
    /// Which node, 0 = all.
    pub node: u8,
}

impl Mode {
    /// As a frame.
    #[must_use]
    pub fn frame(self) -> Frame {
        make(Function::Mode, 0, &[self.command.code(), self.node])
    }

    /// From a frame; `None` where it is something else or an unknown command.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let (_, [command, node]) = read(frame, Function::Mode)?;
        Some(Self { command: ModeCommand::from_code(command)?, node })
    }
}

/// ESTOP.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Estop {
    /// Which node, 0 = all.
    pub node: u8,
    /// Free, for the log.
    pub reason: u8,
}

impl Estop {
    /// As a frame.
    #[must_use]
    pub fn frame(self) -> Frame {
        make(Function::Estop, self.node, &[self.reason])
    }

    /// From a frame. A remote frame and an empty payload count too: an emergency stop is obeyed whatever it carries.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let found = address(frame.standard_id()?)?;
        (found.message.function == Function::Estop)
            .then(|| Self { node: found.node, reason: frame.payload().first().copied().unwrap_or(0) })
    }
}

/// TICK.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// Number of the control period, modulo 2^32.
    pub tick: u32,
    /// Time in microseconds, modulo 2^32.
    pub time_us: u32,
}

impl Tick {
    /// As a frame.
    #[must_use]
    pub fn frame(self) -> Frame {
        let ([a, b, c, d], [e, f, g, h]) = (self.tick.to_le_bytes(), self.time_us.to_le_bytes());
        make(Function::Tick, 0, &[a, b, c, d, e, f, g, h])
    }

    /// From a frame; `None` where it is something else.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let (_, [a, b, c, d, e, f, g, h]) = read(frame, Function::Tick)?;
        Some(Self { tick: u32::from_le_bytes([a, b, c, d]), time_us: u32::from_le_bytes([e, f, g, h]) })
    }
}

/// What the value of a heartbeat or of a reply means. Heartbeats show the pages in the order of their numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, IntoStaticStr, VariantArray)]
#[repr(u8)]
#[strum(serialize_all = "snake_case")]
pub enum Page {
    /// Low half of the interface hash.
    InterfaceLow = 0,
    /// High half of the interface hash.
    InterfaceHigh = 1,
    /// CRC-32 of the policy image.
    PolicyCrc = 2,
    /// Slot that the policy came from.
    Slot = 3,
    /// Time of the last inference, µs; 0 where the board does not measure it.
    InferenceUs = 4,
    /// Control periods without a good observation set.
    Misses = 5,
    /// Low half: largest deviation of the last 64 periods, per mille. High half: mean deviation, per mille, signed.
    Jitter = 6,
    /// Frames dropped for a wrong CRC, length or hash.
    CrcErrors = 7,
    /// Observation sets dropped as incomplete.
    TornSets = 8,
    /// Ticks and parts ignored as duplicate or out of sequence.
    Sequence = 9,
    /// Observation sets with an invalid value.
    Invalid = 10,
    /// Entries into SAFE.
    SafeEntries = 11,
    /// Byte 0: why an image was not run, a [`Reason`](crate::reason::Reason). Byte 1: its slot. In NO_POLICY every
    /// heartbeat shows this page.
    PolicyError = 12,
    /// Bytes 0 and 1: states of slots 0 and 1, a [`SlotState`](crate::slots::SlotState) each. Byte 2: the slot that runs.
    /// Byte 3: 1 where it runs on trial.
    Slots = 13,
}

coded!(Page);

/// HEARTBEAT of a node. State and fault stay numbers here, so that a newer node can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Heartbeat {
    /// Sender.
    pub node: u8,
    /// [`State`](crate::safety::State) code.
    pub state: u8,
    /// [`Page`] code.
    pub page: u8,
    /// [`Fault`](crate::safety::Fault) code.
    pub fault: u8,
    /// Counts heartbeats.
    pub seq: u8,
    /// Value of the page.
    pub value: u32,
}

impl Heartbeat {
    /// As a frame.
    #[must_use]
    pub fn frame(self) -> Frame {
        let [a, b, c, d] = self.value.to_le_bytes();
        make(Function::Heartbeat, self.node, &[self.state, self.page, self.fault, self.seq, a, b, c, d])
    }

    /// From a frame; `None` where it is something else.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let (node, [state, page, fault, seq, a, b, c, d]) = read(frame, Function::Heartbeat)?;
        Some(Self { node, state, page, fault, seq, value: u32::from_le_bytes([a, b, c, d]) })
    }
}

/// HOST_HEARTBEAT.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HostHeartbeat {
    /// Counts heartbeats.
    pub seq: u8,
}

impl HostHeartbeat {
    /// As a frame.
    #[must_use]
    pub fn frame(self) -> Frame {
        make(Function::HostHeartbeat, 0, &[self.seq])
    }

    /// From a frame; `None` where it is something else.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let (_, [seq]) = read(frame, Function::HostHeartbeat)?;
        Some(Self { seq })
    }
}

/// Operation: read a page.
pub const OP_READ: u8 = 1;
/// Operation: announce the length of a policy image, bytes.
pub const OP_LENGTH: u8 = 2;
/// Operation: announce its CRC-32C and begin, or go on with, its transfer; page 1 starts over.
pub const OP_BEGIN: u8 = 3;
/// Operation: a block begins at the offset in `value`.
pub const OP_BLOCK: u8 = 4;
/// Operation: write the block whose CRC-32 is `value`.
pub const OP_COMMIT: u8 = 5;
/// Operation: check the whole image and stage it.
pub const OP_END: u8 = 6;
/// Operation: boot the staged policy on trial.
pub const OP_ACTIVATE: u8 = 7;
/// Operation: keep the policy on trial.
pub const OP_CONFIRM: u8 = 8;
/// Operation of lockstep between processes: START, a power cycle. See `docs/src/firmware.md`.
pub const OP_START: u8 = 0x10;
/// Operation of lockstep between processes: BARRIER, be done with all that came before.
pub const OP_BARRIER: u8 = 0x11;
/// Operation of a reply that refuses.
pub const OP_REFUSED: u8 = 0xFF;

/// REQUEST.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Request {
    /// Which node.
    pub node: u8,
    /// Operation, see [`OP_READ`] and those after it.
    pub op: u8,
    /// [`Page`] code; 1 in [`OP_BEGIN`] to start over; else 0.
    pub page: u8,
    /// Returned unchanged in the reply.
    pub tag: u16,
    /// Argument of the operation; 0 where it has none.
    pub value: u32,
}

impl Request {
    /// Reads a page.
    #[must_use]
    pub fn read(node: u8, page: Page, tag: u16) -> Self {
        Self { node, op: OP_READ, page: page.code(), tag, value: 0 }
    }

    /// As a frame. A value of zero is not sent.
    #[must_use]
    pub fn frame(self) -> Frame {
        let ([t0, t1], [a, b, c, d]) = (self.tag.to_le_bytes(), self.value.to_le_bytes());
        let bytes = [self.op, self.page, t0, t1, a, b, c, d];
        let len = if self.value == 0 { 4 } else { 8 };
        make(Function::Request, self.node, bytes.get(..len).unwrap_or(&bytes))
    }

    /// From a frame; `None` where it is something else. Without a value it is zero.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let short = |(node, [op, page, a, b]): (u8, [u8; 4])| (node, [op, page, a, b, 0, 0, 0, 0]);
        let (node, [op, page, t0, t1, a, b, c, d]) =
            read(frame, Function::Request).or_else(|| read(frame, Function::Request).map(short))?;
        Some(Self { node, op, page, tag: u16::from_le_bytes([t0, t1]), value: u32::from_le_bytes([a, b, c, d]) })
    }
}

/// TRANSFER: bytes of the open block of a policy transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransferData {
    /// Which node.
    pub node: u8,
    /// Counts the frames of a block, from 0.
    pub index: u8,
    bytes: [u8; 63],
    len: usize,
}

impl TransferData {
    /// The first bytes of `bytes`: 7 in a classic frame, 63 in an FD frame. [`len`](Self::len) tells how many were taken.
    #[must_use]
    pub fn new(node: u8, index: u8, bytes: &[u8], fd: bool) -> Self {
        let len = bytes.len().min(if fd { 63 } else { 7 });
        let mut data = Self { node, index, bytes: [0; 63], len };
        for (place, byte) in data.bytes.iter_mut().zip(bytes.iter().take(len)) {
            *place = *byte;
        }
        data
    }

    /// The bytes; from an FD frame with its padding.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..self.len).unwrap_or(&[])
    }

    /// Number of bytes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// There are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// As a frame: classic for up to 7 bytes, else FD.
    #[must_use]
    pub fn frame(&self) -> Frame {
        let mut payload = [self.index; 64];
        for (place, byte) in payload.iter_mut().skip(1).zip(self.bytes()) {
            *place = *byte;
        }
        let payload = payload.get(..=self.len).unwrap_or(&[]);
        let id = identifier(Function::Transfer, self.node, 0).map(standard);
        let frame = id.and_then(|id| Frame::classic(id, payload).or_else(|| Frame::fd(id, payload, true)));
        frame.unwrap_or(Frame::empty())
    }

    /// From a frame; `None` where it is something else or empty.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let (node, payload) = data(frame, Function::Transfer)?;
        let (index, bytes) = payload.split_first()?;
        Some(Self::new(node, *index, bytes, true))
    }
}

/// REPLY.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply {
    /// Which node answers.
    pub node: u8,
    /// Operation answered, or [`OP_REFUSED`].
    pub op: u8,
    /// As in the request; of a refused operation of a transfer the [`Refusal`](crate::store::Refusal).
    pub page: u8,
    /// Tag of the request.
    pub tag: u16,
    /// Value of the page, or the operation that was refused.
    pub value: u32,
}

impl Reply {
    /// As a frame.
    #[must_use]
    pub fn frame(self) -> Frame {
        let ([t0, t1], [a, b, c, d]) = (self.tag.to_le_bytes(), self.value.to_le_bytes());
        make(Function::Reply, self.node, &[self.op, self.page, t0, t1, a, b, c, d])
    }

    /// From a frame; `None` where it is something else.
    #[must_use]
    pub fn parse(frame: &Frame) -> Option<Self> {
        let (node, [op, page, t0, t1, a, b, c, d]) = read(frame, Function::Reply)?;
        let (tag, value) = (u16::from_le_bytes([t0, t1]), u32::from_le_bytes([a, b, c, d]));
        Some(Self { node, op, page, tag, value })
    }
}

/// True where a command for `addressed` (0 = all) concerns `node`.
#[must_use]
pub fn concerns(addressed: u8, node: NodeId) -> bool {
    addressed == 0 || addressed == node.get()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_service_message_survives_the_wire() {
        for &command in ModeCommand::ALL {
            let m = Mode { command, node: 7 };
            assert_eq!(Mode::parse(&m.frame()), Some(m));
        }
        let t = Tick { tick: 0x0102_0304, time_us: 0xA0B0_C0D0 };
        assert_eq!(t.frame().payload(), [4, 3, 2, 1, 0xD0, 0xC0, 0xB0, 0xA0]);
        assert_eq!(Tick::parse(&t.frame()), Some(t));
        let h = Heartbeat { node: 1, state: 4, page: 6, fault: 3, seq: 255, value: 0xDEAD_BEEF };
        assert_eq!(Heartbeat::parse(&h.frame()), Some(h));
        for value in [0, 0xDEAD_BEEF] {
            let r = Request { node: 3, op: OP_READ, page: 2, tag: 0xBEEF, value };
            assert_eq!(Request::parse(&r.frame()), Some(r));
        }
        for (len, fd) in [(0, false), (7, false), (7, true), (63, true)] {
            let bytes: std::vec::Vec<u8> = (0..len).collect();
            let d = TransferData::new(3, 200, &bytes, fd);
            assert_eq!((d.len(), d.frame().payload().len()), (usize::from(len), usize::from(len) + 1));
            assert_eq!(TransferData::parse(&d.frame()), Some(d));
        }
        let a = Reply { node: 3, op: OP_REFUSED, page: 2, tag: 0xBEEF, value: 9 };
        assert_eq!(Reply::parse(&a.frame()), Some(a));
        let l = HostHeartbeat { seq: 9 };
        assert_eq!(HostHeartbeat::parse(&l.frame()), Some(l));
    }

    #[test]
    fn estop_is_obeyed_without_payload_and_as_remote_frame() {
        let bare = Frame::classic(standard(0x013), &[]).unwrap();
        assert_eq!(Estop::parse(&bare), Some(Estop { node: 3, reason: 0 }));
        let remote = Frame::remote(standard(0x010), 0).unwrap();
        assert_eq!(Estop::parse(&remote), Some(Estop { node: 0, reason: 0 }));
    }

    #[test]
    fn short_foreign_and_unknown_frames_are_refused() {
        assert_eq!(Tick::parse(&Frame::classic(standard(0x080), &[0; 7]).unwrap()), None);
        assert_eq!(Tick::parse(&Frame::fd(standard(0x080), &[0; 8], true).unwrap()), None);
        assert_eq!(Mode::parse(&Frame::classic(standard(0x000), &[1, 0, 0, 0, 0, 0, 0, 0]).unwrap()), None);
        assert_eq!(Request::parse(&Frame::classic(standard(0x601), &[1, 0, 0, 0, 0]).unwrap()), None);
        assert_eq!(Mode::parse(&Frame::classic(standard(0x000), &[77, 0]).unwrap()), None);
        assert_eq!(Mode::parse(&Tick { tick: 0, time_us: 0 }.frame()), None);
        assert_eq!(Mode::parse(&Frame::classic(crate::frame::extended(0), &[1, 0]).unwrap()), None);
    }
}
