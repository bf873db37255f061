//! The chain of equalities: runtime without a bus = node on the bus = what the trace says.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::codec::Layout;
use gadm_node::{Flags, Profile};
use gadm_runtime::Policy;
use gadm_sim::bus::trace::{TraceWriter, format_line, parse_line};
use gadm_sim::sil::{Recorder, policy_layout};
use gadm_sim::{RunOptions, RunResult, simulate};
use support::{DirectStep, direct, random_policy};

fn run(id: &str, image: &[u8], profile: Profile, episodes: u64, seed: u64) -> (RunResult, Recorder) {
    let recorder = Recorder::default();
    // Humanoid is more than a bus at these bit rates can carry; here it is about the numbers.
    let options = RunOptions { episodes, seed, profile, allow_overload: true, ..RunOptions::new("test") };
    let env = gadm_envs::make(id).unwrap();
    let result = simulate(&options, image, env, Some(Box::new(recorder.clone())), &mut |_| {}).unwrap();
    (result, recorder)
}

/// The action sets of a trace, read from its text.
fn actions_of(recorder: &Recorder, layout: &Layout) -> Vec<DirectStep> {
    let mut steps: Vec<DirectStep> = Vec::new();
    let mut decision = None;
    for (time_us, frame) in recorder.frames() {
        let mut line = String::new();
        format_line(&mut line, time_us, &frame);
        let frame = parse_line(&line).unwrap().frame.unwrap();
        if let Ok(d) = layout.decision(&frame) {
            decision = Some(d.header);
        } else if let Ok((header, part)) = layout.action_part(&frame) {
            let header = decision.unwrap_or(header);
            if header.flags.contains(Flags::SAFE) {
                continue; // the last word after STOP
            }
            if part.first == 0 {
                steps.push(DirectStep { latent: header.latent, action: vec![] });
            }
            steps.last_mut().unwrap().action.extend_from_slice(&part.values);
        }
    }
    steps
}

fn equal_in_fd_f32(id: &str, episodes: u64) {
    let mut env = gadm_envs::make(id).unwrap();
    let image = random_policy(env.spec(), 11);
    let (result, recorder) = run(id, &image, Profile::FdF32, episodes, 3);
    let layout = policy_layout(&Policy::load(&image).unwrap(), Profile::FdF32).unwrap();
    let decoded = actions_of(&recorder, &layout);
    let mut steps = Vec::new();
    for episode in 0..episodes {
        let (ret, more) = direct(&image, &mut *env, 3, episode);
        assert_eq!(result.episodes[episode as usize].ret.to_bits(), ret.to_bits(), "{id}, episode {episode}");
        assert_eq!(result.episodes[episode as usize].steps, more.len() as u64);
        steps.extend(more);
    }
    assert_eq!(decoded.len(), steps.len());
    for (i, (a, b)) in decoded.iter().zip(&steps).enumerate() {
        assert_eq!(a.latent, b.latent, "{id}, step {i}");
        let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&a.action), bits(&b.action), "{id}, step {i}");
    }
    let node = result.node.unwrap();
    assert_eq!((u64::from(node.acted), node.held, node.missed, node.crc_errors), (result.steps, 0, 0, 0));
    assert_eq!(u64::from(node.safe), episodes, "the safe action once after each episode");
    assert_eq!(result.latent_counts.iter().sum::<u64>(), result.steps);
}

#[test]
fn moving_is_equal() {
    equal_in_fd_f32("moving", 5);
}

#[test]
fn pendulum_is_equal() {
    equal_in_fd_f32("pendulum", 3);
}

#[test]
fn hard_move_with_twenty_action_slots_is_equal() {
    equal_in_fd_f32("hard-move-10", 3);
}

#[test]
fn inverted_pendulum_is_equal() {
    equal_in_fd_f32("inverted-pendulum-v5", 5);
}

#[test]
fn hopper_is_equal() {
    equal_in_fd_f32("hopper-v5", 5);
}

#[test]
fn humanoid_with_25_observation_frames_is_equal() {
    equal_in_fd_f32("humanoid-v5", 1);
}

#[test]
fn classic_i16_is_close() {
    for id in ["moving", "pendulum", "inverted-pendulum-v5"] {
        let mut env = gadm_envs::make(id).unwrap();
        let image = random_policy(env.spec(), 11);
        let (result, recorder) = run(id, &image, Profile::ClassicI16, 3, 3);
        let layout = policy_layout(&Policy::load(&image).unwrap(), Profile::ClassicI16).unwrap();
        let first = actions_of(&recorder, &layout).swap_remove(0);
        let (_, steps) = direct(&image, &mut *env, 3, 0);
        for ((a, b), signal) in first.action.iter().zip(&steps[0].action).zip(&env.spec().actions) {
            // Half a step of the action, and what half a step of the observations may do to it.
            let range = match signal.head {
                gadm_runtime::ActionHead::Continuous { lo, hi } => hi - lo,
                _ => 0.0,
            };
            assert!((a - b).abs() <= range * 0.01, "{id}: {a} instead of {b}");
        }
        let node = result.node.unwrap();
        assert_eq!((node.held, node.missed, node.crc_errors, node.torn, node.sequence), (0, 0, 0, 0, 0));
        assert_eq!(u64::from(node.acted), result.steps);
        assert_eq!(result.latent_counts.iter().sum::<u64>(), result.steps, "DECISION was read for every step");
    }
}

#[test]
fn same_seed_same_trace_and_another_seed_another() {
    let text = |seed: u64, profile| {
        let env = gadm_envs::make("moving").unwrap();
        let image = random_policy(env.spec(), 11);
        let (result, recorder) = run("moving", &image, profile, 3, seed);
        let mut bytes = Vec::new();
        let mut writer = TraceWriter::new(&mut bytes);
        for (time_us, frame) in recorder.frames() {
            writer.write(time_us, &frame).unwrap();
        }
        assert_eq!(result.bus.frames, recorder.frames().len() as u64);
        bytes
    };
    for profile in Profile::ALL {
        let first = text(7, profile);
        assert!(first.len() > 1000);
        assert!(first == text(7, profile), "the same seed gave another trace");
        assert!(first != text(8, profile), "another seed gave the same trace");
    }
}

#[test]
fn time_stamps_never_go_back_and_keep_to_the_period() {
    let env = gadm_envs::make("moving").unwrap();
    let image = random_policy(env.spec(), 11);
    let (_, recorder) = run("moving", &image, Profile::FdF32, 2, 1);
    let frames = recorder.frames();
    assert!(frames.windows(2).all(|w| w[0].0 <= w[1].0));
    let ticks: Vec<_> =
        frames.iter().filter_map(|(at, f)| gadm_node::service::Tick::parse(f).map(|t| (*at, t))).collect();
    for (i, (at, tick)) in ticks.iter().enumerate() {
        assert_eq!((tick.tick, tick.time_us), (i as u32, i as u32 * 5000));
        assert!(at - u64::from(tick.time_us) < 3000, "{at} {tick:?}");
    }
}
