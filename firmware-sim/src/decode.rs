//! Frames of a trace as named signals.

use gadm_node::codec::{FrameError, Layout, Profile};
use gadm_node::protocol::{Function, NO_LATENT, NodeId, address};
use gadm_node::service::{Estop, Heartbeat, HostHeartbeat, Mode, Page, Reply, Request, Tick, TransferData};
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
            let ranges = policy.observation_signals().map(|s| (s.lo, s.hi));
            let heads = policy.action_signals().map(|s| s.head);
            Layout::new(profile, node, policy.interface_hash(), ranges, heads)
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
        let mut decoded = Decoded { name: "UNKNOWN", id: frame.raw_id(), node: None, signals: Map::new(), error: None };
        let Some(to) = frame.standard_id().and_then(address) else { return decoded };
        decoded.name = to.message.name;
        let has_node = !matches!(
            to.message.function,
            Function::Tick | Function::Observation | Function::Mode | Function::HostHeartbeat
        );
        decoded.node = has_node.then_some(to.node);
        match self.signals(frame, to.message.function, to.node) {
            Ok(Value::Object(signals)) => decoded.signals = signals,
            Ok(_) => {}
            Err(error) => decoded.error = Some(error),
        }
        decoded
    }

    fn signals(&self, frame: &Frame, function: Function, node: u8) -> Result<Value, String> {
        let short = || "too short, or an unknown command".to_owned();
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
                json!({ "state": state, "fault": fault, "seq": h.seq, "page": page, "value": h.value })
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
                    value["latent"] = latent(header.latent);
                    value["flags"] = flags(header.flags);
                }
                value
            }
            Function::Decision => {
                let d = layout.decision(frame).map_err(said)?;
                json!({ "seq": d.header.seq, "latent": latent(d.header.latent), "flags": flags(d.header.flags),
                        "inference_us": d.inference_us, "allowed": d.allowed })
            }
        })
    }
}

/// The profile that the set frames of a trace are in: FD frames mean `fd-f32`. `None` where there are none.
pub fn profile_of<'a>(frames: impl Iterator<Item = &'a Frame>) -> Option<Profile> {
    frames
        .filter(|f| f.standard_id().and_then(address).is_some_and(|a| a.message.function == Function::Observation))
        .map(|f| match f.kind() {
            gadm_node::frame::Kind::Fd { .. } => Profile::FdF32,
            _ => Profile::ClassicI16,
        })
        .next()
}

fn latent(latent: u16) -> Value {
    if latent == NO_LATENT { Value::Null } else { latent.into() }
}

fn flags(flags: Flags) -> Value {
    Flags::NAMES.iter().enumerate().filter(|(i, _)| flags.bits() >> i & 1 == 1).map(|(_, n)| *n).collect()
}

/// An invalid value is `null`. An f32 is printed as the shortest decimal that reads back to the same f32.
fn values(seq: u16, first: usize, values: &[f32], names: &[String]) -> Value {
    let mut map = Map::new();
    map.insert("seq".into(), seq.into());
    for (name, &value) in names.iter().skip(first).zip(values) {
        let number = serde_json::from_str(&value.to_string()).unwrap_or(Value::Null);
        map.insert(name.clone(), number);
    }
    Value::Object(map)
}
