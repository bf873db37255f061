//! Frames of a trace as named signals.

use gadm_node::codec::{FrameError, Layout, Profile};
use gadm_node::frame::Kind;
use gadm_node::protocol::{Function, NO_LATENT, NodeId, address};
use gadm_node::reason::Reason;
use gadm_node::service::{Estop, Heartbeat, HostHeartbeat, Mode, Page, Reply, Request, Tick, TransferData};
use gadm_node::slots::SlotState;
use gadm_node::{Fault, Flags, Frame, State};
use gadm_runtime::Policy;
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::SimError;

/// One frame in words and numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Decoded {
    /// Name of the message; `UNKNOWN` for a frame that is not of the protocol.
    pub name: &'static str,
    /// Identifier.
    pub id: u32,
    /// Node number, where the message has one.
    pub node: Option<u8>,
    /// Signals by name.
    pub signals: Map<String, Value>,
    /// What the codec checks and nobody needs to see: part number and flags of an FD observation, CRC.
    pub framing: Map<String, Value>,
    /// Why the signals could not be read.
    pub error: Option<String>,
}

/// Reads frames with the names, ranges and hash of a policy.
#[derive(Clone, Debug)]
pub struct Decoder {
    layouts: Vec<Layout>,
    observations: Vec<String>,
    actions: Vec<String>,
}

impl Decoder {
    /// A decoder for traces of `policy`, whatever the node number.
    ///
    /// # Errors
    /// [`SimError::Layout`] where no profile can carry the policy.
    pub fn new(policy: &Policy, profile: Profile) -> Result<Self, SimError> {
        let make = |node: u8| {
            let node = NodeId::new(node).unwrap_or(NodeId::DEFAULT);
            Layout::of_policy(policy, profile, node)
                .map_err(|source| SimError::Layout { profile: profile.name(), source })
        };
        Ok(Self {
            layouts: (1..64).map(make).collect::<Result<_, _>>()?,
            observations: policy.observation_signals().map(|s| s.name.to_owned()).collect(),
            actions: policy.action_signals().map(|s| s.name.to_owned()).collect(),
        })
    }

    /// Reads one frame.
    #[must_use]
    pub fn decode(&self, frame: &Frame) -> Decoded {
        let mut decoded = Decoded {
            name: "UNKNOWN",
            id: frame.raw_id(),
            node: None,
            signals: Map::new(),
            framing: Map::new(),
            error: None,
        };
        let Some(to) = frame.standard_id().and_then(address) else { return decoded };
        decoded.name = to.message.name;
        let has_node = !matches!(
            to.message.function,
            Function::Tick | Function::Observation | Function::Mode | Function::HostHeartbeat
        );
        decoded.node = has_node.then_some(to.node);
        match self.signals(frame, to.message.function, to.node) {
            Ok(Value::Object(signals)) => {
                decoded.signals = signals;
                decoded.framing = framing(frame, to.message.function);
            }
            Ok(_) => {}
            Err(error) => decoded.error = Some(error),
        }
        decoded
    }

    fn signals(&self, frame: &Frame, function: Function, node: u8) -> Result<Value, String> {
        let short = || "not the kind or length of this message, or an unknown command".to_owned();
        let said = |e: FrameError| e.to_string();
        let layout = self.layouts.get(usize::from(node.max(1)) - 1).ok_or_else(short)?;
        Ok(match function {
            Function::Mode => {
                let m = Mode::parse(frame).ok_or_else(short)?;
                json!({ "command": m.command.name(), "node": m.node })
            }
            Function::Estop => json!({ "reason": Estop::parse(frame).ok_or_else(short)?.reason }),
            Function::Tick => {
                let t = Tick::parse(frame).ok_or_else(short)?;
                json!({ "tick": t.tick, "time_us": t.time_us })
            }
            Function::Heartbeat => {
                let h = Heartbeat::parse(frame).ok_or_else(short)?;
                let page = Page::from_code(h.page).map_or_else(|| h.page.to_string(), |p| p.name().to_owned());
                let state = State::from_code(h.state).map_or_else(|| h.state.to_string(), |s| s.name().to_owned());
                let fault = Fault::from_code(h.fault).map_or_else(|| h.fault.to_string(), |f| f.name().to_owned());
                let mut value = json!({ "state": state, "fault": fault, "seq": h.seq, "page": page, "value": h.value });
                for (name, part) in page_parts(&h) {
                    value[name] = part;
                }
                value
            }
            Function::HostHeartbeat => json!({ "seq": HostHeartbeat::parse(frame).ok_or_else(short)?.seq }),
            Function::Request => {
                let r = Request::parse(frame).ok_or_else(short)?;
                json!({ "op": r.op, "page": r.page, "tag": r.tag, "value": r.value })
            }
            Function::Transfer => {
                let data = TransferData::parse(frame).ok_or_else(short)?;
                json!({ "index": data.index, "bytes": data.len() })
            }
            Function::Reply => {
                let r = Reply::parse(frame).ok_or_else(short)?;
                json!({ "op": r.op, "page": r.page, "tag": r.tag, "value": r.value })
            }
            Function::Observation => {
                let part = layout.observation_part(frame).map_err(said)?;
                values(part.seq, part.first, &part.values, &self.observations)
            }
            Function::Action => {
                let (header, part) = layout.action_part(frame).map_err(said)?;
                let mut value = values(part.seq, part.first, &part.values, &self.actions);
                if layout.profile() == Profile::FdF32 {
                    value["latent"] = json!(latent_value(header.latent));
                    value["flags"] = json!(flag_names(header.flags));
                }
                value
            }
            Function::Decision => {
                let d = layout.decision(frame).map_err(said)?;
                json!({ "seq": d.header.seq, "latent": latent_value(d.header.latent), "flags": flag_names(d.header.flags),
                        "inference_us": d.inference_us, "allowed": d.allowed })
            }
        })
    }
}

/// What the four bytes of a heartbeat are made of, for the pages that hold more than one number.
fn page_parts(heartbeat: &Heartbeat) -> Vec<(&'static str, Value)> {
    let [b0, b1, b2, b3] = heartbeat.value.to_le_bytes();
    let slot = |code: u8| SlotState::from_code(code).map_or_else(|| json!(code), |s| json!(s.name()));
    match Page::from_code(heartbeat.page) {
        Some(Page::Jitter) => vec![
            ("jitter_permille", u16::from_le_bytes([b0, b1]).into()),
            ("bias_permille", i16::from_le_bytes([b2, b3]).into()),
        ],
        Some(Page::PolicyError) => {
            let reason = Reason::from_code(b0).map_or_else(|| json!(b0), |r| json!(r.name()));
            vec![("reason", reason), ("reason_slot", b1.into())]
        }
        Some(Page::Slots) => vec![
            ("slot0_state", slot(b0)),
            ("slot1_state", slot(b1)),
            ("running_slot", b2.into()),
            ("on_trial", b3.into()),
        ],
        _ => Vec::new(),
    }
}

/// The bytes of a good frame that are no signals for people: those of a set that are not values, and of a transfer.
fn framing(frame: &Frame, function: Function) -> Map<String, Value> {
    let payload = frame.payload();
    let mut map = Map::new();
    if function == Function::Transfer {
        map.extend(payload.iter().skip(1).enumerate().map(|(i, &byte)| (format!("data_{i}"), byte.into())));
    }
    if !matches!(function, Function::Observation | Function::Action | Function::Decision) {
        return map;
    }
    if matches!(frame.kind(), Kind::Fd { .. }) {
        if let (Function::Observation, Some(&[part, flags])) =
            (function, payload.get(2..).and_then(|p| p.first_chunk()))
        {
            map.insert("part".into(), part.into());
            for (bit, name) in ["first", "last", "invalid"].into_iter().enumerate() {
                map.insert(name.into(), (flags >> bit & 1).into());
            }
        }
        map.extend(payload.last_chunk().map(|crc| ("crc".to_owned(), u32::from_le_bytes(*crc).into())));
    } else {
        map.extend(payload.last().map(|&crc| ("crc".to_owned(), crc.into())));
    }
    map
}

/// The profile that the set frames of a trace are in: FD frames mean `fd-f32`. `None` where there are none.
pub fn profile_of<'a>(frames: impl Iterator<Item = &'a Frame>) -> Option<Profile> {
    frames
        .filter(|f| f.standard_id().and_then(address).is_some_and(|a| a.message.function == Function::Observation))
        .map(|f| match f.kind() {
            Kind::Fd { .. } => Profile::FdF32,
            _ => Profile::ClassicI16,
        })
        .next()
}

/// A latent number; `None` where no latent was chosen.
pub(crate) fn latent_value(latent: u16) -> Option<u16> {
    (latent != NO_LATENT).then_some(latent)
}

/// The flags that are set, from bit 0.
pub(crate) fn flag_names(flags: Flags) -> Vec<&'static str> {
    Flags::NAMES.iter().enumerate().filter(|(i, _)| flags.bits() >> i & 1 == 1).map(|(_, n)| *n).collect()
}

/// The shortest decimal that reads back to the same f32; `null` where it is not a number.
pub(crate) fn number(value: f32) -> Value {
    serde_json::from_str(&value.to_string()).unwrap_or(Value::Null)
}

fn values(seq: u16, first: usize, values: &[f32], names: &[String]) -> Value {
    let mut map = Map::new();
    map.insert("seq".into(), seq.into());
    for (name, &value) in names.iter().skip(first).zip(values) {
        map.insert(name.clone(), number(value));
    }
    Value::Object(map)
}
