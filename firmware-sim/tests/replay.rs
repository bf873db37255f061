//! A trace through the policy again.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::codec::Layout;
use gadm_node::load::BitRate;
use gadm_node::service::Tick;
use gadm_node::{Frame, NodeId, Profile};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;
use gadm_sim::bus::trace::{Record, format_line, parse_line};
use gadm_sim::replay::{Replay, ReplayOptions, replay};
use gadm_sim::sil::Recorder;
use gadm_sim::{RunOptions, SimError, simulate};
use support::random_policy;

fn policy(id: &str, seed: u64) -> AlignedImage {
    random_policy(gadm_envs::make(id).unwrap().spec(), seed)
}

/// The trace of a run, through its text.
fn recorded(id: &str, image: &[u8], profile: Profile) -> Vec<Record> {
    let recorder = Recorder::default();
    // Twenty action values every 5 ms (hard-move-10) do not fit a classic bus of 500 kbit/s.
    let bit_rate = BitRate { nominal: 1_000_000, ..BitRate::default() };
    let options = RunOptions { episodes: 2, seed: 4, profile, bit_rate, ..RunOptions::new("test") };
    let env = gadm_envs::make(id).unwrap();
    simulate(&options, image, env, Some(Box::new(recorder.clone())), &mut |_| {}).unwrap();
    let line = |(time_us, frame): (u64, Frame)| {
        let mut text = String::new();
        format_line(&mut text, time_us, &frame);
        parse_line(&text).unwrap()
    };
    recorder.frames().into_iter().map(line).collect()
}

fn again(image: &[u8], records: &[Record]) -> Replay {
    replay(image, records, &ReplayOptions::default()).unwrap()
}

fn layout(image: &[u8], profile: Profile) -> Layout {
    Layout::of_policy(&Policy::load(image).unwrap(), profile, NodeId::DEFAULT).unwrap()
}

#[test]
fn a_trace_replays_to_the_same_actions() {
    for profile in Profile::ALL {
        for id in ["moving", "pendulum", "hard-move-10"] {
            let image = policy(id, 11);
            let records = recorded(id, &image, profile);
            let result = again(&image, &records);
            assert!(result.same && result.first.is_none(), "{id}: {:?}", result.first);
            assert_eq!((result.profile, result.differing, result.damaged), (profile.name(), 0, 0));
            assert_eq!(result.compared, result.ticks + 2, "every tick, and the safe action after each episode");
            assert!(!result.assumed_run);
        }
    }
}

#[test]
fn another_policy_of_the_same_interface_differs_at_the_first_tick() {
    let records = recorded("moving", &policy("moving", 11), Profile::FdF32);
    let result = again(&policy("moving", 12), &records);
    assert!(!result.same && result.differing > 0);
    let first = result.first.unwrap();
    assert_eq!(first.tick, 0);
    assert_ne!(first.recorded.unwrap().action, first.replayed.unwrap().action);
}

#[test]
fn one_changed_action_is_found_and_named() {
    for profile in Profile::ALL {
        let image = policy("pendulum", 11);
        let mut records = recorded("pendulum", &image, profile);
        let layout = layout(&image, profile);
        let mut tick = 0;
        let at = records.iter().position(|r| {
            let frame = r.frame.as_ref().unwrap();
            tick = Tick::parse(frame).map_or(tick, |t| t.tick);
            tick == 77 && layout.action_part(frame).is_ok()
        });
        let frame = records[at.unwrap()].frame.as_mut().unwrap();
        let (header, part) = layout.action_part(frame).unwrap();
        let other = if part.values[0] > 0.0 { part.values[0] - 0.5 } else { part.values[0] + 0.5 };
        *frame = layout.action_frame(0, header, &[other]).unwrap();
        let result = again(&image, &records);
        assert_eq!((result.same, result.differing), (false, 1));
        let first = result.first.unwrap();
        assert_eq!((first.tick, first.what.as_str()), (77, "action torque"));
        let (a, b) = (first.recorded.unwrap(), first.replayed.unwrap());
        assert_eq!((a.latent, &a.flags), (b.latent, &b.flags));
        assert_ne!(a.action["torque"], b.action["torque"]);
    }
}

#[test]
fn lost_frames_are_differences() {
    let image = policy("moving", 11);
    let records = recorded("moving", &image, Profile::FdF32);
    let layout = layout(&image, Profile::FdF32);
    let is_action = |r: &Record| layout.action_part(r.frame.as_ref().unwrap()).is_ok();
    // The sixth action set is not in the trace.
    let mut seen = 0;
    let without = |r: &Record| {
        seen += usize::from(is_action(r));
        !(is_action(r) && seen == 6)
    };
    let mut without = without;
    let lost: Vec<_> = records.iter().filter(|r| without(r)).cloned().collect();
    let first = again(&image, &lost).first.unwrap();
    assert_eq!((first.tick, first.what.as_str()), (5, "the trace holds no action set"));
    // The observation of tick 5 is not: the recorded node decided, the replayed one can only hold.
    let mut tick = 0;
    let lost: Vec<_> = records
        .iter()
        .filter(|r| {
            let frame = r.frame.as_ref().unwrap();
            tick = Tick::parse(frame).map_or(tick, |t| t.tick);
            !(tick == 5 && layout.observation_part(frame).is_ok())
        })
        .cloned()
        .collect();
    let first = again(&image, &lost).first.unwrap();
    assert_eq!(first.tick, 5);
    assert_eq!(first.replayed.unwrap().flags, ["held"]);
}

#[test]
fn a_trace_may_begin_and_end_in_the_middle() {
    for profile in Profile::ALL {
        let image = policy("moving", 11);
        let records = recorded("moving", &image, profile);
        let ticks: Vec<_> =
            (0..records.len()).filter(|&i| Tick::parse(records[i].frame.as_ref().unwrap()).is_some()).collect();
        // From inside the set of tick 9, to inside that of tick 30.
        let result = again(&image, &records[ticks[9] + 1..ticks[30] + 2]);
        assert!(result.same && result.assumed_run, "{:?}", result.first);
        assert_eq!(result.ticks, 21);
        assert!((20..=21).contains(&result.compared), "{}", result.compared);
    }
}

#[test]
fn what_cannot_be_replayed_says_why() {
    let image = policy("moving", 11);
    let records = recorded("moving", &image, Profile::FdF32);
    let why = |image: &[u8], records: &[Record], options: &ReplayOptions| match replay(image, records, options) {
        Err(SimError::Replay { reason }) => reason,
        other => panic!("{other:?}"),
    };
    let options = ReplayOptions::default();
    assert!(why(&image, &[], &options).contains("no observation frame"));
    assert!(why(&policy("pendulum", 11), &records, &options).contains("interface"));
    let other = ReplayOptions { node: NodeId::new(2), ..options.clone() };
    assert!(why(&image, &records, &other).contains("node 2"));
    let mut two = records.clone();
    two[3].interface = "can7".to_owned();
    assert!(why(&image, &two, &options).contains("--interface"));
    let chosen = ReplayOptions { interface: Some("can9".to_owned()), ..options };
    assert!(why(&image, &two, &chosen).contains("can7, vcan0"));
}
