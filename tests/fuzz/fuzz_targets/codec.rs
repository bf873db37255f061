//! Any frame against any layout: read or refused without panic; what is read is written back as it was, and what is
//! written is read as it was.
#![no_main]

use gadm_fuzz::Source;
use gadm_node::codec::{ActionHeader, Decision, Flags, FrameError, Layout, Profile};
use gadm_node::frame::{extended, standard};
use gadm_node::protocol::{MAX_ACTIONS, MAX_OBSERVATIONS, NO_LATENT};
use gadm_node::service::{Estop, Heartbeat, HostHeartbeat, Mode, Reply, Request, Tick};
use gadm_node::{Frame, NodeId};
use gadm_runtime::ActionHead;
use libfuzzer_sys::fuzz_target;

fn layout(source: &mut Source) -> Option<Layout> {
    let profile = Profile::ALL[source.between(0, 1)];
    let node = NodeId::new(source.byte())?;
    let hash = u64::from(source.byte()) << 32 | u64::from(source.byte());
    let wide = source.byte() & 7 == 0;
    let observations = source.between(1, if wide { MAX_OBSERVATIONS } else { 40 });
    let actions = source.between(1, if wide { MAX_ACTIONS } else { 20 });
    let (lo, hi) = (source.float(), source.float());
    let kind = source.byte();
    let heads = (0..actions).map(|i| match (kind as usize + i) % 3 {
        0 => ActionHead::Continuous { lo: -1.0, hi: 2.0 },
        1 => ActionHead::Discrete { n: 5 },
        _ => ActionHead::Binary,
    });
    Layout::new(profile, node, hash, (0..observations).map(|_| (lo, hi)), heads).ok()
}

fn frame(source: &mut Source) -> Frame {
    let id = u32::from(source.byte()) << 8 | u32::from(source.byte());
    let (kind, len) = (source.byte(), usize::from(source.byte() % 65));
    let data: Vec<u8> = (0..len).map(|_| source.byte()).collect();
    let frame = match kind % 5 {
        0 => Frame::classic(standard(id as u16 & 0x7FF), &data[..len.min(8)]),
        1 => Frame::remote(standard(id as u16 & 0x7FF), len.min(8)),
        2 => Frame::fd(extended(id), &data, true),
        _ => Frame::fd(standard(id as u16 & 0x7FF), &data, kind & 8 == 0),
    };
    frame.expect("lengths are within the bounds of their kinds")
}

fuzz_target!(|data: &[u8]| {
    let mut source = Source(data);
    let Some(layout) = layout(&mut source) else { return };
    let seq = u16::from(source.byte()) & layout.profile().seq_mask();
    let values: Vec<f32> = (0..layout.obs_dim()).map(|_| source.float()).collect();
    for part in 0..layout.observation_parts() {
        let written = layout.observation_frame(part, seq, &values).expect("a part of this layout");
        let read = layout.observation_part(&written).expect("written a moment ago");
        assert_eq!((read.seq, read.part), (seq, part));
        if layout.profile() == Profile::FdF32 {
            for (a, b) in read.values.iter().zip(&values[read.first..]) {
                assert!(a.to_bits() == b.to_bits() || (!a.is_finite() && !b.is_finite()), "{a} from {b}");
            }
        }
        let mut damaged = written;
        let bits = damaged.payload().len() * 8;
        let bit = usize::from(source.byte()) % bits;
        damaged.payload_mut()[bit / 8] ^= 1 << (bit % 8);
        assert!(matches!(layout.observation_part(&damaged), Err(e) if e != FrameError::Foreign), "one wrong bit passed");
    }
    let header = ActionHeader { seq, latent: u16::from(source.byte()), flags: Flags::from_bits(source.byte()) };
    let action: Vec<f32> = (0..layout.action_dim()).map(|_| source.number()).collect();
    for part in 0..layout.action_parts() {
        let written = layout.action_frame(part, header, &action).expect("a part of this layout");
        let (read, _) = layout.action_part(&written).expect("written a moment ago");
        match layout.profile() {
            Profile::FdF32 => assert_eq!(read, header),
            Profile::ClassicI16 => assert_eq!((read.seq, read.latent), (seq, NO_LATENT)),
        }
    }
    let decision = Decision { header, inference_us: u16::from(source.byte()), allowed: source.byte() };
    if let Some(written) = layout.decision_frame(decision) {
        assert_eq!(layout.decision(&written), Ok(decision));
    }
    while !source.0.is_empty() {
        let any = frame(&mut source);
        let _ = layout.observation_part(&any);
        let _ = layout.action_part(&any);
        let _ = layout.decision(&any);
        if let Some(tick) = Tick::parse(&any) {
            assert_eq!(Tick::parse(&tick.frame()), Some(tick));
        }
        if let Some(mode) = Mode::parse(&any) {
            assert_eq!(Mode::parse(&mode.frame()), Some(mode));
        }
        if let Some(beat) = Heartbeat::parse(&any) {
            assert_eq!(Heartbeat::parse(&beat.frame()), Some(beat));
        }
        if let Some(beat) = HostHeartbeat::parse(&any) {
            assert_eq!(HostHeartbeat::parse(&beat.frame()), Some(beat));
        }
        if let Some(request) = Request::parse(&any) {
            assert_eq!(Request::parse(&request.frame()), Some(request));
        }
        if let Some(reply) = Reply::parse(&any) {
            assert_eq!(Reply::parse(&reply.frame()), Some(reply));
        }
        let _ = Estop::parse(&any);
    }
});
