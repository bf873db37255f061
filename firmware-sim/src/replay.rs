//! A recorded trace through the policy again: the same actions, or the first tick at which they differ.
//!
//! The node of this program gets every frame of the trace that was not sent by the recorded node, in order, and its
//! time from the ticks in the trace. What it answers is compared with what the trace says was answered: latent, flags
//! and every action value, bit for bit. Two things are not compared, because they belong to the board that was
//! recorded: the inference time in DECISION, and the flag `late`.
//!
//! A trace that begins in the middle of an episode has no RUN request. The node is then started before the first tick.

use std::collections::{BTreeMap, VecDeque};

use gadm_node::codec::{FrameError, Layout, Profile};
use gadm_node::protocol::{Function, address};
use gadm_node::service::{Mode, ModeCommand, Tick, concerns};
use gadm_node::{ControlNode, Flags, Frame, Link, LinkError, NodeConfig, NodeId, State, TimeSource};
use gadm_runtime::Policy;
use serde::Serialize;
use serde_json::{Map, Value};

use crate::SimError;
use crate::bus::trace::Record;
use crate::decode::{flag_names, latent_value, number, profile_of};

/// Version of the JSON form of [`Replay`].
pub const REPLAY_VERSION: u32 = 1;
/// Polls after which a node must be at rest.
const POLLS: u32 = 10_000;

/// What to look at in a trace.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReplayOptions {
    /// Number of the node that was recorded; `None`: 1.
    pub node: Option<NodeId>,
    /// Profile; `None`: that of the trace.
    pub profile: Option<Profile>,
    /// Name of the bus in the trace; `None`: the only one there is.
    pub interface: Option<String>,
}

/// One action set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ActionSet {
    /// Time stamp in the trace, µs; of a replayed set, that of the frame that caused it.
    pub time_us: u64,
    /// Latent; `None` where none was chosen.
    pub latent: Option<u16>,
    /// Names of the flags.
    pub flags: Vec<&'static str>,
    /// Action values by name; `null` for one that is not a number or did not come.
    pub action: Map<String, Value>,
    #[serde(skip)]
    bits: Vec<Option<u32>>,
}

/// The first tick at which trace and replay differ.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Number of the control period.
    pub tick: u32,
    /// What differs: `latent`, `flags`, `action NAME`, or which side has no action set.
    pub what: String,
    /// What the trace says.
    pub recorded: Option<ActionSet>,
    /// What the policy does.
    pub replayed: Option<ActionSet>,
}

/// What a replay found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Replay {
    /// Version of this record.
    pub version: u32,
    /// The verdict: something was compared, and all of it was equal.
    pub same: bool,
    /// Name of the profile.
    pub profile: &'static str,
    /// Number of the node.
    pub node: u8,
    /// Frames of the trace that the node was given.
    pub frames: u64,
    /// Ticks in the trace.
    pub ticks: u64,
    /// Action sets that were compared.
    pub compared: u64,
    /// How many of them differ.
    pub differing: u64,
    /// Frames of the recorded node that could not be read: damaged, or of another policy.
    pub damaged: u64,
    /// The trace began in the middle of an episode, and the node was started before its first tick.
    pub assumed_run: bool,
    /// The first difference.
    pub first: Option<Difference>,
}

/// The bus of a replay: what is given to the node, and what it says.
#[derive(Debug, Default)]
struct Tape {
    to_node: VecDeque<Frame>,
    from_node: Vec<Frame>,
}

impl Link for Tape {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        let next = self.to_node.pop_front();
        if let Some(next) = next {
            *frame = next;
        }
        Ok(next.is_some())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        self.from_node.push(*frame);
        Ok(())
    }
}

/// A set's place: how often the ticks began again, the tick, and which set of that tick.
type Key = (u32, u32, u32);

/// Collects the action sets of one side.
struct Assembly<'l> {
    layout: &'l Layout,
    sets: BTreeMap<Key, ActionSet>,
    names: Vec<String>,
    decision: Option<(u32, u16, Flags)>,
    open: Option<Key>,
    damaged: u64,
}

impl<'l> Assembly<'l> {
    fn new(layout: &'l Layout, names: &[String]) -> Self {
        Self { layout, sets: BTreeMap::new(), names: names.to_vec(), decision: None, open: None, damaged: 0 }
    }

    /// Takes a frame of the node that came while `tick` was the last tick of round `round`.
    fn take(&mut self, frame: &Frame, time_us: u64, round: u32, tick: u32) {
        let profile = self.layout.profile();
        let tick_of = |seq: u16| tick.wrapping_add_signed(i32::from(profile.ahead(seq, profile.seq(tick))));
        match self.layout.decision(frame) {
            Ok(d) => {
                self.decision = Some((tick_of(d.header.seq), d.header.latent, d.header.flags));
                return;
            }
            Err(FrameError::Foreign) => {}
            Err(_) => self.damaged += 1,
        }
        match self.layout.action_part(frame) {
            Ok((header, part)) => {
                let tick = tick_of(header.seq);
                if part.part == 0 || self.open.is_none_or(|(r, t, _)| (r, t) != (round, tick)) {
                    let nth = (0..=u32::MAX).find(|&n| !self.sets.contains_key(&(round, tick, n))).unwrap_or(0);
                    let said = self.decision.take().filter(|(t, ..)| *t == tick);
                    let (latent, flags) = said.map_or((header.latent, header.flags), |(_, l, f)| (l, f));
                    let set = ActionSet {
                        time_us,
                        latent: latent_value(latent),
                        flags: flag_names(flags),
                        action: self.names.iter().map(|n| (n.clone(), Value::Null)).collect(),
                        bits: vec![None; self.names.len()],
                    };
                    self.open = Some((round, tick, nth));
                    self.sets.insert((round, tick, nth), set);
                }
                let Some(set) = self.open.and_then(|key| self.sets.get_mut(&key)) else { return };
                for (i, &value) in part.values.iter().enumerate() {
                    let index = part.first + i;
                    if let (Some(slot), Some(name)) = (set.bits.get_mut(index), self.names.get(index)) {
                        *slot = Some(value.to_bits());
                        set.action.insert(name.clone(), number(value));
                    }
                }
            }
            Err(FrameError::Foreign) => {}
            Err(_) => self.damaged += 1,
        }
    }
}

/// What differs between two sets; `late` is the board's.
fn difference(names: &[String], recorded: &ActionSet, replayed: &ActionSet) -> Option<String> {
    let said = |set: &ActionSet| set.flags.iter().copied().filter(|f| *f != "late").collect::<Vec<_>>();
    if recorded.latent != replayed.latent {
        return Some("latent".to_owned());
    }
    if said(recorded) != said(replayed) {
        return Some("flags".to_owned());
    }
    let value = recorded.bits.iter().zip(&replayed.bits).position(|(a, b)| a != b)?;
    Some(format!("action {}", names.get(value).map_or("", String::as_str)))
}

/// Replays the frames of a trace through the policy in `image` (4-byte aligned).
///
/// # Errors
/// [`SimError::Policy`] and [`SimError::Layout`] for a policy that cannot run, [`SimError::Replay`] where the trace
/// holds nothing to compare.
pub fn replay(image: &[u8], records: &[Record], options: &ReplayOptions) -> Result<Replay, SimError> {
    let policy = Policy::load(image).map_err(SimError::Policy)?;
    let node_id = options.node.unwrap_or(NodeId::DEFAULT);
    let frames = frames_of(records, options.interface.as_deref())?;
    let profile = options
        .profile
        .or_else(|| profile_of(frames.iter().map(|(_, f)| f)))
        .ok_or_else(|| nothing("it holds no observation frame (identifiers 180 to 1FF)".to_owned()))?;
    let layout = Layout::of_policy(&policy, profile, node_id)
        .map_err(|source| SimError::Layout { profile: profile.name(), source })?;
    let names: Vec<String> = policy.action_signals().map(|s| s.name.to_owned()).collect();
    let mut memory = vec![0; policy.spec().scratch_words];
    let config = NodeConfig { node: node_id, profile, time: TimeSource::Tick, ..NodeConfig::default() };
    let mut node = ControlNode::new(config, Tape::default(), image, &mut memory);
    settle(&mut node, State::Ready)?;

    let assumed_run = !is_started(&frames, &layout, node_id);
    let first_tick = frames.iter().position(|(_, f)| Tick::parse(f).is_some());
    let skip = if assumed_run { first_tick.unwrap_or(frames.len()) } else { 0 };
    if assumed_run {
        node.link_mut().to_node.push_back(Mode { command: ModeCommand::Run, node: node_id.get() }.frame());
        settle(&mut node, State::Run)?;
    }
    node.link_mut().from_node.clear();

    let (mut recorded, mut replayed) = (Assembly::new(&layout, &names), Assembly::new(&layout, &names));
    let (mut round, mut tick, mut ticks, mut given) = (0, None, 0, 0);
    for (time_us, frame) in frames.iter().skip(skip) {
        let (time_us, from_node) = (*time_us, is_from(frame, node_id));
        if let Some(next) = Tick::parse(frame) {
            // A plant that was started again counts from zero.
            round += u32::from(tick.is_some_and(|t| next.tick < t));
            tick = Some(next.tick);
            ticks += 1;
        }
        if from_node {
            recorded.take(frame, time_us, round, tick.unwrap_or(0));
            continue;
        }
        given += 1;
        node.link_mut().to_node.push_back(*frame);
        rest(&mut node)?;
        for said in std::mem::take(&mut node.link_mut().from_node) {
            replayed.take(&said, time_us, round, tick.unwrap_or(0));
        }
    }
    if recorded.sets.is_empty() {
        let why = match recorded.damaged {
            0 => format!(
                "it holds no action set of node {} (identifier {:X})",
                node_id.get(),
                0x100 + u16::from(node_id.get())
            ),
            n => format!(
                "none of the {n} action frames of node {} has the CRC of this policy's interface {:016x}",
                node_id.get(),
                policy.interface_hash()
            ),
        };
        return Err(nothing(why));
    }
    let last = (round, tick.unwrap_or(0));
    Ok(compare(recorded, replayed, &names, last, |compared, differing, damaged, first| Replay {
        version: REPLAY_VERSION,
        same: differing == 0,
        profile: profile.name(),
        node: node_id.get(),
        frames: given,
        ticks,
        compared,
        differing,
        damaged,
        assumed_run,
        first,
    }))
}

fn compare(
    mut recorded: Assembly,
    replayed: Assembly,
    names: &[String],
    last: (u32, u32),
    result: impl FnOnce(u64, u64, u64, Option<Difference>) -> Replay,
) -> Replay {
    let damaged = recorded.damaged;
    let (mut compared, mut differing, mut first) = (0, 0, None);
    let mut both: BTreeMap<Key, (Option<ActionSet>, Option<ActionSet>)> = BTreeMap::new();
    for (key, set) in replayed.sets {
        both.insert(key, (recorded.sets.remove(&key), Some(set)));
    }
    for (key, set) in recorded.sets {
        both.insert(key, (Some(set), None));
    }
    for ((round, tick, _), (a, b)) in both {
        let what = match (&a, &b) {
            (Some(a), Some(b)) => difference(names, a, b),
            (Some(_), None) => Some("the replay sends no action set".to_owned()),
            // The answer to the last tick may have come after the end of the recording.
            (None, _) if (round, tick) == last => continue,
            (None, _) => Some("the trace holds no action set".to_owned()),
        };
        compared += 1;
        if let Some(what) = what {
            differing += 1;
            first.get_or_insert(Difference { tick, what, recorded: a, replayed: b });
        }
    }
    result(compared, differing, damaged, first)
}

fn nothing(reason: String) -> SimError {
    SimError::Replay { reason }
}

/// The frames of the bus that was asked for, or of the only one.
fn frames_of(records: &[Record], interface: Option<&str>) -> Result<Vec<(u64, Frame)>, SimError> {
    let mut names: Vec<&str> = records.iter().map(|r| r.interface.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    let interface = match interface {
        Some(name) if !names.contains(&name) => {
            return Err(nothing(format!("it holds no frame of `{name}`; it has {}", names.join(", "))));
        }
        Some(name) => name,
        None if names.len() > 1 => {
            return Err(nothing(format!(
                "it holds {} buses ({}); choose one with --interface",
                names.len(),
                names.join(", ")
            )));
        }
        None => names.first().copied().unwrap_or(""),
    };
    let mine = records.iter().filter(|r| r.interface == interface);
    Ok(mine.filter_map(|r| r.frame.map(|f| (r.time_us, f))).collect())
}

/// True for what the node itself sends.
fn is_from(frame: &Frame, node: NodeId) -> bool {
    frame.standard_id().and_then(address).is_some_and(|to| {
        let sends = matches!(
            to.message.function,
            Function::Action | Function::Decision | Function::Reply | Function::Heartbeat
        );
        sends && to.node == node.get()
    })
}

/// The trace holds the RUN request before the first action that is not the safe one.
fn is_started(frames: &[(u64, Frame)], layout: &Layout, node: NodeId) -> bool {
    for (_, frame) in frames {
        if Mode::parse(frame).is_some_and(|m| m.command == ModeCommand::Run && concerns(m.node, node)) {
            return true;
        }
        let flags = layout.decision(frame).map(|d| d.header.flags).or_else(|_| match layout.profile() {
            Profile::FdF32 => layout.action_part(frame).map(|(h, _)| h.flags),
            Profile::ClassicI16 => Err(FrameError::Foreign),
        });
        if flags.is_ok_and(|f| !f.contains(Flags::SAFE)) {
            return false;
        }
    }
    true
}

fn rest(node: &mut ControlNode<'_, Tape>) -> Result<State, SimError> {
    for _ in 0..POLLS {
        let status = node.poll(0);
        if !status.busy {
            return Ok(status.state);
        }
    }
    Err(SimError::Restless { target: "replay".to_owned(), now_us: 0, polls: POLLS })
}

fn settle(node: &mut ControlNode<'_, Tape>, expected: State) -> Result<(), SimError> {
    let state = rest(node)?;
    if state == expected {
        return Ok(());
    }
    let fault = node.poll(0).fault;
    Err(SimError::Node {
        expected: expected.name(),
        state: state.name().to_owned(),
        fault: fault.name(),
        meaning: fault.meaning(),
        next: "export the policy again with this version of the programs",
    })
}
