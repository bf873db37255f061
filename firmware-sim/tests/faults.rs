//! A bad bus between plant and node: what is injected is noticed, and the run goes on or ends as it should.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::Profile;
use gadm_node::protocol::Function;
use gadm_sim::bus::fault::{FaultCounts, FaultPlan, FaultyLink};
use gadm_sim::sil::{Recorder, simulate_with_link};
use gadm_sim::{RunOptions, RunResult};
use support::random_policy;

fn faulty(plan: FaultPlan, profile: Profile) -> (RunResult, FaultCounts, Recorder) {
    let env = gadm_envs::make("pendulum").unwrap();
    let image = random_policy(env.spec(), 2);
    let options = RunOptions { episodes: 5, seed: 1, profile, ..RunOptions::new("test") };
    let recorder = Recorder::default();
    let mut counts = None;
    let result =
        simulate_with_link(&options, &image, env, Some(Box::new(recorder.clone())), &mut |_| {}, |port, bus| {
            let link = FaultyLink::new(port, plan, 42, bus.clock());
            counts = Some(link.counts());
            link
        })
        .unwrap();
    (result, counts.unwrap().get(), recorder)
}

fn only(functions: &[Function]) -> FaultPlan {
    FaultPlan { only: functions.to_vec(), ..FaultPlan::default() }
}

#[test]
fn lost_observations_are_held_and_recovered() {
    for profile in Profile::ALL {
        let (result, injected, _) = faulty(FaultPlan { drop: 0.05, ..only(&[Function::Observation]) }, profile);
        let node = result.node.unwrap();
        assert!(injected.dropped > 20, "{injected:?}");
        // A set is one frame here; one lost in the last period of an episode is not missed any more.
        let missed = u64::from(node.missed);
        assert!(missed <= injected.dropped && missed + 5 >= injected.dropped, "{node:?} {injected:?}");
        assert!(node.held > 0 && node.acted > 800, "{node:?}");
        assert_eq!(result.steps, 1000);
    }
}

#[test]
fn long_losses_lead_to_safe_and_back() {
    let (result, injected, _) = faulty(FaultPlan { drop: 0.4, ..only(&[Function::Observation]) }, Profile::FdF32);
    let node = result.node.unwrap();
    assert!(injected.dropped > 300);
    assert!(node.safe_entries > 3, "{node:?}");
    assert!(node.acted > 100, "the host asks again and the node recovers: {node:?}");
    assert!(result.episodes.iter().any(|e| e.safe > 0));
}

#[test]
fn damaged_observations_never_reach_the_policy() {
    let (result, injected, _) = faulty(FaultPlan { corrupt: 0.05, ..only(&[Function::Observation]) }, Profile::FdF32);
    let node = result.node.unwrap();
    assert!(injected.corrupted > 20);
    assert_eq!(u64::from(node.crc_errors), injected.corrupted);
}

#[test]
fn doubled_frames_change_nothing_but_a_counter() {
    let (clean, _, _) = faulty(FaultPlan::default(), Profile::FdF32);
    let sets = [Function::Observation, Function::Tick];
    let (result, injected, _) = faulty(FaultPlan { duplicate: 0.3, ..only(&sets) }, Profile::FdF32);
    assert!(injected.duplicated > 300);
    assert_eq!(result.returns(), clean.returns());
    let node = result.node.unwrap();
    assert_eq!((u64::from(node.sequence), node.missed), (injected.duplicated, 0));
}

#[test]
fn late_observations_are_not_used() {
    let plan = FaultPlan { delay: 0.05, delay_us: 75_000, ..only(&[Function::Observation]) };
    let (result, injected, _) = faulty(plan, Profile::FdF32);
    let node = result.node.unwrap();
    assert!(injected.delayed > 20);
    assert!(node.late > 10 && node.missed > 20, "{node:?}");
    assert!(result.episodes.iter().map(|e| e.late).sum::<u64>() > 10, "said on the bus");
    assert_eq!(node.crc_errors, 0);
}

#[test]
fn overtaking_frames_and_lost_ticks_do_not_stop_the_run() {
    let (result, injected, _) = faulty(FaultPlan { reorder: 0.1, drop: 0.02, ..only(&[]) }, Profile::ClassicI16);
    assert!(injected.reordered > 50 && injected.dropped > 10);
    assert_eq!(result.steps, 1000);
}

#[test]
fn a_faulty_run_is_as_repeatable_as_a_clean_one() {
    let plan = || FaultPlan {
        drop: 0.1,
        duplicate: 0.1,
        corrupt: 0.1,
        delay: 0.1,
        delay_us: 50_000,
        reorder: 0.1,
        only: vec![],
    };
    let (a, n, trace) = faulty(plan(), Profile::FdF32);
    let (b, m, again) = faulty(plan(), Profile::FdF32);
    assert!(n.total() > 100);
    assert_eq!((a, n), (b, m));
    assert!(trace.frames() == again.frames());
}
