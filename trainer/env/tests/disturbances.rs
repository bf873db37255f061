//! A disturbed plant behaves differently, and as before once the disturbance is taken back.
#![cfg(feature = "mujoco")]
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

use gadm_envs::{Disturbance, Env, EnvError, make};

/// Observations of 30 steps from seed 3 with a constant action.
fn run(env: &mut dyn Env, action: f32) -> Vec<f32> {
    let mut obs = vec![0.0; env.spec().obs_dim()];
    let actions = vec![action; env.spec().action_dim()];
    env.reset(3, &mut obs);
    (0..30)
        .flat_map(|_| {
            env.step(&actions, &mut obs);
            obs.clone()
        })
        .collect()
}

#[test]
fn each_disturbance_changes_the_motion_and_can_be_taken_back() {
    let pairs = [
        (Disturbance::Mass { factor: 2.0 }, Disturbance::Mass { factor: 1.0 }),
        (Disturbance::Friction { factor: 0.1 }, Disturbance::Friction { factor: 1.0 }),
        (Disturbance::Gravity { factor: 0.5 }, Disturbance::Gravity { factor: 1.0 }),
        (Disturbance::Push { force_n: [20.0, 0.0, 0.0] }, Disturbance::Push { force_n: [0.0; 3] }),
    ];
    let mut env = make("hopper-v5").unwrap();
    let clean = run(env.as_mut(), 0.6);
    for (disturbance, back) in pairs {
        env.disturb(disturbance).unwrap();
        assert_ne!(run(env.as_mut(), 0.6), clean, "{disturbance:?}");
        env.disturb(back).unwrap();
        assert_eq!(run(env.as_mut(), 0.6), clean, "{back:?}");
    }
    assert_eq!(run(make("hopper-v5").unwrap().as_mut(), 0.6), clean, "other environments are not touched");
}

#[test]
fn a_push_forward_moves_forward_and_half_the_gravity_falls_half_as_fast() {
    let last_speed = |d: Option<Disturbance>| {
        let mut env = make("inverted-pendulum-v5").unwrap();
        if let Some(d) = d {
            env.disturb(d).unwrap();
        }
        let mut obs = vec![0.0; 4];
        env.reset(1, &mut obs);
        env.step(&[0.0], &mut obs);
        obs[2]
    };
    let push = |f: f64| last_speed(Some(Disturbance::Push { force_n: [f, 0.0, 0.0] }));
    assert!(push(10.0) > last_speed(None) && push(-10.0) < last_speed(None));

    // The hopper starts standing: drop it instead, from 3 m.
    let fall = |factor: f64| {
        let mut env = make("hopper-v5").unwrap();
        env.disturb(Disturbance::Gravity { factor }).unwrap();
        let mut obs = vec![0.0; 11];
        env.reset(1, &mut obs);
        let mut state = env.state();
        state.reals[1] = 3.0;
        state.reals[7] = 0.0;
        env.restore(&state).unwrap();
        (0..5).for_each(|_| {
            env.step(&[0.0; 3], &mut obs);
        });
        f64::from(obs[6])
    };
    // Velocity after 20 internal steps of 2 ms in free fall (source: model file, 9.81 m/s²), less what the joints' motion adds.
    let (full, half) = (fall(1.0), fall(0.5));
    assert!((full - half + 0.5 * 9.81 * 0.04).abs() < 0.01, "{full} {half}");
}

#[test]
fn what_cannot_be_is_refused() {
    let mut env = make("hopper-v5").unwrap();
    for wrong in [
        Disturbance::Mass { factor: 0.0 },
        Disturbance::Mass { factor: f64::NAN },
        Disturbance::Friction { factor: -1.0 },
        Disturbance::Push { force_n: [f64::INFINITY, 0.0, 0.0] },
    ] {
        assert!(matches!(env.disturb(wrong), Err(EnvError::Disturbance { .. })), "{wrong:?}");
    }
    let error = make("pendulum").unwrap().disturb(Disturbance::Mass { factor: 2.0 }).unwrap_err();
    assert!(error.to_string().contains("`pendulum` cannot be disturbed"), "{error}");
}
