//! Stepping allocates nothing, so its time does not depend on the allocator and memory does not grow.
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use gadm_envs::{EnvError, EnvOptions, VecEnv, ids, make};

#[test]
fn a_step_allocates_nothing() {
    for id in ids() {
        let mut env = match make(id) {
            Err(EnvError::Feature { .. }) => continue,
            made => made.unwrap(),
        };
        let mut obs = vec![0.0; env.spec().obs_dim()];
        let action: Vec<f32> = env.spec().actions.iter().map(|a| a.safe).collect();
        env.reset(0, &mut obs);
        env.step(&action, &mut obs);
        let counted = allocation_counter::measure(|| {
            for _ in 0..50 {
                env.step(&action, &mut obs);
            }
        });
        assert_eq!(counted.count_total, 0, "{id}: {counted:?}");
    }
}

#[test]
fn a_step_of_a_row_allocates_nothing_between_resets() {
    let mut row = VecEnv::new("pendulum", 4, 0, &EnvOptions::default()).unwrap();
    row.step(&[0.0; 4]).unwrap();
    let counted = allocation_counter::measure(|| {
        for _ in 0..100 {
            row.step(&[0.5; 4]).unwrap();
        }
    });
    assert_eq!(counted.count_total, 0, "{counted:?}");
}
