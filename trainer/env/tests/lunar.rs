//! What LunarLander promises beyond the contract of all environments: an episode goes on with the same bits wherever it is
//! continued, and it can be landed.
#![cfg(feature = "box2d")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use gadm_envs::{Disturbance, Env, EnvError, EnvOptions, Step, VecEnv, make, make_with};

const ID: &str = "lunar-lander-continuous";

fn bits(obs: &[f32]) -> Vec<u32> {
    obs.iter().map(|o| o.to_bits()).collect()
}

/// Brakes as fast as it falls and leans against its sideways motion; lands most of the time.
fn pilot(obs: &[f32]) -> [f32; 2] {
    let [x, y, vx, vy, angle, spin, right, left] = obs.try_into().unwrap();
    if right + left > 0.0 {
        return [-20.0 * vy - 4.0, 0.0];
    }
    let lean = (0.5 * x + vx).clamp(-0.4, 0.4);
    let side = 20.0 * (0.5 * (angle - lean) + spin);
    let main = 10.0 * (0.55 * x.abs() - y - vy) - 1.0;
    [main, side]
}

/// One episode with the pilot: return, last step, and number of steps.
fn fly(env: &mut dyn Env, seed: u64) -> (f64, Step, u32) {
    let mut obs = vec![0.0; env.spec().obs_dim()];
    env.reset(seed, &mut obs);
    let mut total = 0.0;
    for n in 1.. {
        let [main, side] = pilot(&obs);
        let action = if env.spec().action_dim() == 2 {
            vec![main, side]
        } else {
            let strongest = if main > side.abs() { 2.0 } else { 2.0 + side.signum() };
            vec![if main > 0.0 || side.abs() > 0.5 { strongest } else { 0.0 }]
        };
        let step = env.step(&action, &mut obs);
        total += step.reward;
        if step.terminated || step.truncated {
            return (total, step, n);
        }
    }
    unreachable!("the loop has no end")
}

#[test]
fn a_pilot_lands_and_idling_crashes() {
    for id in [ID, "lunar-lander"] {
        let mut env = make(id).unwrap();
        assert_eq!((env.spec().time_limit, env.spec().control_period_us), (Some(1000), 20_000));
        let flights: Vec<_> = (0..20).map(|seed| fly(&mut *env, seed)).collect();
        let landed = flights.iter().filter(|(_, last, _)| last.reward == 100.0).count();
        assert!(landed >= 10, "{id}: {landed} of 20 landed: {flights:?}");
        assert!(flights.iter().all(|(_, last, _)| last.terminated != last.truncated || last.reward.abs() == 100.0));

        let mut obs = vec![0.0; 8];
        env.reset(1, &mut obs);
        let safe = vec![0.0; env.spec().action_dim()];
        let last = (0..200).map(|_| env.step(&safe, &mut obs)).find(|step| step.terminated).unwrap();
        assert_eq!(last.reward, -100.0, "{id}");
    }
}

#[test]
fn the_limit_truncates_and_does_not_terminate() {
    let mut env = make_with(ID, &EnvOptions { time_limit: Some(30), ..EnvOptions::default() }).unwrap();
    let (_, last, n) = fly(&mut *env, 0);
    assert_eq!((n, last.terminated, last.truncated), (30, false, true));
}

#[test]
fn a_state_taken_during_a_contact_goes_on_with_the_same_bits() {
    let mut env = make(ID).unwrap();
    let mut obs = vec![0.0; 8];
    let seed = (0..20).find(|seed| fly(&mut *env, *seed).1.reward == 100.0).unwrap();
    env.reset(seed, &mut obs);
    while obs[6] + obs[7] == 0.0 {
        env.step(&pilot(&obs), &mut obs);
    }
    let state = env.state();
    let mut copy = make(ID).unwrap();
    copy.restore(&state).unwrap();
    assert_eq!(copy.state(), state);
    let mut theirs = obs.clone();
    for n in 0.. {
        let step = env.step(&pilot(&obs), &mut obs);
        assert_eq!(copy.step(&pilot(&theirs), &mut theirs), step, "step {n}");
        assert_eq!(bits(&theirs), bits(&obs), "step {n}");
        if step.terminated {
            assert!(n > 0, "the episode went on after the contact");
            break;
        }
    }
}

#[test]
fn an_episode_may_travel_between_threads() {
    let fixed = |n: usize| [(n as f32 * 0.7).sin(), (n as f32 * 1.3).cos()];
    let run = |travels: bool| {
        let mut env = make(ID).unwrap();
        let mut obs = vec![0.0; 8];
        let mut trace = vec![];
        env.reset(4, &mut obs);
        for n in 0..50 {
            let mut step = || env.step(&fixed(n), &mut obs);
            let step = if travels && n % 3 > 0 {
                std::thread::scope(|scope| scope.spawn(&mut step).join().unwrap())
            } else {
                step()
            };
            trace.push((step.reward.to_bits(), bits(&obs)));
        }
        trace
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn rows_give_the_same_on_any_number_of_threads_and_after_a_restore() {
    let row = |threads| {
        let envs = (0..4).map(|_| make(ID).unwrap()).collect();
        VecEnv::from_envs(envs, 9, threads).unwrap()
    };
    let actions: Vec<f32> = (0..8).map(|i| if i % 2 == 0 { 0.3 } else { -0.8 }).collect();
    let [mut one, mut three] = [1, 3].map(row);
    let mut saved = None;
    for n in 0..150 {
        if n == 75 {
            saved = Some(one.save());
        }
        assert_eq!(one.step(&actions).unwrap(), three.step(&actions).unwrap(), "step {n}");
    }
    let text = serde_json::to_string(&saved.unwrap()).unwrap();
    let mut resumed = row(2);
    resumed.restore(&serde_json::from_str(&text).unwrap()).unwrap();
    for _ in 75..150 {
        resumed.step(&actions).unwrap();
    }
    assert_eq!(resumed.last(), one.last());
    assert_eq!(resumed.save(), one.save());
}

#[test]
fn it_cannot_be_disturbed() {
    let error = make(ID).unwrap().disturb(Disturbance::Gravity { factor: 0.5 }).unwrap_err();
    assert!(matches!(error, EnvError::Disturbance { .. }), "{error}");
}
