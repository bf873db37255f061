//! A trace as MCAP, which Foxglove and its relatives show: decoded signals over time, and events as a log.
//!
//! Every message is JSON with a JSON schema, so a viewer knows names and units without this program:
//!
//! | topic | from | holds |
//! | --- | --- | --- |
//! | `/observation`, `/action` | OBS, ACT | values by the policy's names; an invalid one is `null` |
//! | `/decision` | ACT or DECISION | latent, flags as 0 and 1 |
//! | `/tick`, `/heartbeat` | TICK, HEARTBEAT | as decoded |
//! | `/events` | all | `foxglove.Log`: requests, changes of state and fault, safe and held actions, frames that cannot be read |
//!
//! The file has no compression, so that no C code is needed; chunks, an index and CRCs it has.

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use gadm_node::Flags;
use gadm_runtime::{ActionHead, Policy};
use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions, Writer};
use serde_json::{Map, Value, json};

use crate::SimError;
use crate::bus::trace::Record;
use crate::decode::{Decoded, Decoder, profile_of};

/// Levels of `foxglove.Log`.
const INFO: u8 = 2;
const WARNING: u8 = 3;
const ERROR: u8 = 4;

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Written {
    /// Messages on all topics.
    pub messages: u64,
    /// How many of them are events.
    pub events: u64,
}

/// Why no file was made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// The policy or the trace.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// The file.
    #[error("cannot write the MCAP file: {0}; check the folder, its permissions and the free space")]
    Write(#[from] McapError),
}

struct Topics {
    observation: u16,
    action: u16,
    decision: u16,
    tick: u16,
    heartbeat: u16,
    events: u16,
}

struct Export<W: Write + Seek> {
    writer: Writer<W>,
    topics: Topics,
    sequence: BTreeMap<u16, u32>,
    written: Written,
    /// State, fault and flags that were last seen.
    state: Option<(String, String)>,
    flags: Option<Vec<String>>,
    latest_tick: Option<u64>,
}

/// Writes the frames of a trace to `out`.
///
/// # Errors
/// [`ExportError::Sim`] where no profile can carry the policy, [`ExportError::Write`] for the file.
pub fn export<W: Write + Seek>(policy: &Policy, records: &[Record], out: W) -> Result<Written, ExportError> {
    let profile = profile_of(records.iter().filter_map(|r| r.frame.as_ref())).unwrap_or(gadm_node::Profile::FdF32);
    let decoder = Decoder::new(policy, profile)?;
    let library = concat!("gadm-sim ", env!("CARGO_PKG_VERSION"));
    let options = WriteOptions::new().compression(None).library(library);
    let mut writer = options.create(out)?;
    let topics = Topics {
        observation: topic(&mut writer, "/observation", "gadm.Observation", &observation_schema(policy))?,
        action: topic(&mut writer, "/action", "gadm.Action", &action_schema(policy))?,
        decision: topic(&mut writer, "/decision", "gadm.Decision", &decision_schema())?,
        tick: topic(&mut writer, "/tick", "gadm.Tick", &integers(&["tick", "time_us"]))?,
        heartbeat: topic(&mut writer, "/heartbeat", "gadm.Heartbeat", &heartbeat_schema())?,
        events: topic(&mut writer, "/events", "foxglove.Log", &log_schema())?,
    };
    let about = [
        ("environment", policy.provenance().environment.to_owned()),
        ("interface_hash", format!("{:016x}", policy.interface_hash())),
        ("policy_crc32", format!("{:08x}", policy.header().payload_crc32)),
        ("profile", profile.name().to_owned()),
    ];
    let metadata = about.into_iter().map(|(k, v)| (k.to_owned(), v)).collect();
    writer.write_metadata(&Metadata { name: "gadm".to_owned(), metadata })?;
    let mut export = Export {
        writer,
        topics,
        sequence: BTreeMap::new(),
        written: Written::default(),
        state: None,
        flags: None,
        latest_tick: None,
    };
    for record in records {
        match &record.frame {
            Some(frame) => export.frame(record.time_us, &decoder.decode(frame))?,
            None => export.event(record.time_us, ERROR, "bus", "error frame of the controller")?,
        }
    }
    export.writer.finish()?;
    Ok(export.written)
}

fn topic<W: Write + Seek>(writer: &mut Writer<W>, topic: &str, schema: &str, text: &Value) -> Result<u16, McapError> {
    let schema = writer.add_schema(schema, "jsonschema", text.to_string().as_bytes())?;
    writer.add_channel(schema, topic, "json", &BTreeMap::new())
}

impl<W: Write + Seek> Export<W> {
    fn frame(&mut self, time_us: u64, decoded: &Decoded) -> Result<(), McapError> {
        let name = decoded.name;
        if let Some(error) = &decoded.error {
            return self.event(time_us, ERROR, name, &format!("{:03X} cannot be read: {error}", decoded.id));
        }
        let mut signals = decoded.signals.clone();
        match name {
            "OBS" => self.put(self.topics.observation, time_us, &Value::Object(signals)),
            "ACT" | "ACT_PART" => {
                let seq = signals.get("seq").cloned();
                let (latent, flags) = (signals.remove("latent"), signals.remove("flags"));
                self.put(self.topics.action, time_us, &Value::Object(signals))?;
                match flags {
                    // In classic-i16 DECISION says it.
                    Some(flags) if name == "ACT" => self.decision(time_us, seq, latent, &flags),
                    _ => Ok(()),
                }
            }
            "DECISION" => {
                let flags = signals.remove("flags").unwrap_or_default();
                self.decision(time_us, signals.get("seq").cloned(), signals.remove("latent"), &flags)
            }
            "TICK" => {
                self.tick(time_us, &signals)?;
                self.put(self.topics.tick, time_us, &Value::Object(signals))
            }
            "HEARTBEAT" => {
                self.heartbeat(time_us, &signals)?;
                self.put(self.topics.heartbeat, time_us, &Value::Object(signals))
            }
            "MODE" | "ESTOP" => {
                let level = if name == "ESTOP" { ERROR } else { INFO };
                self.event(time_us, level, name, &brief(&signals))
            }
            "UNKNOWN" => self.event(time_us, WARNING, "bus", &format!("{:03X} is not of the protocol", decoded.id)),
            _ => Ok(()),
        }
    }

    fn decision(
        &mut self,
        time_us: u64,
        seq: Option<Value>,
        latent: Option<Value>,
        flags: &Value,
    ) -> Result<(), McapError> {
        let set: Vec<String> =
            flags.as_array().into_iter().flatten().filter_map(|f| f.as_str().map(str::to_owned)).collect();
        let mut message = Map::new();
        message.insert("seq".into(), seq.unwrap_or_default());
        message.insert("latent".into(), latent.unwrap_or_default());
        for name in Flags::NAMES {
            message.insert(name.into(), u8::from(set.iter().any(|f| f == name)).into());
        }
        self.put(self.topics.decision, time_us, &Value::Object(message))?;
        let grave = |set: &[String]| set.iter().filter(|f| matches!(f.as_str(), "safe" | "held")).cloned().collect();
        let now: Vec<String> = grave(&set);
        let before = self.flags.replace(now.clone());
        match before {
            Some(before) if before == now => Ok(()),
            None if now.is_empty() => Ok(()),
            _ if now.is_empty() => self.event(time_us, INFO, "ACT", "the policy's actions again"),
            _ => self.event(time_us, WARNING, "ACT", &format!("{} actions begin", now.join(", "))),
        }
    }

    fn tick(&mut self, time_us: u64, signals: &Map<String, Value>) -> Result<(), McapError> {
        let Some(tick) = signals.get("tick").and_then(Value::as_u64) else { return Ok(()) };
        match self.latest_tick.replace(tick) {
            Some(before) if tick != before + 1 => {
                self.event(time_us, WARNING, "TICK", &format!("tick {tick} follows tick {before}"))
            }
            _ => Ok(()),
        }
    }

    fn heartbeat(&mut self, time_us: u64, signals: &Map<String, Value>) -> Result<(), McapError> {
        let text = |key: &str| signals.get(key).and_then(Value::as_str).unwrap_or("").to_owned();
        let now = (text("state"), text("fault"));
        if self.state.as_ref() == Some(&now) {
            return Ok(());
        }
        let level = match now.0.as_str() {
            "FAULT" | "NO_POLICY" => ERROR,
            "SAFE" => WARNING,
            _ => INFO,
        };
        let message = format!("state {}, fault {}", now.0, now.1);
        self.state = Some(now);
        self.event(time_us, level, "HEARTBEAT", &message)
    }

    fn event(&mut self, time_us: u64, level: u8, name: &str, message: &str) -> Result<(), McapError> {
        self.written.events += 1;
        let timestamp = json!({ "sec": time_us / 1_000_000, "nsec": time_us % 1_000_000 * 1000 });
        let log = json!({
            "timestamp": timestamp, "level": level, "message": message, "name": name, "file": "", "line": 0
        });
        self.put(self.topics.events, time_us, &log)
    }

    fn put(&mut self, channel_id: u16, time_us: u64, message: &Value) -> Result<(), McapError> {
        let sequence = self.sequence.entry(channel_id).or_default();
        let log_time = time_us.saturating_mul(1000);
        let header = MessageHeader { channel_id, sequence: *sequence, log_time, publish_time: log_time };
        *sequence = sequence.wrapping_add(1);
        self.written.messages += 1;
        self.writer.write_to_known_channel(&header, message.to_string().as_bytes())
    }
}

fn brief(signals: &Map<String, Value>) -> String {
    let word = |(name, value): (&String, &Value)| match value {
        Value::String(text) => format!("{name} {text}"),
        value => format!("{name} {value}"),
    };
    signals.iter().map(word).collect::<Vec<_>>().join(", ")
}

fn object(properties: Map<String, Value>) -> Value {
    let mut schema = json!({ "type": "object" });
    schema["properties"] = Value::Object(properties);
    schema
}

fn integers(names: &[&str]) -> Value {
    object(names.iter().map(|&n| (n.to_owned(), json!({ "type": "integer" }))).collect())
}

/// Schema of a value that may be missing.
fn quantity(description: &str, lo: f32, hi: f32) -> Value {
    let mut schema = json!({ "type": ["number", "null"], "description": description });
    if lo.is_finite() && hi.is_finite() {
        schema["minimum"] = crate::decode::number(lo);
        schema["maximum"] = crate::decode::number(hi);
    }
    schema
}

fn observation_schema(policy: &Policy) -> Value {
    let mut properties = Map::new();
    properties.insert("seq".into(), json!({ "type": "integer" }));
    for s in policy.observation_signals() {
        // The range is the usual one, and not a limit: no minimum or maximum.
        let text = format!("observation in {}, usually {} to {}", s.unit, s.lo, s.hi);
        properties.insert(s.name.to_owned(), quantity(&text, f32::NEG_INFINITY, f32::INFINITY));
    }
    object(properties)
}

fn action_schema(policy: &Policy) -> Value {
    let mut properties = Map::new();
    properties.insert("seq".into(), json!({ "type": "integer" }));
    for s in policy.action_signals() {
        let (lo, hi) = match s.head {
            ActionHead::Continuous { lo, hi } => (lo, hi),
            ActionHead::Discrete { n } => (0.0, f32::from(n.saturating_sub(1))),
            ActionHead::Binary => (0.0, 1.0),
        };
        properties.insert(s.name.to_owned(), quantity(&format!("action in {}, safe value {}", s.unit, s.safe), lo, hi));
    }
    object(properties)
}

fn decision_schema() -> Value {
    let mut properties = Map::new();
    properties.insert("seq".into(), json!({ "type": "integer" }));
    properties.insert("latent".into(), json!({ "type": ["integer", "null"], "description": "null: none was chosen" }));
    for name in Flags::NAMES {
        properties.insert(name.into(), json!({ "type": "integer", "minimum": 0, "maximum": 1 }));
    }
    object(properties)
}

fn heartbeat_schema() -> Value {
    let numbers = ["seq", "value", "jitter_permille", "bias_permille", "reason_slot", "running_slot", "on_trial"];
    let mut schema = integers(&numbers);
    for name in ["state", "fault", "page", "reason", "slot0_state", "slot1_state"] {
        schema["properties"][name] = json!({ "type": "string" });
    }
    schema
}

/// Source: Foxglove's schema `foxglove.Log`, the fields that a viewer reads.
fn log_schema() -> Value {
    json!({
        "title": "foxglove.Log",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object", "title": "time",
                "properties": { "sec": { "type": "integer", "minimum": 0 }, "nsec": { "type": "integer", "minimum": 0 } }
            },
            "level": { "title": "foxglove.LogLevel", "type": "integer", "oneOf": [
                { "title": "UNKNOWN", "const": 0 }, { "title": "DEBUG", "const": 1 }, { "title": "INFO", "const": 2 },
                { "title": "WARNING", "const": 3 }, { "title": "ERROR", "const": 4 }, { "title": "FATAL", "const": 5 }
            ] },
            "message": { "type": "string" },
            "name": { "type": "string" },
            "file": { "type": "string" },
            "line": { "type": "integer", "minimum": 0 }
        }
    })
}
