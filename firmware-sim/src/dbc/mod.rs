//! The messages of a policy as a CAN database (DBC), so that any CAN tool can read a trace of it.
//!
//! Everything comes from the table of `gadm_node::protocol` and from the interface record of the policy; nothing is
//! edited by hand, so a database cannot fall behind the bus. [`Database`] is the description, [`Database::text`] the
//! file. What a DBC can say is said in its own words (units, scales, limits, cycle times, value tables, CAN FD and
//! IEEE floats as Vector's tools mark them); what it cannot is an attribute that begins with `Gadm`.

mod signals;
mod text;

use gadm_node::codec::{Layout, Profile};
use gadm_node::protocol::{Function, Index, MESSAGES, Message, NODES, NodeId, Period, Role};
use gadm_runtime::Policy;

use crate::SimError;

/// Longest name that DBC tools agree on, characters.
const NAME_LIMIT: usize = 32;

/// All messages between one node, its plant and its host.
#[derive(Clone, Debug, PartialEq)]
pub struct Database {
    /// The profile.
    pub profile: Profile,
    /// Number of the node.
    pub node: u8,
    /// Hash of the interface of the policy.
    pub interface_hash: u64,
    /// Environment that the policy was trained for; may be empty.
    pub environment: String,
    /// Control period, microseconds.
    pub control_period_us: u32,
    /// The messages, by identifier.
    pub messages: Vec<DbMessage>,
}

/// One message.
#[derive(Clone, Debug, PartialEq)]
pub struct DbMessage {
    /// Name, unique.
    pub name: String,
    /// 11-bit identifier.
    pub id: u16,
    /// Payload, bytes.
    pub len: usize,
    /// A CAN FD frame with bit-rate switch.
    pub fd: bool,
    /// Who sends it.
    pub from: Role,
    /// Who receives it.
    pub to: Role,
    /// Time between two, microseconds; `None` where it is sent when something happens.
    pub cycle_us: Option<u32>,
    /// Meaning.
    pub doc: String,
    /// The signals, in the order of their bits.
    pub signals: Vec<DbSignal>,
}

/// How the bits of a signal are a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Number {
    /// Unsigned integer.
    Unsigned,
    /// Two's complement.
    Signed,
    /// IEEE 754 single precision.
    Float,
}

/// Which frames of a message hold a signal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mux {
    /// All.
    Always,
    /// All; its value tells which of the [`Mux::Page`]s are there.
    Selector,
    /// Those with this value of the selector.
    Page(u8),
}

/// One signal. All are little endian.
#[derive(Clone, Debug, PartialEq)]
pub struct DbSignal {
    /// Name, unique in the message.
    pub name: String,
    /// First bit.
    pub start: usize,
    /// Bits.
    pub bits: usize,
    /// How the bits are a number.
    pub number: Number,
    /// Value of one step.
    pub factor: f64,
    /// Value of the raw number zero.
    pub offset: f64,
    /// Limits of the value; `None` where the signal has none.
    pub limits: Option<(f64, f64)>,
    /// Unit; empty where the number has none.
    pub unit: String,
    /// Which frames hold it.
    pub mux: Mux,
    /// Names of raw numbers.
    pub values: Vec<(i64, String)>,
    /// Meaning.
    pub doc: String,
    /// What it is in the policy's interface; `None` for all that is not an observation or action.
    pub interface: Option<Slot>,
}

/// The interface record behind a signal.
#[derive(Clone, Debug, PartialEq)]
pub struct Slot {
    /// Name as the policy writes it.
    pub name: String,
    /// Position in the observation or action.
    pub index: usize,
    /// Safe value of an action.
    pub safe: Option<f32>,
}

impl Database {
    /// The database of a policy for one profile and node.
    ///
    /// # Errors
    /// [`SimError::Layout`] where the profile cannot carry the policy.
    pub fn new(policy: &Policy, profile: Profile, node: NodeId) -> Result<Self, SimError> {
        let ranges = policy.observation_signals().map(|s| (s.lo, s.hi));
        let heads = policy.action_signals().map(|s| s.head);
        let layout = Layout::new(profile, node, policy.interface_hash(), ranges, heads)
            .map_err(|source| SimError::Layout { profile: profile.name(), source })?;
        let period_us = policy.spec().control_period_us;
        let names = signals::Names::new(policy);
        let mut messages = Vec::new();
        for row in MESSAGES {
            let uses_fd = profile == Profile::FdF32 && !row.fd.is_empty();
            let fields = if uses_fd { row.fd } else { row.classic };
            // DECISION has a classic payload only, and `fd-f32` says the same inside ACT.
            if row.function == Function::Decision && profile == Profile::FdF32 {
                continue;
            }
            for (id, part, name) in identifiers(row, node, &layout) {
                let (signals, len) = signals::of(row.function, fields, part, &layout, policy, &names);
                messages.push(DbMessage {
                    name,
                    id,
                    len,
                    fd: uses_fd,
                    from: row.from,
                    to: row.to,
                    cycle_us: match row.period {
                        Period::Event => None,
                        Period::Control => Some(period_us),
                        Period::Millis(ms) => Some(u32::from(ms) * 1000),
                    },
                    doc: row.doc.to_owned(),
                    signals,
                });
            }
        }
        messages.sort_by_key(|m| m.id);
        Ok(Self {
            profile,
            node: node.get(),
            interface_hash: policy.interface_hash(),
            environment: policy.provenance().environment.to_owned(),
            control_period_us: period_us,
            messages,
        })
    }

    /// The message with this identifier.
    #[must_use]
    pub fn message(&self, id: u16) -> Option<&DbMessage> {
        self.messages.iter().find(|m| m.id == id)
    }

    /// The file, plain ASCII.
    #[must_use]
    pub fn text(&self) -> String {
        text::write(self)
    }
}

/// Identifier, part and name of every frame that a row stands for with this node and policy.
fn identifiers(row: &Message, node: NodeId, layout: &Layout) -> Vec<(u16, usize, String)> {
    let node = u16::from(node.get());
    let parts = |count: usize| (0..count).filter_map(|p| u16::try_from(p).ok());
    match row.index {
        Index::Single => vec![(row.base, 0, row.name.to_owned())],
        Index::Node if row.function == Function::Estop => {
            vec![(row.base, 0, format!("{}_ALL", row.name)), (row.base + node, 0, row.name.to_owned())]
        }
        Index::Node => vec![(row.base + node, 0, row.name.to_owned())],
        Index::Part => parts(layout.observation_parts())
            .map(|p| (row.base + p, usize::from(p), format!("{}_{p}", row.name)))
            .collect(),
        Index::NodePart => parts(layout.action_parts())
            .skip(1)
            .map(|p| (row.base + NODES * (p - 1) + node, usize::from(p), format!("{}_{p}", row.name)))
            .collect(),
    }
}

#[cfg(test)]
mod tests;
