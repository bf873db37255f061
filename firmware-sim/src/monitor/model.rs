//! What the frames so far say about a bus.
//!
//! Times are those of the frames, microseconds; nothing here reads a clock. Rates and load are over the last second.

use std::collections::{BTreeMap, VecDeque};

use gadm_node::frame::Kind;
use gadm_node::protocol::{Function, Index, NO_LATENT, address};
use gadm_node::service::{Heartbeat, HostHeartbeat, Mode, Page, Tick};
use gadm_node::{Fault, Flags, Frame, Profile, State};
use gadm_runtime::Policy;
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::SimError;
use crate::bus::load::BitRate;
use crate::decode::{Decoded, Decoder};

/// Version of the JSON form of [`Snapshot`].
pub const SNAPSHOT_VERSION: u32 = 1;
/// Length of the window for rates and load, microseconds.
const WINDOW_US: u64 = 1_000_000;
/// Frames that one window may hold; more than 8 Mbit/s can carry.
const WINDOW_FRAMES: usize = 200_000;

/// How many frames a counter in them skipped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Gaps {
    /// Numbers that were never seen.
    pub missing: u64,
    /// Numbers seen twice or out of order.
    pub repeated: u64,
    #[serde(skip)]
    last: Option<u32>,
}

impl Gaps {
    /// Takes the next number of a counter that wraps after `mask`.
    fn see(&mut self, number: u32, mask: u32) {
        if let Some(last) = self.last.replace(number) {
            match number.wrapping_sub(last) & mask {
                1 => {}
                ahead if ahead != 0 && ahead <= mask / 2 => self.missing += u64::from(ahead - 1),
                _ => self.repeated += 1,
            }
        }
    }
}

/// All frames of one identifier.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Identifier.
    pub id: u32,
    /// 29-bit identifier.
    pub extended: bool,
    /// Name of the message; `UNKNOWN` for one that is not of the protocol.
    pub name: &'static str,
    /// Node number, where the message has one.
    pub node: Option<u8>,
    /// Frames.
    pub frames: u64,
    /// Frames in the last second.
    pub rate_hz: f64,
    /// Time since the last frame, microseconds.
    pub age_us: u64,
    /// Numbers that the counter in the frames skipped or repeated.
    pub gaps: Gaps,
    /// Frames that could not be read.
    pub errors: u64,
    /// Signals of the last frame; `data` in hexadecimal where they are not known.
    pub signals: Map<String, Value>,
    /// Why the last frame could not be read.
    pub error: Option<String>,
    #[serde(skip)]
    last_us: u64,
    #[serde(skip)]
    times: VecDeque<u64>,
}

/// A node as its heartbeats show it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Node {
    /// Number.
    pub node: u8,
    /// State.
    pub state: String,
    /// Fault code.
    pub fault: String,
    /// The fault in words.
    pub meaning: String,
    /// Time since the last heartbeat, microseconds.
    pub age_us: u64,
    /// Times the state changed.
    pub changes: u64,
    /// Last value of each page.
    pub pages: BTreeMap<String, u32>,
    #[serde(skip)]
    last_us: u64,
}

/// The whole picture at one time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Snapshot {
    /// [`SNAPSHOT_VERSION`].
    pub version: u32,
    /// Time of the last frame, microseconds; of the first one, 0 in the picture.
    pub time_us: u64,
    /// Frames.
    pub frames: u64,
    /// Frames in the last second.
    pub rate_hz: f64,
    /// Worst-case time of the frames of the last second on the wire, per cent; `null` in the first tenth of a second.
    pub load_percent: Option<f64>,
    /// Bit rates that the load is for.
    pub bit_rate: BitRate,
    /// Error frames of the controller.
    pub error_frames: u64,
    /// Lines of a trace that were none, and what is wrong with the last of them.
    pub bad_lines: u64,
    /// What is wrong with the last of them.
    pub bad_line: Option<String>,
    /// How values travel, where it is known.
    pub profile: Option<&'static str>,
    /// Nodes.
    pub nodes: Vec<Node>,
    /// Identifiers.
    pub rows: Vec<Row>,
    /// How often each latent was chosen.
    pub latent_counts: Vec<u64>,
    /// The last latent.
    pub latent: Option<u16>,
    /// Action sets with each flag.
    pub flags: BTreeMap<&'static str, u64>,
}

/// Takes frames and keeps the picture.
pub struct Model<'p> {
    policy: Option<&'p Policy<'p>>,
    decoder: Option<(Profile, Decoder)>,
    rate: BitRate,
    rows: BTreeMap<(bool, u32), Row>,
    nodes: BTreeMap<u8, Node>,
    latent_counts: Vec<u64>,
    latent: Option<u16>,
    flags: BTreeMap<&'static str, u64>,
    window: VecDeque<(u64, u64)>,
    window_ns: u64,
    first_us: Option<u64>,
    now_us: u64,
    frames: u64,
    error_frames: u64,
    bad_lines: u64,
    bad_line: Option<String>,
}

impl std::fmt::Debug for Model<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Model").field("frames", &self.frames).field("now_us", &self.now_us).finish_non_exhaustive()
    }
}

impl<'p> Model<'p> {
    /// Nothing seen yet. With a policy its signals are decoded; without, only what every node says.
    #[must_use]
    pub fn new(policy: Option<&'p Policy<'p>>, rate: BitRate) -> Self {
        let latents = policy.map_or(0, |p| usize::from(p.spec().num_latents));
        Self {
            policy,
            decoder: None,
            rate,
            rows: BTreeMap::new(),
            nodes: BTreeMap::new(),
            latent_counts: vec![0; latents],
            latent: None,
            flags: BTreeMap::new(),
            window: VecDeque::new(),
            window_ns: 0,
            first_us: None,
            now_us: 0,
            frames: 0,
            error_frames: 0,
            bad_lines: 0,
            bad_line: None,
        }
    }

    /// Forgets everything but the policy.
    pub fn reset(&mut self) {
        *self = Self::new(self.policy, self.rate);
    }

    /// One frame.
    ///
    /// # Errors
    /// [`SimError::Layout`] where the frames on this bus cannot carry the policy.
    pub fn frame(&mut self, time_us: u64, frame: &Frame) -> Result<(), SimError> {
        self.advance(time_us);
        self.frames += 1;
        let wire_ns = self.rate.time_ns(frame);
        self.window.push_back((self.now_us, wire_ns));
        self.window_ns += wire_ns;
        let decoded = self.decode(frame)?;
        let extended = frame.standard_id().is_none();
        let now_us = self.now_us;
        let row = self.rows.entry((extended, frame.raw_id())).or_insert_with(|| Row {
            id: frame.raw_id(),
            extended,
            name: decoded.name,
            node: decoded.node,
            frames: 0,
            rate_hz: 0.0,
            age_us: 0,
            gaps: Gaps::default(),
            errors: 0,
            signals: Map::new(),
            error: None,
            last_us: now_us,
            times: VecDeque::new(),
        });
        row.frames += 1;
        row.last_us = now_us;
        row.times.push_back(now_us);
        if row.times.len() > WINDOW_FRAMES {
            row.times.pop_front();
        }
        row.errors += u64::from(decoded.error.is_some());
        row.error = decoded.error;
        if row.error.is_none() {
            row.signals = decoded.signals;
        }
        self.count(frame);
        Ok(())
    }

    /// An error frame of the controller.
    pub fn error_frame(&mut self, time_us: u64) {
        self.advance(time_us);
        self.error_frames += 1;
    }

    /// A line that is no frame.
    pub fn bad_line(&mut self, what: String) {
        self.bad_lines += 1;
        self.bad_line = Some(what);
    }

    /// Time goes on without a frame. A trace whose time jumps back keeps the latest time.
    pub fn advance(&mut self, time_us: u64) {
        self.first_us.get_or_insert(time_us);
        self.now_us = self.now_us.max(time_us);
        let from = self.now_us.saturating_sub(WINDOW_US);
        while self.window.front().is_some_and(|(t, _)| *t < from) || self.window.len() > WINDOW_FRAMES {
            let Some((_, ns)) = self.window.pop_front() else { break };
            self.window_ns -= ns;
        }
    }

    /// Time of the last frame or of [`advance`](Self::advance), microseconds.
    #[must_use]
    pub fn now_us(&self) -> u64 {
        self.now_us
    }

    fn decode(&mut self, frame: &Frame) -> Result<Decoded, SimError> {
        let function = frame.standard_id().and_then(address).map(|a| a.message.function);
        let sets = matches!(function, Some(Function::Observation | Function::Action | Function::Decision));
        if let (Some(policy), true) = (self.policy, sets) {
            let profile = match frame.kind() {
                Kind::Fd { .. } => Profile::FdF32,
                Kind::Classic | Kind::Remote => Profile::ClassicI16,
            };
            if self.decoder.as_ref().is_none_or(|(known, _)| *known != profile) {
                self.decoder = Some((profile, Decoder::new(policy, profile)?));
            }
        }
        match (&self.decoder, sets) {
            (Some((_, decoder)), _) => Ok(decoder.decode(frame)),
            (None, _) => Ok(plain(frame)),
        }
    }

    /// Counters, states, latents.
    fn count(&mut self, frame: &Frame) {
        let extended = frame.standard_id().is_none();
        let Some(to) = frame.standard_id().and_then(address) else { return };
        let Some(row) = self.rows.get_mut(&(extended, frame.raw_id())) else { return };
        if row.error.is_some() {
            return;
        }
        let profile_mask = self.decoder.as_ref().map(|(p, _)| u32::from(p.seq_mask()));
        match to.message.function {
            Function::Tick => _ = Tick::parse(frame).map(|t| row.gaps.see(t.tick, u32::MAX)),
            Function::HostHeartbeat => _ = HostHeartbeat::parse(frame).map(|h| row.gaps.see(u32::from(h.seq), 0xFF)),
            Function::Heartbeat => {
                let Some(heartbeat) = Heartbeat::parse(frame) else { return };
                row.gaps.see(u32::from(heartbeat.seq), 0xFF);
                self.heartbeat(to.node, &heartbeat);
            }
            Function::Observation | Function::Action | Function::Decision => {
                let (Some(mask), Some(seq)) = (profile_mask, row.signals.get("seq").and_then(Value::as_u64)) else {
                    return;
                };
                row.gaps.see(seq as u32, mask);
                let latent = row.signals.get("latent").and_then(Value::as_u64).map(|l| l as u16);
                let flags: Vec<&'static str> = row
                    .signals
                    .get("flags")
                    .and_then(Value::as_array)
                    .map(|all| Flags::NAMES.into_iter().filter(|name| all.iter().any(|f| f == name)).collect())
                    .unwrap_or_default();
                let has_header = row.signals.contains_key("flags") && to.part == 0;
                if has_header {
                    self.decision(latent, &flags);
                }
            }
            _ => {} // no counter in it
        }
    }

    fn decision(&mut self, latent: Option<u16>, flags: &[&'static str]) {
        for flag in flags {
            *self.flags.entry(flag).or_default() += 1;
        }
        let repeated = flags.contains(&"held") || flags.contains(&"safe");
        if let Some(latent) = latent.filter(|l| *l != NO_LATENT && !repeated) {
            self.latent = Some(latent);
            let at = usize::from(latent);
            if at >= self.latent_counts.len() {
                self.latent_counts.resize(at + 1, 0);
            }
            self.latent_counts[at] += 1;
        }
    }

    fn heartbeat(&mut self, number: u8, heartbeat: &Heartbeat) {
        let state = State::from_code(heartbeat.state).map_or_else(|| heartbeat.state.to_string(), |s| s.name().into());
        let fault = Fault::from_code(heartbeat.fault);
        let name = fault.map_or_else(|| heartbeat.fault.to_string(), |f| f.name().to_owned());
        let meaning = fault.map_or("a fault that this version does not know", Fault::meaning).to_owned();
        let page = Page::from_code(heartbeat.page).map_or_else(|| heartbeat.page.to_string(), |p| p.name().to_owned());
        let node = self.nodes.entry(number).or_insert_with(|| Node {
            node: number,
            state: state.clone(),
            fault: String::new(),
            meaning: String::new(),
            age_us: 0,
            changes: 0,
            pages: BTreeMap::new(),
            last_us: 0,
        });
        node.changes += u64::from(node.state != state);
        (node.state, node.fault, node.meaning, node.last_us) = (state, name, meaning, self.now_us);
        node.pages.insert(page, heartbeat.value);
    }

    /// The picture now.
    #[must_use]
    pub fn snapshot(&self) -> Snapshot {
        let first_us = self.first_us.unwrap_or(0);
        let seen_us = (self.now_us - first_us).min(WINDOW_US);
        let from = self.now_us.saturating_sub(WINDOW_US);
        let per_second = |n: usize| if seen_us == 0 { 0.0 } else { n as f64 * 1e6 / seen_us as f64 };
        let rows = self.rows.values().map(|row| {
            let recent = row.times.iter().rev().take_while(|t| **t >= from).count();
            Row {
                rate_hz: per_second(recent),
                age_us: self.now_us - row.last_us,
                times: VecDeque::new(),
                ..row.clone()
            }
        });
        let nodes = self.nodes.values().map(|n| Node { age_us: self.now_us - n.last_us, ..n.clone() });
        Snapshot {
            version: SNAPSHOT_VERSION,
            time_us: self.now_us - first_us,
            frames: self.frames,
            rate_hz: per_second(self.window.len()),
            load_percent: (seen_us >= WINDOW_US / 10).then(|| self.window_ns as f64 / 10.0 / seen_us as f64),
            bit_rate: self.rate,
            error_frames: self.error_frames,
            bad_lines: self.bad_lines,
            bad_line: self.bad_line.clone(),
            profile: self.decoder.as_ref().map(|(p, _)| p.name()),
            nodes: nodes.collect(),
            rows: rows.collect(),
            latent_counts: self.latent_counts.clone(),
            latent: self.latent,
            flags: self.flags.clone(),
        }
    }
}

/// What can be said about a frame without a policy.
fn plain(frame: &Frame) -> Decoded {
    let mut decoded = Decoded {
        name: "UNKNOWN",
        id: frame.raw_id(),
        node: None,
        signals: Map::new(),
        framing: Map::new(),
        error: None,
    };
    let Some(to) = frame.standard_id().and_then(address) else {
        decoded.signals = data(frame);
        return decoded;
    };
    decoded.name = to.message.name;
    decoded.node = matches!(to.message.index, Index::Node | Index::NodePart).then_some(to.node);
    let short = || Some("too short, or an unknown code".to_owned());
    let known = match to.message.function {
        Function::Tick => Tick::parse(frame).map(|t| json!({ "tick": t.tick, "time_us": t.time_us })),
        Function::Heartbeat => Heartbeat::parse(frame).map(|h| {
            let state = State::from_code(h.state).map_or_else(|| h.state.to_string(), |s| s.name().to_owned());
            let fault = Fault::from_code(h.fault).map_or_else(|| h.fault.to_string(), |f| f.name().to_owned());
            let page = Page::from_code(h.page).map_or_else(|| h.page.to_string(), |p| p.name().to_owned());
            json!({ "state": state, "fault": fault, "seq": h.seq, "page": page, "value": h.value })
        }),
        Function::HostHeartbeat => HostHeartbeat::parse(frame).map(|h| json!({ "seq": h.seq })),
        Function::Mode => Mode::parse(frame).map(|m| json!({ "command": m.command.name(), "node": m.node })),
        _ => {
            decoded.signals = data(frame);
            return decoded;
        }
    };
    match known {
        Some(Value::Object(signals)) => decoded.signals = signals,
        _ => decoded.error = short(),
    }
    decoded
}

fn data(frame: &Frame) -> Map<String, Value> {
    let hex: Vec<String> = frame.payload().iter().map(|b| format!("{b:02X}")).collect();
    Map::from_iter([("data".to_owned(), hex.join(" ").into())])
}

#[cfg(test)]
mod tests {
    use super::*;
    use gadm_node::frame::standard;

    fn tick(tick: u32) -> Frame {
        Tick { tick, time_us: tick * 1000 }.frame()
    }

    #[test]
    fn gaps_are_counted_over_the_wrap_of_the_counter() {
        let mut gaps = Gaps::default();
        for number in [254, 255, 0, 3, 3, 2, 4] {
            gaps.see(number, 0xFF);
        }
        // 1 and 2 are missing between 0 and 3; 3 again and 2 after it are repeats; from 2 to 4 one is missing.
        assert_eq!((gaps.missing, gaps.repeated), (3, 2));
    }

    #[test]
    fn rates_and_load_are_those_of_the_last_second() {
        let rate = BitRate { nominal: 500_000, data: 2_000_000 };
        let mut model = Model::new(None, rate);
        for i in 0..3000_u32 {
            // 1000 Hz for two seconds, then 100 Hz.
            let time_us = if i < 2000 { u64::from(i) * 1000 } else { 2_000_000 + u64::from(i - 2000) * 10_000 };
            model.frame(time_us, &tick(i)).unwrap();
            if i == 1999 {
                let s = model.snapshot();
                assert!((s.rate_hz - 1000.0).abs() <= 2.0, "{}", s.rate_hz);
                // 135 bits of a classic frame with 8 bytes, at 1000 Hz and 500 kbit/s.
                assert!((s.load_percent.unwrap() - 27.0).abs() < 0.1, "{:?}", s.load_percent);
            }
        }
        let s = model.snapshot();
        assert_eq!((s.frames, s.rows.len(), s.rows[0].name), (3000, 1, "TICK"));
        assert!((s.rows[0].rate_hz - 100.0).abs() <= 2.0 && (s.load_percent.unwrap() - 2.7).abs() < 0.1);
        assert_eq!(s.rows[0].gaps.missing, 0);
    }

    #[test]
    fn nodes_show_state_fault_and_pages() {
        let mut model = Model::new(None, BitRate::default());
        for (seq, state) in [(0, State::Ready), (1, State::Run), (4, State::Safe)] {
            let fault = if state == State::Safe { Fault::TickLost } else { Fault::None };
            let data = [state.code(), Page::Misses as u8, fault.code(), seq, 7, 0, 0, 0];
            model.frame(u64::from(seq) * 100_000, &Frame::classic(standard(0x705), &data).unwrap()).unwrap();
        }
        model.advance(900_000);
        let s = model.snapshot();
        let node = &s.nodes[0];
        assert_eq!((node.node, node.state.as_str(), node.fault.as_str()), (5, "SAFE", "TICK_LOST"));
        assert_eq!((node.changes, node.age_us, node.pages[Page::Misses.name()]), (2, 500_000, 7));
        assert_eq!((s.rows[0].gaps.missing, s.rows[0].node), (2, Some(5)));
    }

    #[test]
    fn foreign_and_short_frames_are_shown_not_hidden() {
        let mut model = Model::new(None, BitRate::default());
        model.frame(0, &Frame::classic(standard(0x7FF), &[0xAB, 1]).unwrap()).unwrap();
        model.frame(1, &Frame::classic(standard(0x080), &[1]).unwrap()).unwrap();
        model.error_frame(2);
        model.bad_line("line 3: expected `#`".to_owned());
        let s = model.snapshot();
        assert_eq!((s.error_frames, s.bad_lines), (1, 1));
        assert_eq!((s.rows[0].name, s.rows[0].errors), ("TICK", 1));
        assert_eq!((s.rows[1].name, s.rows[1].signals["data"].as_str()), ("UNKNOWN", Some("AB 01")));
    }
}
