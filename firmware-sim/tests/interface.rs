//! A policy that was made for another plant is refused, and the first difference is named.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_envs::EnvSpec;
use gadm_runtime::{ActionHead, Policy};
use gadm_sim::{RunOptions, SimError, interface, simulate};
use support::random_policy;

fn refused(change: impl FnOnce(&mut EnvSpec)) -> String {
    let env = gadm_envs::make("moving").unwrap();
    let image = random_policy(env.spec(), 1);
    let policy = Policy::load(&image).unwrap();
    interface::check(&policy, env.spec()).unwrap();
    let mut plant = env.spec().clone();
    change(&mut plant);
    let error = interface::check(&policy, &plant).unwrap_err();
    assert_eq!(error.exit_code(), 1);
    error.to_string()
}

#[test]
fn the_first_difference_is_named() {
    let name = refused(|p| p.observations[1].name = "other".into());
    assert!(name.contains("observation 1") && name.contains("`other`") && name.contains("--plant moving"), "{name}");
    let unit = refused(|p| p.actions[0].unit = "parsec".into());
    assert!(unit.contains("action 0") && unit.contains("parsec"), "{unit}");
    let range = refused(|p| p.actions[1].head = ActionHead::Continuous { lo: -7.0, hi: 7.0 });
    assert!(range.contains("range of action 1") && range.contains("-7"), "{range}");
    let period = refused(|p| p.control_period_us = 20_000);
    assert!(period.contains("control period") && period.contains("20000 us"), "{period}");
    let order = refused(|p| p.observations.swap(0, 1));
    assert!(order.contains("observation 0"), "{order}");
    let length = refused(|p| p.observations.truncate(3));
    assert!(length.contains("observation length: the plant has 3"), "{length}");
}

#[test]
fn a_range_that_only_scales_integers_may_differ() {
    let env = gadm_envs::make("moving").unwrap();
    let image = random_policy(env.spec(), 1);
    let mut plant = env.spec().clone();
    plant.observations[0].hi *= 2.0;
    interface::check(&Policy::load(&image).unwrap(), &plant).unwrap();
}

#[test]
fn a_run_on_another_plant_does_not_start() {
    let image = random_policy(gadm_envs::make("moving").unwrap().spec(), 1);
    let plant = gadm_envs::make("pendulum").unwrap();
    let error = simulate(&RunOptions::new("test"), &image, plant, None, &mut |_| {}).unwrap_err();
    assert!(matches!(error, SimError::Interface { .. }), "{error}");
}

#[test]
fn what_the_machine_lacks_has_its_own_exit_code() {
    let lacking = gadm_envs::EnvError::Feature { id: "hopper-v5".into(), feature: "mujoco" };
    assert_eq!(SimError::from(lacking).exit_code(), 4);
    let unknown = gadm_envs::make("no-such").map(|_| ()).unwrap_err();
    assert_eq!(SimError::from(unknown).exit_code(), 1);
}
