use std::vec::Vec as StdVec;

use gadm_runtime::space::ActionHead;
use proptest::prelude::*;

use super::frames::{CRC8, CRC32};
use super::scale::{Scale, round_i16};
use super::*;
use crate::frame::{Frame, standard};
use crate::protocol::*;

const HASH: u64 = 0x1122_3344_5566_7788;

fn node() -> NodeId {
    NodeId::new(5).unwrap()
}

fn layout(profile: Profile, obs: usize, act: usize) -> Layout {
    let heads = (0..act).map(|_| ActionHead::Continuous { lo: -2.0, hi: 2.0 });
    Layout::new(profile, node(), HASH, (0..obs).map(|_| (-10.0, 10.0)), heads).unwrap()
}

#[test]
fn crc_parameters_are_the_catalogue_ones() {
    assert_eq!(CRC32.checksum(b"123456789"), 0xCBF4_3926);
    assert_eq!(CRC8.checksum(b"123456789"), 0xDF);
}

#[test]
fn fd_observation_literal_bytes() {
    let frame = layout(Profile::FdF32, 2, 1).observation_frame(0, 0x0102, &[1.0, -2.0]).unwrap();
    assert_eq!(frame.standard_id(), Some(0x180));
    assert_eq!(frame.payload().len(), 16);
    assert_eq!(&frame.payload()[..12], [2, 1, 0, 3, 0, 0, 0x80, 0x3F, 0, 0, 0, 0xC0]);
    let mut message = StdVec::from([0x80, 0x01, 0x88, 0x77, 0x66, 0x55]);
    message.extend_from_slice(&frame.payload()[..12]);
    assert_eq!(&frame.payload()[12..], CRC32.checksum(&message).to_le_bytes());
}

#[test]
fn classic_observation_literal_bytes() {
    let frame = layout(Profile::ClassicI16, 4, 1).observation_frame(1, 0x0102, &[0.0, 0.0, 0.0, 10.0]).unwrap();
    assert_eq!(frame.standard_id(), Some(0x181));
    assert_eq!(&frame.payload()[..7], [2, 0xFF, 0x7F, 0, 0, 0, 0]);
    assert_eq!(frame.payload()[7], CRC8.checksum(&[0x81, 0x01, 0x88, 0x77, 0x66, 0x55, 2, 0xFF, 0x7F, 0, 0, 0, 0]));
}

#[test]
fn fd_action_literal_bytes() {
    let header = ActionHeader { seq: 0x0102, latent: 0x345, flags: Flags::HELD.with(Flags::SAFE) };
    let frame = layout(Profile::FdF32, 2, 1).action_frame(0, header, &[1.0]).unwrap();
    // 0x345 in bits 0 to 10, safe (bit 0) and held (bit 3) above: one number a DBC can cut in two.
    assert_eq!(&frame.payload()[..8], [2, 1, 0x45, 0x03 | 0b01001 << 3, 0, 0, 0x80, 0x3F]);
}

#[test]
fn i16_rounds_to_nearest_saturates_and_keeps_invalid_apart() {
    let s = Scale::range(-32767.0, 32767.0).unwrap();
    for (value, q) in [(0.49, 0), (0.5, 1), (-0.5, -1), (1.49, 1), (1.51, 2), (-7.6, -8), (1e9, 32767), (-1e9, -32767)]
    {
        assert_eq!(s.quantise(value), q, "{value}");
    }
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert_eq!(s.quantise(value), INVALID_I16);
    }
    assert!(s.value(INVALID_I16).is_nan());
    assert_eq!(round_i16(0.499_999_97), 0, "the addition trick would give 1");
}

#[test]
fn invalid_values_are_flagged_and_come_back_as_nan() {
    for profile in Profile::ALL {
        let l = layout(profile, 2, 1);
        let frame = l.observation_frame(0, 9, &[f32::INFINITY, 3.0]).unwrap();
        let part = l.observation_part(&frame).unwrap();
        assert!(part.values[0].is_nan() && (part.values[1] - 3.0).abs() < 1e-3);
        if profile == Profile::FdF32 {
            assert_eq!(frame.payload()[3], 0b111);
        }
    }
}

#[test]
fn long_sets_take_several_identifiers() {
    let l = layout(Profile::ClassicI16, 376, 17);
    assert_eq!((l.observation_parts(), l.action_parts()), (126, 6));
    let l = layout(Profile::FdF32, 376, 17);
    assert_eq!((l.observation_parts(), l.action_parts()), (27, 2));
    let header = ActionHeader { seq: 3, latent: 300, flags: Flags::HELD };
    let action: StdVec<f32> = (0..17).map(|i| i as f32 * 0.1).collect();
    let frame = l.action_frame(1, header, &action).unwrap();
    assert_eq!(frame.standard_id(), Some(0x205));
    let (h, part) = l.action_part(&frame).unwrap();
    assert_eq!((h, part.first, &part.values[..]), (header, 14, &action[14..]));
    assert!(l.action_frame(2, header, &action).is_none());
    assert!(l.action_frame(0, header, &action[1..]).is_none());
}

#[test]
fn what_does_not_fit_is_refused() {
    let heads = || core::iter::repeat(ActionHead::Binary);
    let too_long = Layout::new(Profile::FdF32, node(), 0, core::iter::repeat_n((0.0, 1.0), 385), heads().take(1));
    assert_eq!(too_long.unwrap_err(), LayoutError::Observations { found: 385, limit: 384 });
    let too_wide = Layout::new(Profile::FdF32, node(), 0, core::iter::repeat_n((0.0, 1.0), 3), heads().take(46));
    assert_eq!(too_wide.unwrap_err(), LayoutError::Actions { found: 46, limit: 45 });
    for (lo, hi) in [(1.0, 1.0), (f32::NEG_INFINITY, 1.0), (0.0, f32::NAN), (2.0, 1.0)] {
        let flat = |profile| Layout::new(profile, node(), 0, [(0.0, 1.0), (lo, hi)].into_iter(), heads().take(1));
        assert_eq!(flat(Profile::ClassicI16).unwrap_err(), LayoutError::ObservationRange { index: 1 });
        assert!(flat(Profile::FdF32).is_ok(), "exact values need no range");
    }
}

#[test]
fn wrong_kind_length_node_and_header_are_told_apart() {
    let fd = layout(Profile::FdF32, 2, 1);
    let classic = layout(Profile::ClassicI16, 2, 1);
    let fd_frame = fd.observation_frame(0, 1, &[0.0; 2]).unwrap();
    let classic_frame = classic.observation_frame(0, 1, &[0.0; 2]).unwrap();
    assert_eq!(fd.observation_part(&classic_frame), Err(FrameError::Kind));
    assert_eq!(classic.observation_part(&fd_frame), Err(FrameError::Kind));
    let short = Frame::fd(standard(0x180), &[0; 12], true).unwrap();
    assert_eq!(fd.observation_part(&short), Err(FrameError::Length { expected: 16, found: 12 }));
    let other_part = Frame::fd(standard(0x181), fd_frame.payload(), true).unwrap();
    assert_eq!(fd.observation_part(&other_part), Err(FrameError::Foreign));
    let remote = Frame::remote(standard(0x180), 8).unwrap();
    assert_eq!(classic.observation_part(&remote), Err(FrameError::Kind));
    let mut wrong = StdVec::from(&fd_frame.payload()[..12]);
    wrong[2] = 9;
    let crc = fd.crc32(0x180, &wrong);
    wrong.extend_from_slice(&crc.to_le_bytes());
    assert_eq!(fd.observation_part(&Frame::fd(standard(0x180), &wrong, true).unwrap()), Err(FrameError::Header));
}

#[test]
fn a_frame_of_another_interface_fails_its_crc() {
    for profile in Profile::ALL {
        let ours = layout(profile, 3, 2);
        let heads = (0..2).map(|_| ActionHead::Continuous { lo: -2.0, hi: 2.0 });
        let theirs = Layout::new(profile, node(), HASH + 1, (0..3).map(|_| (-10.0, 10.0)), heads).unwrap();
        let frame = theirs.observation_frame(0, 1, &[1.0, 2.0, 3.0]).unwrap();
        assert_eq!(ours.observation_part(&frame), Err(FrameError::Crc));
    }
}

#[test]
fn sequence_distance_takes_the_short_way_round() {
    assert_eq!(Profile::ClassicI16.ahead(2, 254), 4);
    assert_eq!(Profile::ClassicI16.ahead(254, 2), -4);
    assert_eq!(Profile::FdF32.ahead(0, 0xFFFF), 1);
    assert_eq!(Profile::ClassicI16.seq(0x1FF), 0xFF);
    assert_eq!(Profile::FdF32.seq(0x1_0203), 0x0203);
}

proptest! {
    #[test]
    fn fd_round_trip_is_exact(seq: u16, latent in 0_u16..0x800, bits in 0_u8..32,
                              obs in prop::collection::vec(-1e30_f32..1e30, 1..40),
                              act in prop::collection::vec(-2.0_f32..2.0, 1..20)) {
        let l = layout(Profile::FdF32, obs.len(), act.len());
        let mut got = StdVec::new();
        for p in 0..l.observation_parts() {
            let part = l.observation_part(&l.observation_frame(p, seq, &obs).unwrap()).unwrap();
            prop_assert_eq!((part.seq, part.first), (seq, got.len()));
            got.extend_from_slice(&part.values);
        }
        prop_assert_eq!(&got, &obs);
        let header = ActionHeader { seq, latent, flags: Flags::from_bits(bits) };
        let mut got = StdVec::new();
        for p in 0..l.action_parts() {
            let (h, part) = l.action_part(&l.action_frame(p, header, &act).unwrap()).unwrap();
            prop_assert_eq!(h, header);
            got.extend_from_slice(&part.values);
        }
        prop_assert_eq!(got, act);
    }

    #[test]
    fn classic_round_trip_is_within_half_a_step(seq: u16, obs in prop::collection::vec(-12.0_f32..12.0, 1..40)) {
        let l = layout(Profile::ClassicI16, obs.len(), 1);
        let mut got = StdVec::new();
        for p in 0..l.observation_parts() {
            let part = l.observation_part(&l.observation_frame(p, seq, &obs).unwrap()).unwrap();
            prop_assert_eq!(part.seq, seq & 0xFF);
            got.extend_from_slice(&part.values);
        }
        prop_assert_eq!(got.len(), obs.len());
        for (a, b) in got.iter().zip(&obs) {
            let half_step = 10.0 / 32767.0 * 0.5 + 1e-5;
            prop_assert!((a - b.clamp(-10.0, 10.0)).abs() <= half_step, "{} {}", a, b);
        }
    }

    #[test]
    fn types_and_switches_are_exact_in_i16(t in 0_u16..300) {
        let heads = [ActionHead::Discrete { n: 300 }, ActionHead::Binary];
        let l = Layout::new(Profile::ClassicI16, node(), HASH, core::iter::once((0.0, 1.0)), heads.into_iter()).unwrap();
        let header = ActionHeader { seq: 1, latent: 0, flags: Flags::default() };
        let (_, part) = l.action_part(&l.action_frame(0, header, &[f32::from(t), 1.0]).unwrap()).unwrap();
        prop_assert_eq!(&part.values[..], [f32::from(t), 1.0]);
    }

    #[test]
    fn decision_round_trip(seq in 0_u16..256, latent in 0_u16..0x800, bits in 0_u8..32, inference_us: u16, allowed: u8) {
        let header = ActionHeader { seq, latent, flags: Flags::from_bits(bits) };
        let d = Decision { header, inference_us, allowed };
        let l = layout(Profile::ClassicI16, 1, 1);
        prop_assert_eq!(l.decision(&l.decision_frame(d).unwrap()), Ok(d));
        prop_assert!(layout(Profile::FdF32, 1, 1).decision_frame(d).is_none());
    }

    #[test]
    fn one_wrong_bit_never_passes(profile in prop::sample::select(&Profile::ALL[..]), bit: usize,
                                  obs in prop::collection::vec(-9.0_f32..9.0, 3)) {
        let l = layout(profile, 3, 1);
        let mut frame = l.observation_frame(0, 77, &obs).unwrap();
        let bit = bit % (frame.payload().len() * 8);
        frame.payload_mut()[bit / 8] ^= 1 << (bit % 8);
        prop_assert_eq!(l.observation_part(&frame), Err(FrameError::Crc));
    }

    #[test]
    fn any_bytes_are_refused_or_read_without_panic(id in 0_u16..0x800, data in prop::collection::vec(any::<u8>(), 0..=64), fd: bool) {
        for profile in Profile::ALL {
            let l = layout(profile, 11, 3);
            let frame = if fd { Frame::fd(standard(id), &data, true) } else { Frame::classic(standard(id), &data) };
            if let Some(frame) = frame {
                let _ = (l.observation_part(&frame), l.action_part(&frame), l.decision(&frame));
            }
        }
    }
}
