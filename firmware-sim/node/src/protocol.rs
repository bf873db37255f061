//! The one table of the protocol: identifiers, directions, periods, payload layouts and units.
//!
//! The codec, the trace decoder and the documentation (`docs/src/can-protocol.md`, checked by a test) use this table.
//! Identifiers are 11 bits with the function first, as in CANopen (CiA 301), so that the urgency of a frame on the bus
//! depends on what it says and not on who says it. Numbers on the wire are little endian.

/// Number of a node, 1 to 63. Zero addresses all nodes in [`Function::Mode`] and [`Function::Estop`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct NodeId(u8);

impl NodeId {
    /// The node number that tools use when none is given.
    pub const DEFAULT: Self = Self(1);

    /// `None` unless `n` is 1 to 63.
    #[must_use]
    pub const fn new(n: u8) -> Option<Self> {
        if n >= 1 && n <= 63 { Some(Self(n)) } else { None }
    }

    /// The number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }
}

/// Identifiers that one function with node numbers takes (node 0 is the broadcast or unused).
pub const NODES: u16 = 64;
/// Parts that an observation set can have.
pub const MAX_OBSERVATION_PARTS: usize = 128;
/// Parts that an action set can have.
pub const MAX_ACTION_PARTS: usize = 15;
/// Values in one part of profile `classic-i16`.
pub const CLASSIC_VALUES: usize = 3;
/// Values in one part of profile `fd-f32`.
pub const FD_VALUES: usize = 14;
/// Longest observation: what 128 classic parts hold.
pub const MAX_OBSERVATIONS: usize = MAX_OBSERVATION_PARTS * CLASSIC_VALUES;
/// Longest action: what 15 classic parts hold.
pub const MAX_ACTIONS: usize = MAX_ACTION_PARTS * CLASSIC_VALUES;
/// Time between two heartbeats, microseconds.
pub const HEARTBEAT_PERIOD_US: u64 = 100_000;
/// Latent number that means "no latent was chosen" (held or safe actions before the first decision).
pub const NO_LATENT: u16 = 0x7FF;

/// What a frame is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Function {
    /// RUN, STOP, RESET.
    Mode,
    /// Emergency stop.
    Estop,
    /// Start of a control period.
    Tick,
    /// Action set.
    Action,
    /// What was decided (classic profile).
    Decision,
    /// Observation set.
    Observation,
    /// Answer to a request.
    Reply,
    /// Question to a node.
    Request,
    /// Bytes of a policy on its way to a node.
    Transfer,
    /// State of a node.
    Heartbeat,
    /// Sign of life of the host.
    HostHeartbeat,
}

/// Who sends or receives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Supervising program.
    Host,
    /// The plant: sensors and actuators.
    Plant,
    /// The controller.
    Node,
    /// Everybody.
    Any,
}

impl Role {
    /// Lower-case name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Host => "host",
            Self::Plant => "plant",
            Self::Node => "node",
            Self::Any => "any",
        }
    }
}

/// When a message is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Period {
    /// When something happens.
    Event,
    /// Once each control period of the policy.
    Control,
    /// Every so many milliseconds, and on change.
    Millis(u16),
}

/// How the identifiers of a row count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Index {
    /// One identifier.
    Single,
    /// `base + node`.
    Node,
    /// `base + part`.
    Part,
    /// `base + 64 (part - 1) + node`, parts from 1.
    NodePart,
}

/// What a field holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FieldKind {
    /// Unsigned 8 bits.
    U8,
    /// Unsigned 16 bits.
    U16,
    /// Unsigned 32 bits.
    U32,
    /// Up to so many bytes.
    Bytes(u8),
    /// Up to so many signed 16-bit numbers, scaled by the declared range of the signal.
    I16(u8),
    /// Up to so many IEEE 754 single-precision numbers.
    F32(u8),
    /// CRC-8/AUTOSAR over identifier, interface hash and the bytes before it; last byte.
    Crc8,
    /// CRC-32/ISO-HDLC over identifier, interface hash and the bytes before it; last four bytes.
    Crc32,
}

impl FieldKind {
    /// Short name for tables, without the count.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::U8 | Self::Bytes(_) => "u8",
            Self::U16 => "u16",
            Self::U32 => "u32",
            Self::I16(_) => "i16",
            Self::F32(_) => "f32",
            Self::Crc8 => "CRC-8",
            Self::Crc32 => "CRC-32",
        }
    }

    /// Greatest number of values.
    #[must_use]
    pub const fn count(self) -> usize {
        match self {
            Self::Bytes(n) | Self::I16(n) | Self::F32(n) => n as usize,
            _ => 1,
        }
    }

    /// Bytes at the greatest count.
    #[must_use]
    pub const fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::Crc8 => 1,
            Self::U16 => 2,
            Self::U32 | Self::Crc32 => 4,
            Self::Bytes(n) => n as usize,
            Self::I16(n) => 2 * n as usize,
            Self::F32(n) => 4 * n as usize,
        }
    }
}

/// One field of a payload. Fields follow each other without gaps; a CRC sits at the very end, after zero padding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    /// Name, as decoders print it.
    pub name: &'static str,
    /// Type.
    pub kind: FieldKind,
    /// Unit; empty where the number has none.
    pub unit: &'static str,
    /// Meaning.
    pub doc: &'static str,
}

const fn field(name: &'static str, kind: FieldKind, unit: &'static str, doc: &'static str) -> Field {
    Field { name, kind, unit, doc }
}

/// One row of the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message {
    /// What it is for.
    pub function: Function,
    /// Name in tables, traces and tools.
    pub name: &'static str,
    /// First identifier.
    pub base: u16,
    /// Number of identifiers.
    pub count: u16,
    /// How they count.
    pub index: Index,
    /// Sender.
    pub from: Role,
    /// Receiver.
    pub to: Role,
    /// When.
    pub period: Period,
    /// Payload in a classic frame; empty where the profile does not use it.
    pub classic: &'static [Field],
    /// Payload in an FD frame; empty where the message is a classic frame in both profiles.
    pub fd: &'static [Field],
    /// Meaning.
    pub doc: &'static str,
}

const SEQ8: Field = field("seq", FieldKind::U8, "", "low byte of the tick number");
const SEQ16: Field = field("seq", FieldKind::U16, "", "low 16 bits of the tick number");
const CRC8: Field = field("crc", FieldKind::Crc8, "", "CRC-8/AUTOSAR");
const CRC32: Field = field("crc", FieldKind::Crc32, "", "CRC-32/ISO-HDLC");
const ACT_CLASSIC: &[Field] = &[
    SEQ8,
    field("action", FieldKind::I16(3), "of the signal", "scaled by lo and hi of the head; discrete heads as integers"),
    CRC8,
];
const ACT_FD: &[Field] = &[
    SEQ16,
    field("latent", FieldKind::U16, "", "bits 0-10 latent number, 2047 = none; bits 11-15 flags"),
    field("action", FieldKind::F32(14), "of the signal", "the exact value"),
    CRC32,
];

/// The protocol.
pub const MESSAGES: &[Message] = &[
    Message {
        function: Function::Mode,
        name: "MODE",
        base: 0x000,
        count: 1,
        index: Index::Single,
        from: Role::Host,
        to: Role::Node,
        period: Period::Event,
        classic: &[
            field("command", FieldKind::U8, "", "1 RUN, 2 STOP, 129 RESET"),
            field("node", FieldKind::U8, "", "node number, 0 = all"),
        ],
        fd: &[],
        doc: "changes the state of a node, as CANopen's NMT",
    },
    Message {
        function: Function::Estop,
        name: "ESTOP",
        base: 0x010,
        count: NODES,
        index: Index::Node,
        from: Role::Any,
        to: Role::Node,
        period: Period::Event,
        classic: &[field("reason", FieldKind::U8, "", "free, for the log; an empty payload is obeyed too")],
        fd: &[],
        doc: "emergency stop; node 0 = all; latched until RESET",
    },
    Message {
        function: Function::Tick,
        name: "TICK",
        base: 0x080,
        count: 1,
        index: Index::Single,
        from: Role::Plant,
        to: Role::Any,
        period: Period::Control,
        classic: &[
            field("tick", FieldKind::U32, "", "number of the control period"),
            field("time", FieldKind::U32, "us", "time modulo 2^32"),
        ],
        fd: &[],
        doc: "starts a control period; the node's clock in lockstep",
    },
    Message {
        function: Function::Action,
        name: "ACT",
        base: 0x100,
        count: NODES,
        index: Index::Node,
        from: Role::Node,
        to: Role::Plant,
        period: Period::Control,
        classic: ACT_CLASSIC,
        fd: ACT_FD,
        doc: "first part of the action set; seq is that of the tick it answers",
    },
    Message {
        function: Function::Decision,
        name: "DECISION",
        base: 0x140,
        count: NODES,
        index: Index::Node,
        from: Role::Node,
        to: Role::Plant,
        period: Period::Control,
        classic: &[
            SEQ8,
            field("latent", FieldKind::U16, "", "latent number, 2047 = none"),
            field("flags", FieldKind::U8, "", "bits 0-4 as in ACT"),
            field(
                "inference",
                FieldKind::U16,
                "us",
                "time of the last inference, 0 where the board does not measure it",
            ),
            field("allowed", FieldKind::U8, "", "latents that the mask left, saturated at 255"),
            CRC8,
        ],
        fd: &[],
        doc: "latent and flags (classic-i16 only; in fd-f32 they are inside ACT); sent before the parts of ACT",
    },
    Message {
        function: Function::Observation,
        name: "OBS",
        base: 0x180,
        count: 128,
        index: Index::Part,
        from: Role::Plant,
        to: Role::Node,
        period: Period::Control,
        classic: &[
            SEQ8,
            field("value", FieldKind::I16(3), "of the signal", "scaled by lo and hi of the signal; -32768 = invalid"),
            CRC8,
        ],
        fd: &[
            SEQ16,
            field("part", FieldKind::U8, "", "part number, as in the identifier"),
            field("flags", FieldKind::U8, "", "bit 0 first part, bit 1 last part, bit 2 holds an invalid value"),
            field("value", FieldKind::F32(14), "of the signal", "the exact value; not a number = invalid"),
            CRC32,
        ],
        doc: "one part of the observation set",
    },
    Message {
        function: Function::Action,
        name: "ACT_PART",
        base: 0x200,
        count: NODES * 14,
        index: Index::NodePart,
        from: Role::Node,
        to: Role::Plant,
        period: Period::Control,
        classic: ACT_CLASSIC,
        fd: ACT_FD,
        doc: "parts 1 to 14 of a long action set",
    },
    Message {
        function: Function::Reply,
        name: "REPLY",
        base: 0x580,
        count: NODES,
        index: Index::Node,
        from: Role::Node,
        to: Role::Host,
        period: Period::Event,
        classic: &[
            field("op", FieldKind::U8, "", "the operation answered; 0xFF = refused"),
            field("page", FieldKind::U8, "", "as in the request; of a refused transfer operation the reason"),
            field("tag", FieldKind::U16, "", "the tag of the request"),
            field("value", FieldKind::U32, "of the page", "value, or the operation refused"),
        ],
        fd: &[],
        doc: "answer to REQUEST",
    },
    Message {
        function: Function::Request,
        name: "REQUEST",
        base: 0x600,
        count: NODES,
        index: Index::Node,
        from: Role::Host,
        to: Role::Node,
        period: Period::Event,
        classic: &[
            field("op", FieldKind::U8, "", "1 = read a page; 2 to 8 = policy transfer"),
            field("page", FieldKind::U8, "", "page, see HEARTBEAT; 0 in a transfer, but 1 in BEGIN to start over"),
            field("tag", FieldKind::U16, "", "returned unchanged"),
            field("value", FieldKind::U32, "", "argument of the operation; may be left out where it is 0"),
        ],
        fd: &[],
        doc: "asks a node; the answer comes after everything that was sent before, so it also is a barrier",
    },
    Message {
        function: Function::Transfer,
        name: "TRANSFER",
        base: 0x640,
        count: NODES,
        index: Index::Node,
        from: Role::Host,
        to: Role::Node,
        period: Period::Event,
        classic: &[
            field("index", FieldKind::U8, "", "counts the frames of a block, from 0"),
            field("data", FieldKind::Bytes(7), "", "bytes of the block"),
        ],
        fd: &[
            field("index", FieldKind::U8, "", "counts the frames of a block, from 0"),
            field("data", FieldKind::Bytes(63), "", "bytes of the block; padding behind its end is ignored"),
        ],
        doc: "bytes of the open block of a policy transfer; either kind of frame, whatever the profile",
    },
    Message {
        function: Function::Heartbeat,
        name: "HEARTBEAT",
        base: 0x700,
        count: NODES,
        index: Index::Node,
        from: Role::Node,
        to: Role::Any,
        period: Period::Millis(100),
        classic: &[
            field("state", FieldKind::U8, "", "state of the node"),
            field("page", FieldKind::U8, "", "what value means; the pages take turns"),
            field("fault", FieldKind::U8, "", "fault code"),
            field("seq", FieldKind::U8, "", "counts the heartbeats"),
            field("value", FieldKind::U32, "of the page", "value of the page"),
        ],
        fd: &[],
        doc: "state and fault, and one page of counters",
    },
    Message {
        function: Function::HostHeartbeat,
        name: "HOST_HEARTBEAT",
        base: 0x77F,
        count: 1,
        index: Index::Single,
        from: Role::Host,
        to: Role::Node,
        period: Period::Millis(100),
        classic: &[field("seq", FieldKind::U8, "", "counts the heartbeats")],
        fd: &[],
        doc: "sign of life of the host; watched from the first one on",
    },
];

/// Where an identifier belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Address {
    /// The row of [`MESSAGES`].
    pub message: &'static Message,
    /// Node number; 0 where the row has none.
    pub node: u8,
    /// Part number; 0 where the row has none.
    pub part: u8,
}

/// Finds the row of an identifier, with node and part.
#[must_use]
pub fn address(id: u16) -> Option<Address> {
    let message = MESSAGES.iter().find(|m| id >= m.base && id - m.base < m.count)?;
    let offset = id - message.base;
    let byte = |v: u16| u8::try_from(v).unwrap_or(u8::MAX);
    let (node, part) = match message.index {
        Index::Single => (0, 0),
        Index::Node => (byte(offset), 0),
        Index::Part => (0, byte(offset)),
        Index::NodePart => (byte(offset % NODES), byte(offset / NODES + 1)),
    };
    Some(Address { message, node, part })
}

/// The identifier of `function` for a node and part; `None` where the table has no such identifier.
#[must_use]
pub fn identifier(function: Function, node: u8, part: u8) -> Option<u16> {
    MESSAGES.iter().filter(|m| m.function == function).find_map(|m| {
        let offset = match (m.index, part) {
            (Index::Single, 0) => 0,
            (Index::Node, 0) => u16::from(node),
            (Index::Part, _) => u16::from(part),
            (Index::NodePart, 1..) => u16::from(part - 1) * NODES + u16::from(node),
            _ => return None,
        };
        (offset < m.count).then_some(m.base + offset)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifier_ranges_do_not_overlap_and_fit_eleven_bits() {
        let mut used = [false; 0x800];
        for m in MESSAGES {
            for id in m.base..m.base + m.count {
                assert!(!used[usize::from(id)], "{} reuses {id:#05X}", m.name);
                used[usize::from(id)] = true;
            }
        }
    }

    #[test]
    fn address_and_identifier_are_inverse_over_all_identifiers() {
        let mut known = 0;
        for id in 0..0x800_u16 {
            if let Some(a) = address(id) {
                assert_eq!(identifier(a.message.function, a.node, a.part), Some(id), "{id:#05X}");
                known += 1;
            }
        }
        assert_eq!(known, MESSAGES.iter().map(|m| u32::from(m.count)).sum::<u32>());
    }

    #[test]
    fn spec_numbers() {
        assert_eq!(identifier(Function::Action, 5, 0), Some(0x105));
        assert_eq!(identifier(Function::Action, 63, 14), Some(0x57F));
        assert_eq!(identifier(Function::Action, 1, 15), None);
        assert_eq!(identifier(Function::Observation, 0, 127), Some(0x1FF));
        assert_eq!(identifier(Function::Heartbeat, 1, 0), Some(0x701));
    }

    #[test]
    fn payloads_fit_their_frames() {
        for m in MESSAGES {
            assert!(m.classic.iter().map(|f| f.kind.bytes()).sum::<usize>() <= 8, "{}", m.name);
            assert!(m.fd.iter().map(|f| f.kind.bytes()).sum::<usize>() <= 64, "{}", m.name);
        }
    }

    #[test]
    fn node_numbers_are_1_to_63() {
        assert_eq!(NodeId::new(0), None);
        assert_eq!(NodeId::new(63).map(NodeId::get), Some(63));
        assert_eq!(NodeId::new(64), None);
    }
}
