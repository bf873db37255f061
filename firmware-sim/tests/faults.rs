//! What can go wrong goes wrong, is counted and noticed, and the actuators stay within their bounds and their time.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::Profile;
use gadm_sim::fault::{CATALOGUE, Fault, Row, parse};
use gadm_sim::sil::{Recorder, simulate};
use gadm_sim::{RunOptions, RunResult, SimError};
use support::random_policy;

/// A fault as a scenario has it.
fn fault(text: &str) -> Fault {
    parse(text.replace("; ", "\n").parse().unwrap()).unwrap()
}

fn try_faulty(plant: &str, faults: Vec<Fault>, profile: Profile) -> Result<(RunResult, Recorder), SimError> {
    let env = gadm_envs::make(plant).unwrap();
    let image = random_policy(env.spec(), 2);
    let options = RunOptions { episodes: 5, seed: 1, profile, faults, ..RunOptions::new("test") };
    let recorder = Recorder::default();
    let result = simulate(&options, &image, env, Some(Box::new(recorder.clone())), &mut |_| {})?;
    Ok((result, recorder))
}

/// Five episodes of the pendulum, 200 periods of 50 ms each.
fn faulty(text: &str, profile: Profile) -> RunResult {
    try_faulty("pendulum", vec![fault(text)], profile).unwrap().0
}

/// Whatever goes wrong: no action beyond its bounds, none older than the limit.
fn guarded(result: &RunResult) {
    for e in &result.episodes {
        assert_eq!(e.out_of_bounds, 0, "{e:?}");
        assert!(e.max_action_age <= 3, "{e:?}");
    }
}

#[test]
fn every_kind_is_injected_and_guarded_against() {
    for r in CATALOGUE.iter().filter(|r| r.layer != "plant") {
        for profile in Profile::ALL {
            let result = faulty(&example(r), profile);
            assert!(result.faults[0].injected > 0, "{r:?} injected nothing");
            assert_eq!(result.steps, 1000, "{r:?}");
            guarded(&result);
            let e = &result.episodes[0];
            assert!(e.faults.unwrap().first_tick.is_some() && !e.fault_spans.is_empty(), "{r:?}");
        }
    }
}

fn example(r: &Row) -> String {
    // Nothing in 200 periods of the pendulum would show these.
    let parameters = match r.kind {
        "saturate" => "level = 0.01".to_owned(),
        "dead-zone" => "width = 0.9".to_owned(),
        _ => r.example.replace(", ", "; "),
    };
    format!("layer = '{}'; kind = '{}'; {parameters}", r.layer, r.kind)
}

#[cfg(feature = "mujoco")]
#[test]
fn faults_of_the_plant_change_its_motion_and_end_with_the_window() {
    let clean = try_faulty("inverted-pendulum-v5", vec![], Profile::FdF32).unwrap().0;
    for r in CATALOGUE.iter().filter(|r| r.layer == "plant") {
        let with = |window: &str| {
            let text = format!("{}; window = {window}", example(r));
            try_faulty("inverted-pendulum-v5", vec![fault(&text)], Profile::FdF32).unwrap().0
        };
        let result = with("[0]");
        assert!(result.faults[0].injected > 0, "{r:?}");
        // A pole on a hinge touches nothing, so friction changes nothing.
        assert!(result.returns() != clean.returns() || r.kind == "friction", "{r:?}");
        assert_eq!(with("[500, 501]").returns(), clean.returns(), "{r:?}: after the end of every episode");
    }
}

#[test]
fn a_plant_that_cannot_be_disturbed_says_so() {
    let error = try_faulty("pendulum", vec![fault("layer = 'plant'; kind = 'mass'; factor = 2.0")], Profile::FdF32);
    let text = error.unwrap_err().to_string();
    assert!(text.contains("`pendulum` cannot be disturbed"), "{text}");
    let wrong = fault("layer = 'sensor'; kind = 'freeze'; signals = ['x']");
    let text = try_faulty("pendulum", vec![wrong], Profile::FdF32).unwrap_err().to_string();
    assert!(text.contains("no signal `x`; it has "), "{text}");
}

#[test]
fn a_total_loss_is_safe_within_three_periods() {
    for text in [
        "layer = 'frame'; kind = 'drop'; p = 1.0; only = ['OBS']; window = [50]",
        "layer = 'frame'; kind = 'drop'; p = 1.0; target = 'plant'; window = [50]",
        "layer = 'frame'; kind = 'corrupt'; p = 1.0; only = ['OBS']; window = [50]",
        "layer = 'frame'; kind = 'delay'; ticks = 2; only = ['OBS']; window = [50]",
        "layer = 'bus'; kind = 'disconnect'; ticks = 200; window = [50]",
        "layer = 'bus'; kind = 'disconnect'; ticks = 200; target = 'plant'; window = [50]",
        "layer = 'bus'; kind = 'bit-rate'; ticks = 200; window = [50]",
        "layer = 'bus'; kind = 'bus-off'; ticks = 100; window = [50]",
        "layer = 'bus'; kind = 'overflow'; capacity = 0; window = [50]",
        "layer = 'node'; kind = 'hang'; ticks = 100; window = [50]",
        "layer = 'node'; kind = 'reset'; ticks = 50; window = [50]",
        "layer = 'sensor'; kind = 'nan'; window = [50]",
    ] {
        for profile in Profile::ALL {
            let result = faulty(text, profile);
            for e in &result.episodes {
                let f = e.faults.unwrap();
                assert_eq!(f.first_tick, Some(50), "{text}");
                assert!(f.safe_after.unwrap() <= 3 && f.detected_after.unwrap() <= 2, "{text}: {f:?}");
            }
            guarded(&result);
        }
    }
}

#[test]
fn lost_observations_are_held_and_recovered() {
    for profile in Profile::ALL {
        let result = faulty("layer = 'frame'; kind = 'drop'; p = 0.05; only = ['OBS']", profile);
        let (node, injected) = (result.node.unwrap(), result.faults[0].injected);
        assert!(injected > 20, "{injected}");
        // A set is one frame here; one lost in the last period of an episode is not missed any more.
        let missed = u64::from(node.missed);
        assert!(missed <= injected && missed + 5 >= injected, "{node:?} {injected}");
        assert!(node.held > 0 && node.acted > 800, "{node:?}");
        assert_eq!(result.steps, 1000);
    }
}

#[test]
fn long_losses_lead_to_safe_and_back() {
    let result = faulty("layer = 'frame'; kind = 'drop'; p = 0.4; only = ['OBS']", Profile::FdF32);
    let node = result.node.unwrap();
    assert!(result.faults[0].injected > 300);
    assert!(node.safe_entries > 3, "{node:?}");
    assert!(node.acted > 100, "the host asks again and the node recovers: {node:?}");
    assert!(result.episodes.iter().any(|e| e.safe > 0));
}

#[test]
fn damaged_frames_never_reach_the_policy() {
    for kind in ["corrupt", "truncate"] {
        let text = format!("layer = 'frame'; kind = '{kind}'; p = 0.05; only = ['OBS']");
        let result = faulty(&text, Profile::FdF32);
        assert!(result.faults[0].injected > 20);
        assert_eq!(u64::from(result.node.unwrap().crc_errors), result.faults[0].injected, "{kind}");
    }
}

#[test]
fn doubled_frames_change_nothing_but_a_counter() {
    let clean = try_faulty("pendulum", vec![], Profile::FdF32).unwrap().0;
    let result = faulty("layer = 'frame'; kind = 'duplicate'; p = 0.3; only = ['OBS', 'TICK']", Profile::FdF32);
    let injected = result.faults[0].injected;
    assert!(injected > 300);
    assert_eq!(result.returns(), clean.returns());
    let node = result.node.unwrap();
    assert_eq!((u64::from(node.sequence), node.missed), (injected, 0));
}

#[test]
fn late_observations_are_not_used() {
    let result = faulty("layer = 'frame'; kind = 'delay'; ticks = 2; p = 0.05; only = ['OBS']", Profile::FdF32);
    let node = result.node.unwrap();
    assert!(result.faults[0].injected > 20);
    assert!(node.missed > 20 && node.sequence > 10, "{node:?}");
    assert_eq!(node.crc_errors, 0);
    let result = faulty("layer = 'frame'; kind = 'delay'; ticks = 1; p = 0.05; only = ['OBS']", Profile::FdF32);
    assert!(result.node.unwrap().late > 10, "{result:?}");
    assert!(result.episodes.iter().map(|e| e.late).sum::<u64>() > 10, "said on the bus");
}

#[test]
fn a_flooded_bus_starves_less_urgent_frames_only() {
    // 500 kbit/s carries 185 full classic frames in 50 ms at most.
    let full = faulty("layer = 'frame'; kind = 'babble'; frames = 200; id = 1; window = [50]", Profile::FdF32);
    assert!(full.episodes.iter().all(|e| e.faults.unwrap().safe_after.is_some_and(|t| t <= 3)), "{full:?}");
    let half = faulty("layer = 'frame'; kind = 'babble'; frames = 90; id = 1; window = [50]", Profile::FdF32);
    assert_eq!(half.node.unwrap().missed, 0, "there is room left");
    let humble = faulty("layer = 'frame'; kind = 'babble'; frames = 200; id = 0x7FE; window = [50]", Profile::FdF32);
    assert_eq!(humble.node.unwrap().missed, 0, "the least urgent frames harm nobody");
}

#[test]
fn bus_off_is_restarted_three_times_a_minute_and_then_stays() {
    let result = faulty("layer = 'bus'; kind = 'bus-off'; ticks = 2; every = 40", Profile::FdF32);
    let node = result.node.unwrap();
    assert_eq!(result.faults[0].injected, 25, "five in each episode, the fourth without recovery");
    assert!(node.safe_entries >= 15, "{node:?}");
    // The fourth is not restarted: safe until the end.
    assert!(result.episodes.iter().all(|e| e.missing > 60), "{result:?}");
}

#[test]
fn a_power_cycle_is_followed_by_a_boot_and_a_new_start() {
    let result = faulty("layer = 'node'; kind = 'reset'; every = 100; window = [50]", Profile::FdF32);
    assert_eq!(result.faults[0].injected, 10);
    let node = result.node.unwrap();
    assert!(node.acted > 900, "the counters of all boots together: {node:?}");
}

#[test]
fn a_timer_that_is_off_is_noticed_beyond_twenty_per_cent() {
    let slight = faulty("layer = 'node'; kind = 'clock-drift'; ppm = 100.0", Profile::FdF32);
    assert!(slight.episodes.iter().all(|e| e.late == 0 && e.faults.unwrap().detected_after.is_none()), "{slight:?}");
    let gross = faulty("layer = 'node'; kind = 'clock-drift'; ppm = 300000.0", Profile::FdF32);
    assert!(gross.episodes.iter().all(|e| e.late > 100 && e.faults.unwrap().detected_after.is_some()), "{gross:?}");
}

#[test]
fn a_slow_answer_is_not_applied_late() {
    let result = faulty("layer = 'node'; kind = 'slow-inference'; ticks = 1; window = [50, 60]", Profile::FdF32);
    for e in &result.episodes {
        assert!(e.missing > 3, "{e:?}");
    }
    guarded(&result);
}

#[test]
fn faults_together_are_as_repeatable_as_none() {
    let all = || {
        CATALOGUE
            .iter()
            .filter(|r| r.layer != "plant" && r.kind != "clock-drift")
            .map(|r| fault(&example(r)))
            .collect::<Vec<_>>()
    };
    let (a, trace) = try_faulty("pendulum", all(), Profile::FdF32).unwrap();
    let (b, again) = try_faulty("pendulum", all(), Profile::FdF32).unwrap();
    assert!(a.faults.iter().filter(|f| f.injected > 0).count() > 25, "{:?}", a.faults);
    assert_eq!(a, b);
    assert!(trace.frames() == again.frames());
    guarded(&a);
}
