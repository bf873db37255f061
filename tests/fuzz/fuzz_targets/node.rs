//! Any frames, times and bus errors against a node: it never panics, never sends an action beyond its heads, never acts
//! out of control, and always comes to rest.
#![no_main]

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::OnceLock;

use gadm_fuzz::{Source, policies};
use gadm_node::codec::{Flags, Layout};
use gadm_node::frame::{extended, standard};
use gadm_node::service::{Estop, HostHeartbeat, Mode, ModeCommand, Tick};
use gadm_node::{
    ControlNode, Frame, Link, LinkError, NodeConfig, NodeStatus, Profile, State, TimeSource,
};
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{ActionHead, Policy};
use libfuzzer_sys::fuzz_target;

static IMAGES: OnceLock<Vec<AlignedImage>> = OnceLock::new();

#[derive(Default)]
struct Wire {
    rx: VecDeque<Frame>,
    tx: Vec<Frame>,
    error: Option<LinkError>,
}

#[derive(Clone, Default)]
struct Bus(Rc<RefCell<Wire>>);

impl Link for Bus {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        let mut wire = self.0.borrow_mut();
        if let Some(error) = wire.error {
            wire.rx.clear();
            return Err(error);
        }
        let next = wire.rx.pop_front();
        *frame = next.unwrap_or(Frame::empty());
        Ok(next.is_some())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        let mut wire = self.0.borrow_mut();
        if let Some(error) = wire.error {
            return Err(error);
        }
        wire.tx.push(*frame);
        Ok(())
    }
}

fn legal(value: f32, head: ActionHead) -> bool {
    match head {
        // The last step of an i16 may lie a rounding error beyond the bound.
        ActionHead::Continuous { lo, hi } => value >= lo - (hi - lo) * 1e-5 && value <= hi + (hi - lo) * 1e-5,
        ActionHead::Discrete { n } => value.fract() == 0.0 && value >= 0.0 && value < f32::from(n),
        ActionHead::Binary => value == 0.0 || value == 1.0,
    }
}

/// Polls until the node waits for frames.
fn settle(node: &mut ControlNode<'_, Bus>, now_us: u64) -> NodeStatus {
    for _ in 0..2000 {
        let status = node.poll(now_us);
        if !status.busy {
            return status;
        }
    }
    panic!("the node does not come to rest");
}

fuzz_target!(|data: &[u8]| {
    let images = IMAGES.get_or_init(policies);
    let mut source = Source(data);
    let image = &images[source.between(0, images.len() - 1)];
    let policy = Policy::load(image).expect("written a moment ago");
    let profile = Profile::ALL[source.between(0, 1)];
    let time = if source.byte() & 1 == 0 { TimeSource::Tick } else { TimeSource::Local };
    let config = NodeConfig { profile, time, ..NodeConfig::default() };
    let ranges = policy.observation_signals().map(|s| (s.lo, s.hi));
    let heads: Vec<ActionHead> = policy.action_signals().map(|s| s.head).collect();
    let layout = Layout::new(profile, config.node, policy.interface_hash(), ranges, heads.iter().copied());
    let Ok(layout) = layout else { return };
    let mut memory = vec![0; policy.spec().scratch_words];
    let bus = Bus::default();
    let mut node = ControlNode::new(config, bus.clone(), image, &mut memory);
    let period = u64::from(policy.spec().control_period_us);
    let (mut now, mut tick) = (0_u64, 0_u32);
    let mut before = settle(&mut node, now);
    while !source.0.is_empty() {
        match source.byte() % 12 {
            // A whole period, with any observation.
            0..=3 => {
                (now, tick) = (now + period, tick.wrapping_add(1));
                bus.0.borrow_mut().rx.push_back(Tick { tick, time_us: now as u32 }.frame());
                let obs: Vec<f32> = (0..layout.obs_dim()).map(|_| source.number()).collect();
                for part in 0..layout.observation_parts() {
                    bus.0.borrow_mut().rx.extend(layout.observation_frame(part, profile.seq(tick), &obs));
                }
            }
            4 => {
                (now, tick) = (now + period, tick.wrapping_add(1));
                bus.0.borrow_mut().rx.push_back(Tick { tick, time_us: now as u32 }.frame());
            }
            5 => now += u64::from(source.byte()) * 5000,
            6 => bus.0.borrow_mut().rx.push_back(Mode { command: ModeCommand::Run, node: 0 }.frame()),
            7 => {
                let command = [ModeCommand::Stop, ModeCommand::Reset][source.between(0, 1)];
                bus.0.borrow_mut().rx.push_back(Mode { command, node: 0 }.frame());
            }
            8 => bus.0.borrow_mut().rx.push_back(HostHeartbeat { seq: source.byte() }.frame()),
            9 => {
                let errors = [LinkError::BusOff, LinkError::Full, LinkError::Unsupported, LinkError::Other(3)];
                let error = errors.get(source.between(0, 7)).copied();
                bus.0.borrow_mut().error = error;
            }
            10 => {
                let id = u16::from(source.byte()) << 8 | u16::from(source.byte());
                let (kind, len) = (source.byte(), usize::from(source.byte() % 65));
                let data: Vec<u8> = (0..len).map(|_| source.byte()).collect();
                let frame = match kind % 4 {
                    0 => Frame::classic(standard(id & 0x7FF), &data[..len.min(8)]),
                    1 => Frame::remote(standard(id & 0x7FF), len.min(8)),
                    2 => Frame::fd(extended(u32::from(id)), &data, true),
                    _ => Frame::fd(standard(id & 0x7FF), &data, true),
                };
                bus.0.borrow_mut().rx.extend(frame);
            }
            _ => {
                if source.byte() == 0 {
                    bus.0.borrow_mut().rx.extend(Some(Estop { node: 0, reason: 1 }.frame()));
                }
            }
        }
        let after = settle(&mut node, now);
        let sent = std::mem::take(&mut bus.0.borrow_mut().tx);
        let idle = |s: State| matches!(s, State::Boot | State::SelfTest | State::NoPolicy | State::Ready);
        for frame in &sent {
            let Ok((header, part)) = layout.action_part(frame) else { continue };
            for (value, head) in part.values.iter().zip(&heads[part.first..]) {
                assert!(legal(*value, *head), "{value} is not legal for {head:?}");
            }
            assert!(!(idle(before.state) && idle(after.state)), "an action in {:?}", after.state);
            if profile == Profile::FdF32 && before.state == State::Safe && after.state == State::Safe {
                assert!(header.flags.contains(Flags::SAFE), "an unsafe action in SAFE");
            }
        }
        before = after;
    }
});
