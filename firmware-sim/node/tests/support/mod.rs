//! A small policy and a node on a test bus.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::unused_self,
    reason = "shared by several test binaries, each uses a part"
)]

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use gadm_node::codec::{ActionHeader, Layout};
use gadm_node::service::{Estop, Heartbeat, HostHeartbeat, Mode, ModeCommand, Tick};
use gadm_node::{
    ControlNode, Fault, Flags, Frame, Link, LinkError, NodeConfig, NodeId, NodeStatus, Profile, State, TimeSource,
};
use gadm_runtime::encode::{
    ActionSlot, AlignedImage, Dense, FileOptions, FloatDecoder, FloatModel, Interface, ObservationSlot,
    ProvenanceOwned, QuantiseOptions, quantise, write_int8,
};
use gadm_runtime::{ActionHead, Policy};

/// Control period of the test policy.
pub const T: u64 = 10_000;
/// Heads of the test policy.
pub const HEADS: [ActionHead; 4] = [
    ActionHead::Discrete { n: 3 },
    ActionHead::Binary,
    ActionHead::Continuous { lo: -2.0, hi: 3.0 },
    ActionHead::Continuous { lo: 0.0, hi: 1.0 },
];
/// Safe action of the test policy.
pub const SAFE: [f32; 4] = [1.0, 0.0, 0.5, 0.25];

/// Five observations in -1..=1, four latents with one constant action each; latent `k` wins where observation `k` is
/// the largest of the first four.
pub fn policy_bytes(period_us: u32) -> Vec<u8> {
    policy_version(period_us, 0, 1.0)
}

/// As [`policy_bytes`], with a sequence number, and another last value in the action of latent 0.
pub fn policy_version(period_us: u32, policy_seq: u32, last: f32) -> Vec<u8> {
    let (obs, latents) = (5, 4);
    let mut weight = vec![0.0; latents * obs];
    for k in 0..latents {
        weight[k * obs + k] = 1.0;
    }
    let observations =
        (0..obs).map(|i| ObservationSlot { name: format!("s{i}"), unit: "rad".into(), lo: -1.0, hi: 1.0 }).collect();
    let actions = HEADS
        .iter()
        .zip(SAFE)
        .enumerate()
        .map(|(i, (&head, safe))| ActionSlot { name: format!("a{i}"), unit: "N".into(), head, safe })
        .collect();
    let model = FloatModel {
        interface: Interface { observations, actions, control_period_us: period_us },
        obs_mean: vec![0.0; obs],
        obs_std: vec![1.0; obs],
        q: vec![Dense { rows: latents, cols: obs, weight, bias: vec![0.0; latents] }],
        confidence: None,
        shared_trunk: false,
        beta: 0.25,
        decoder: FloatDecoder::Table {
            actions: vec![
                vec![0.0, 1.0, -1.0, last],
                vec![1.0, 0.0, 1.0, -1.0],
                vec![2.0, 1.0, 0.3, 0.7],
                vec![0.0, 0.0, -0.2, 0.1],
            ],
        },
        heads: vec![],
        provenance: ProvenanceOwned::default(),
    };
    let corners: Vec<f32> =
        (0..32).flat_map(|i| (0..obs).map(move |b| if i >> b & 1 == 1 { 1.0 } else { -1.0 })).collect();
    let q = quantise(&model, &corners, &QuantiseOptions::default()).unwrap();
    write_int8(&q, &corners[..obs * 4], &FileOptions { policy_seq, ..FileOptions::default() }).unwrap()
}

/// An image that lives as long as the test.
pub fn leak(bytes: &[u8]) -> &'static [u8] {
    Box::leak(Box::new(AlignedImage::new(bytes))).as_bytes()
}

#[derive(Default)]
pub struct Wire {
    pub rx: VecDeque<Frame>,
    pub tx: Vec<Frame>,
    pub off: bool,
    /// A restart brings the bus back at once.
    pub heals: bool,
    pub restarts: usize,
}

#[derive(Clone, Default)]
pub struct TestLink(pub Rc<RefCell<Wire>>);

impl Link for TestLink {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        let mut wire = self.0.borrow_mut();
        if wire.off {
            wire.rx.clear(); // a controller that is off hears nothing
            return Err(LinkError::BusOff);
        }
        let next = wire.rx.pop_front();
        *frame = next.unwrap_or(Frame::empty());
        Ok(next.is_some())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        let mut wire = self.0.borrow_mut();
        if wire.off {
            return Err(LinkError::BusOff);
        }
        wire.tx.push(*frame);
        Ok(())
    }

    fn restart(&mut self) -> Result<(), LinkError> {
        let mut wire = self.0.borrow_mut();
        wire.restarts += 1;
        wire.off &= !wire.heals;
        Ok(())
    }
}

/// One action set that the node sent.
#[derive(Clone, Debug, PartialEq)]
pub struct Act {
    pub header: ActionHeader,
    pub values: Vec<f32>,
}

impl Act {
    pub fn has(&self, flag: Flags) -> bool {
        self.header.flags.contains(flag)
    }
}

pub struct Rig {
    pub node: ControlNode<'static, TestLink>,
    pub wire: Rc<RefCell<Wire>>,
    pub layout: Layout,
    pub profile: Profile,
    pub tick: u32,
    pub now: u64,
    pub status: NodeStatus,
    /// All heartbeats and action sets so far.
    pub beats: Vec<Heartbeat>,
    pub acts: Vec<Act>,
}

pub const GOOD: [f32; 5] = [0.9, 0.1, -0.3, 0.2, 0.0];

impl Rig {
    pub fn new(profile: Profile, time: TimeSource) -> Self {
        Self::with(NodeConfig { profile, time, ..NodeConfig::default() }, leak(&policy_bytes(T as u32)), 4096)
    }

    pub fn local() -> Self {
        Self::new(Profile::FdF32, TimeSource::Local)
    }

    /// A node that was not polled yet.
    pub fn with(config: NodeConfig, image: &'static [u8], scratch_words: usize) -> Self {
        let link = TestLink::default();
        let wire = Rc::clone(&link.0);
        let good = leak(&policy_bytes(T as u32));
        let policy = Policy::load(good).unwrap();
        let layout = Layout::new(
            config.profile,
            config.node,
            policy.interface_hash(),
            policy.observation_signals().map(|s| (s.lo, s.hi)),
            policy.action_signals().map(|s| s.head),
        )
        .unwrap();
        let node = ControlNode::new(config, link, image, Box::leak(vec![0; scratch_words].into_boxed_slice()));
        let status = NodeStatus {
            state: State::Boot,
            fault: Fault::None,
            latent: 0,
            busy: true,
            counters: gadm_node::Counters::default(),
        };
        let (beats, acts) = (vec![], vec![]);
        Self { node, wire, layout, profile: config.profile, tick: 0, now: 0, status, beats, acts }
    }

    /// Polls once at the rig's time and reads what the node sent.
    pub fn poll(&mut self) {
        self.status = self.node.poll(self.now);
        let sent = std::mem::take(&mut self.wire.borrow_mut().tx);
        let mut set: Option<Act> = None;
        let mut decision = None;
        for frame in sent {
            if let Some(beat) = Heartbeat::parse(&frame) {
                self.beats.push(beat);
            } else if let Ok(d) = self.layout.decision(&frame) {
                decision = Some(d.header);
            } else if let Ok((header, part)) = self.layout.action_part(&frame) {
                let act = set.get_or_insert(Act { header: decision.take().unwrap_or(header), values: vec![] });
                assert_eq!(act.values.len(), part.first, "parts come in order");
                act.values.extend_from_slice(&part.values);
                if act.values.len() == HEADS.len() {
                    self.acts.extend(set.take());
                }
            }
        }
        assert_eq!(set, None, "the node sends whole sets");
    }

    pub fn settle(&mut self) {
        for _ in 0..20 {
            self.poll();
            if !self.status.busy {
                return;
            }
        }
        panic!("the node does not come to rest: {:?}", self.status);
    }

    pub fn push(&self, frame: Frame) {
        self.wire.borrow_mut().rx.push_back(frame);
    }

    pub fn mode(&mut self, command: ModeCommand) {
        self.push(Mode { command, node: 1 }.frame());
        self.poll();
    }

    pub fn estop(&mut self) {
        self.push(Estop { node: 1, reason: 5 }.frame());
        self.poll();
    }

    pub fn host_beat(&self) {
        self.push(HostHeartbeat { seq: 0 }.frame());
    }

    pub fn push_tick(&self, tick: u32) {
        self.push(Tick { tick, time_us: self.now as u32 }.frame());
    }

    pub fn observation(&self, tick: u32, obs: &[f32]) -> Vec<Frame> {
        let seq = self.profile.seq(tick);
        (0..self.layout.observation_parts()).map(|p| self.layout.observation_frame(p, seq, obs).unwrap()).collect()
    }

    /// A whole control period; `None` leaves the observation out.
    pub fn step(&mut self, obs: Option<&[f32]>) {
        self.now += T;
        self.tick = self.tick.wrapping_add(1);
        self.push_tick(self.tick);
        for frame in obs.map_or(vec![], |o| self.observation(self.tick, o)) {
            self.push(frame);
        }
        self.poll();
    }

    pub fn steps(&mut self, n: usize) {
        for _ in 0..n {
            self.step(Some(&GOOD));
        }
    }

    pub fn ready(mut self) -> Self {
        self.settle();
        assert_eq!(self.status.state, State::Ready);
        self
    }

    /// In control for ten periods.
    pub fn running(self) -> Self {
        let mut rig = self.ready();
        rig.mode(ModeCommand::Run);
        rig.steps(10);
        assert_eq!((rig.status.state, rig.status.fault), (State::Run, Fault::None));
        rig
    }

    /// In SAFE for want of observations.
    pub fn safe(self) -> Self {
        let mut rig = self.running();
        for _ in 0..3 {
            rig.step(None);
        }
        assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::ObservationLost));
        rig
    }

    /// In FAULT after the fourth bus-off.
    pub fn faulty(self) -> Self {
        let mut rig = self.safe();
        rig.wire.borrow_mut().heals = true;
        for _ in 0..4 {
            rig.wire.borrow_mut().off = true;
            rig.poll();
            rig.poll();
        }
        assert_eq!((rig.status.state, rig.status.fault), (State::Fault, Fault::BusOffRepeated));
        rig.wire.borrow_mut().off = false;
        rig.poll();
        rig
    }

    pub fn last(&self) -> &Act {
        self.acts.last().unwrap()
    }

    /// The action that the policy computes.
    pub fn expected(&self, obs: &[f32]) -> (u16, Vec<f32>) {
        let policy = Policy::load(leak(&policy_bytes(T as u32))).unwrap();
        let mut memory = vec![0; policy.spec().scratch_words];
        let mut action = vec![0.0; HEADS.len()];
        let decision = policy.act(obs, &mut gadm_runtime::Scratch::new(&mut memory), &mut action).unwrap();
        (decision.latent, action)
    }
}

pub fn node_id() -> NodeId {
    NodeId::DEFAULT
}
