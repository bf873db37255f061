//! Limits that a plant or a bus could try to get around.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::{Fault, Profile, State, TimeSource};
use support::{GOOD, Rig, T};

#[test]
fn ticks_that_stretch_the_time_do_not_stretch_how_long_an_action_is_held() {
    for profile in Profile::ALL {
        let mut rig = Rig::new(profile, TimeSource::Tick).running();
        rig.step(Some(&GOOD));
        assert_eq!(rig.status.state, State::Run);
        rig.now += 19 * T / 10;
        rig.step(None);
        assert_eq!(rig.status.state, State::Run, "2.9 T after the last good set");
        rig.now += 19 * T / 10;
        rig.step(None);
        assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::ObservationLost), "5.8 T after it");
    }
}

#[test]
fn a_start_between_two_ticks_is_no_jitter() {
    let mut rig = Rig::local().ready();
    rig.steps(3);
    // RUN comes in the middle of a period; the next tick is in time all the same.
    rig.now += T / 2;
    rig.mode(gadm_node::service::ModeCommand::Run);
    rig.now -= T / 2;
    rig.steps(3);
    assert_eq!((rig.status.state, rig.status.fault), (State::Run, Fault::None));
    assert!(rig.acts.iter().all(|a| !a.has(gadm_node::Flags::LATE)), "{:?}", rig.acts);
}

#[test]
fn a_power_cycle_forgets_everything_but_policy_and_bus() {
    let mut rig = Rig::local().running();
    rig.step(Some(&GOOD));
    rig.estop();
    let Rig { node, wire, .. } = rig;
    let mut node = node.power_cycle();
    wire.borrow_mut().rx.clear();
    let mut status = node.poll(0);
    for _ in 0..10 {
        status = node.poll(0);
    }
    assert_eq!(
        (status.state, status.fault),
        (State::Ready, Fault::None),
        "an emergency stop is latched until RESET or power"
    );
    assert_eq!(status.counters, gadm_node::Counters::default());
}
