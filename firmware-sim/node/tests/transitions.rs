//! One test per arrow of the safety table.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::safety::TRANSITIONS;
use gadm_node::service::ModeCommand;
use gadm_node::{Event, NodeConfig, State, TimeSource};
use support::{GOOD, Rig, T, leak, policy_bytes};

/// Brings a node to the beginning of an arrow.
fn at(from: State, event: Event) -> Rig {
    let config = NodeConfig { time: TimeSource::Local, ..NodeConfig::default() };
    let good = || leak(&policy_bytes(T as u32));
    match (from, event) {
        (State::Boot, Event::LoadFailed) => Rig::with(config, leak(b"not a policy, whatever it may look like"), 4096),
        (State::Boot, _) => Rig::local(),
        (State::SelfTest, _) => {
            // With too little work memory the vectors cannot be computed.
            let mut rig = Rig::with(config, good(), if event == Event::SelfTestFailed { 1 } else { 4096 });
            rig.poll();
            rig
        }
        (State::NoPolicy, _) => {
            let mut rig = Rig::with(config, good(), 1);
            rig.settle();
            rig
        }
        (State::Ready, _) => Rig::local().ready(),
        (State::Run, _) => Rig::local().running(),
        (State::Safe, _) => Rig::local().safe(),
        (State::Fault, _) => Rig::local().faulty(),
    }
}

/// Makes the event happen, through frames, time and the bus only.
fn cause(rig: &mut Rig, event: Event) {
    match event {
        Event::Loaded | Event::LoadFailed | Event::SelfTestPassed | Event::SelfTestFailed => rig.poll(),
        Event::RunRequest => {
            if rig.status.state == State::Safe {
                rig.steps(5);
            }
            rig.mode(ModeCommand::Run);
        }
        Event::StopRequest => rig.mode(ModeCommand::Stop),
        Event::ResetRequest => rig.mode(ModeCommand::Reset),
        Event::ObservationLost => (0..3).for_each(|_| rig.step(None)),
        Event::ObservationInvalid => (0..3).for_each(|_| rig.step(Some(&[0.0, f32::NAN, 0.0, 0.0, 0.0]))),
        Event::TickLost => {
            for back in 1..=3 {
                rig.now += T / 2;
                rig.push_tick(rig.tick - back);
                rig.poll();
            }
        }
        Event::HostLost => {
            rig.host_beat();
            rig.poll();
            rig.steps(31);
        }
        Event::CrcErrors => {
            for _ in 0..3 {
                let mut bad = rig.observation(rig.tick, &GOOD)[0];
                bad.payload_mut()[5] ^= 1;
                rig.push(bad);
            }
            rig.poll();
        }
        Event::BusOff => {
            rig.wire.borrow_mut().off = true;
            rig.poll();
        }
        Event::BusOffRepeated => {
            rig.wire.borrow_mut().heals = true;
            for _ in 0..4 {
                rig.wire.borrow_mut().off = true;
                rig.poll();
                rig.poll();
            }
        }
        Event::Estop => rig.estop(),
    }
}

fn follow(from: State, event: Event) {
    let arrow = TRANSITIONS.iter().find(|t| t.from == from && t.event == event).expect("an arrow of the table");
    let mut rig = at(from, event);
    assert_eq!(rig.status.state, from);
    let before = rig.beats.len();
    cause(&mut rig, event);
    // BOOT is left in the same poll; the heartbeat still told it.
    let told = rig.beats[before..].iter().any(|b| b.state == arrow.to.code());
    assert!(rig.status.state == arrow.to || told, "{arrow:?} led to {:?}", rig.status);
    let off = rig.wire.borrow().off;
    if !off {
        rig.settle();
        let told = rig.beats[before..].iter().any(|b| b.state == arrow.to.code());
        assert!(told, "no heartbeat told {:?}", arrow.to);
    }
}

macro_rules! arrows {
    ($($name:ident: $from:ident, $event:ident;)*) => {
        $(#[test] fn $name() { follow(State::$from, Event::$event); })*
        const TESTED: &[(State, Event)] = &[$((State::$from, Event::$event)),*];
    };
}

arrows! {
    boot_loaded: Boot, Loaded;
    boot_load_failed: Boot, LoadFailed;
    self_test_passed: SelfTest, SelfTestPassed;
    self_test_failed: SelfTest, SelfTestFailed;
    ready_run: Ready, RunRequest;
    ready_estop: Ready, Estop;
    ready_bus_off: Ready, BusOff;
    run_stop: Run, StopRequest;
    run_observation_lost: Run, ObservationLost;
    run_observation_invalid: Run, ObservationInvalid;
    run_tick_lost: Run, TickLost;
    run_host_lost: Run, HostLost;
    run_crc_errors: Run, CrcErrors;
    run_bus_off: Run, BusOff;
    run_estop: Run, Estop;
    safe_run: Safe, RunRequest;
    safe_bus_off_repeated: Safe, BusOffRepeated;
    no_policy_reset: NoPolicy, ResetRequest;
    ready_reset: Ready, ResetRequest;
    run_reset: Run, ResetRequest;
    safe_reset: Safe, ResetRequest;
    fault_reset: Fault, ResetRequest;
}

#[test]
fn every_arrow_has_a_test() {
    let table: Vec<_> = TRANSITIONS.iter().map(|t| (t.from, t.event)).collect();
    assert_eq!(TESTED, table);
}

#[test]
fn what_is_not_in_the_table_changes_nothing() {
    let states = [State::NoPolicy, State::Ready, State::Run, State::Safe, State::Fault];
    let requests = [Event::RunRequest, Event::StopRequest, Event::Estop, Event::ObservationInvalid, Event::BusOff];
    for from in states {
        for event in requests {
            if TRANSITIONS.iter().any(|t| t.from == from && t.event == event) {
                continue;
            }
            let mut rig = at(from, Event::ResetRequest);
            cause(&mut rig, event);
            assert_eq!(rig.status.state, from, "{event:?}");
        }
    }
}
