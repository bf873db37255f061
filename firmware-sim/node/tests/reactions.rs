//! What the node sends, in good times and bad.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::frame::standard;
use gadm_node::protocol::NO_LATENT;
use gadm_node::service::{Heartbeat, Mode, ModeCommand, OP_READ, OP_REFUSED, Page, Reply, Request, Tick};
use gadm_node::{Fault, Flags, Frame, NodeConfig, Profile, State, TimeSource};
use support::{GOOD, Rig, SAFE, T, leak, policy_bytes};

const INVALID: [f32; 5] = [0.0, f32::INFINITY, 0.0, 0.0, 0.0];

fn rigs() -> impl Iterator<Item = Rig> {
    [TimeSource::Local, TimeSource::Tick]
        .into_iter()
        .flat_map(|time| Profile::ALL.map(|profile| Rig::new(profile, time)))
}

#[test]
fn actions_are_those_of_the_policy_bit_for_bit_in_fd_f32() {
    for time in [TimeSource::Local, TimeSource::Tick] {
        let mut rig = Rig::new(Profile::FdF32, time).running();
        for k in 0..4 {
            let mut obs = [0.1, 0.2, -0.3, 0.25, -0.9];
            obs[k] = 0.8;
            rig.step(Some(&obs));
            let (latent, action) = rig.expected(&obs);
            assert_eq!(usize::from(latent), k);
            assert_eq!(rig.last().values, action);
            assert_eq!((rig.last().header.latent, rig.last().header.seq), (latent, rig.tick as u16));
            assert_eq!(rig.last().header.flags, Flags::default());
        }
    }
}

#[test]
fn classic_actions_are_close_and_latents_equal() {
    let mut rig = Rig::new(Profile::ClassicI16, TimeSource::Tick).running();
    rig.step(Some(&GOOD));
    let (latent, action) = rig.expected(&GOOD);
    assert_eq!(rig.last().header.latent, latent);
    assert_eq!(rig.last().values[..2], action[..2], "types and switches are exact");
    for (a, b) in rig.last().values.iter().zip(&action) {
        assert!((a - b).abs() <= 5.0 / 65534.0 * 1.01, "{a} {b}");
    }
}

#[test]
fn one_missing_set_holds_the_last_action() {
    for rig in rigs() {
        let mut rig = rig.running();
        let before = rig.last().clone();
        rig.step(None);
        let n = rig.acts.len();
        rig.step(Some(&GOOD));
        assert_eq!(rig.acts.len(), n + 2, "the held answer for the missing set, then the new one");
        let held = &rig.acts[n];
        assert!(held.has(Flags::HELD) && held.values == before.values);
        assert_eq!(held.header.seq, rig.profile.seq(rig.tick - 1));
        assert!(!rig.last().has(Flags::HELD));
        assert_eq!((rig.status.state, rig.status.counters.held, rig.status.counters.missed), (State::Run, 1, 1));
    }
}

#[test]
fn three_periods_without_a_good_set_lead_to_safe_by_a_ramp() {
    for rig in rigs() {
        let mut rig = rig.running();
        rig.step(Some(&[0.0, 0.9, 0.0, 0.0, 0.0])); // latent 1: action 1, 0, 3.0, 0.0
        rig.step(None);
        assert_eq!(rig.status.state, State::Run);
        rig.step(None);
        assert_eq!(rig.status.state, State::Run);
        rig.step(None);
        assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::ObservationLost));
        let first = rig.last().clone();
        assert!(first.has(Flags::SAFE) && first.header.latent == NO_LATENT);
        assert_eq!(first.header.seq, rig.profile.seq(rig.tick), "answered in the same period");
        assert!((first.values[2] - 2.5).abs() < 1e-3, "a fifth of the way from 3.0 to 0.5: {first:?}");
        assert_eq!(first.values[..2], SAFE[..2], "types and switches at once");
        for _ in 0..4 {
            rig.step(None);
        }
        for (a, b) in rig.last().values.iter().zip(SAFE) {
            assert!((a - b).abs() < 1e-4, "the safe action after 5 periods: {:?}", rig.last());
        }
    }
}

#[test]
fn invalid_values_hold_twice_and_the_third_leads_to_safe() {
    for rig in rigs() {
        let mut rig = rig.running();
        for _ in 0..2 {
            rig.step(Some(&INVALID));
            assert_eq!(rig.status.state, State::Run);
            assert!(rig.last().has(Flags::HELD));
        }
        rig.step(Some(&GOOD));
        for _ in 0..2 {
            rig.step(Some(&INVALID));
        }
        assert_eq!(rig.status.state, State::Run, "a good set in between starts the count again");
        rig.step(Some(&INVALID));
        assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::ObservationInvalid));
        assert!(rig.last().has(Flags::SAFE));
        assert_eq!(rig.status.counters.invalid, 5);
    }
}

#[test]
fn a_mix_of_missing_and_invalid_sets_does_not_hold_for_ever() {
    for rig in rigs() {
        let mut rig = rig.running();
        let mut periods = 0;
        while rig.status.state == State::Run {
            periods += 1;
            rig.step(if periods % 2 == 0 { None } else { Some(&INVALID) });
        }
        assert!(periods <= 4, "{periods}");
    }
}

#[test]
fn safe_is_left_after_five_good_sets_and_a_request_only() {
    for rig in rigs() {
        let mut rig = rig.safe();
        rig.mode(ModeCommand::Run);
        assert_eq!(rig.status.state, State::Safe);
        rig.steps(4);
        rig.mode(ModeCommand::Run);
        assert_eq!((rig.status.state, rig.status.counters.refused), (State::Safe, 2));
        rig.step(None);
        rig.steps(4);
        rig.mode(ModeCommand::Run);
        assert_eq!(rig.status.state, State::Safe, "in a row means in a row");
        rig.steps(1);
        assert_eq!(rig.status.state, State::Safe, "good sets alone do not start control");
        rig.mode(ModeCommand::Run);
        assert_eq!((rig.status.state, rig.status.fault), (State::Run, Fault::None));
        rig.step(Some(&GOOD));
        assert!(!rig.last().has(Flags::SAFE));
    }
}

#[test]
fn an_emergency_stop_is_immediate_and_latched_until_reset() {
    for rig in rigs() {
        let mut rig = rig.running();
        rig.estop();
        assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::Estop));
        rig.step(Some(&GOOD));
        for (a, b) in rig.last().values.iter().zip(SAFE) {
            assert!((a - b).abs() < 1e-4, "no ramp: {:?}", rig.last());
        }
        rig.steps(10);
        rig.mode(ModeCommand::Run);
        assert_eq!(rig.status.state, State::Safe);
        rig.mode(ModeCommand::Reset);
        rig.settle();
        rig.mode(ModeCommand::Run);
        assert_eq!(rig.status.state, State::Run);
    }
}

#[test]
fn an_emergency_stop_before_the_policy_is_ready_is_not_forgotten() {
    let mut rig = Rig::local();
    rig.estop();
    rig.settle();
    assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::Estop));
}

#[test]
fn an_emergency_stop_for_all_and_for_another_node() {
    let mut rig = Rig::local().running();
    rig.push(gadm_node::service::Estop { node: 2, reason: 0 }.frame());
    rig.poll();
    assert_eq!(rig.status.state, State::Run);
    rig.push(gadm_node::service::Estop { node: 0, reason: 0 }.frame());
    rig.poll();
    assert_eq!(rig.status.state, State::Safe);
}

#[test]
fn mode_for_another_node_is_not_obeyed() {
    let mut rig = Rig::local().ready();
    rig.push(Mode { command: ModeCommand::Run, node: 2 }.frame());
    rig.poll();
    assert_eq!(rig.status.state, State::Ready);
    rig.push(Mode { command: ModeCommand::Run, node: 0 }.frame());
    rig.poll();
    assert_eq!(rig.status.state, State::Run);
}

#[test]
fn stop_sends_the_safe_action_once_and_then_nothing() {
    let mut rig = Rig::local().running();
    rig.mode(ModeCommand::Stop);
    assert_eq!(rig.status.state, State::Ready);
    assert_eq!((rig.last().values.as_slice(), rig.last().has(Flags::SAFE)), (&SAFE[..], true));
    let n = rig.acts.len();
    rig.steps(5);
    assert_eq!(rig.acts.len(), n);
}

#[test]
fn a_policy_that_fails_its_own_vectors_is_not_run() {
    let mut rig = Rig::with(NodeConfig::default(), leak(&policy_bytes(T as u32)), 1);
    rig.settle();
    assert_eq!((rig.status.state, rig.status.fault), (State::NoPolicy, Fault::PolicySelfTest));
    rig.mode(ModeCommand::Run);
    assert_eq!((rig.status.state, rig.status.counters.refused), (State::NoPolicy, 1));
    rig.steps(3);
    assert!(rig.acts.is_empty());
    assert_eq!(rig.beats.last().unwrap().fault, Fault::PolicySelfTest.code());
}

#[test]
fn torn_late_duplicate_and_early_parts() {
    // Five values in profile classic-i16: two parts.
    let mut rig = Rig::new(Profile::ClassicI16, TimeSource::Tick).running();
    let begin = |rig: &mut Rig| {
        rig.now += T;
        rig.tick += 1;
        rig.push_tick(rig.tick);
        rig.observation(rig.tick, &GOOD)
    };
    // Torn: the second part never comes.
    let parts = begin(&mut rig);
    rig.push(parts[0]);
    rig.poll();
    rig.step(Some(&GOOD));
    assert_eq!((rig.status.counters.torn, rig.status.counters.held), (1, 1));
    // Late: it comes after the next tick.
    let parts = begin(&mut rig);
    rig.push(parts[0]);
    let _ = begin(&mut rig);
    rig.push(parts[1]);
    rig.poll();
    assert_eq!(rig.status.counters.late, 1);
    for frame in rig.observation(rig.tick, &GOOD) {
        rig.push(frame);
    }
    rig.poll();
    assert!(rig.last().has(Flags::LATE), "said in the next answer");
    rig.step(Some(&GOOD));
    assert!(!rig.last().has(Flags::LATE));
    // Duplicate parts and a duplicate set are ignored.
    let n = rig.acts.len();
    let parts = begin(&mut rig);
    for p in [0, 0, 1, 0, 1] {
        rig.push(parts[p]);
    }
    rig.poll();
    assert_eq!((rig.acts.len(), rig.status.counters.sequence), (n + 1, 3));
    // Parts that overtake their tick are used.
    rig.now += T;
    rig.tick += 1;
    for frame in rig.observation(rig.tick, &GOOD) {
        rig.push(frame);
    }
    rig.push_tick(rig.tick);
    rig.poll();
    assert_eq!(rig.acts.len(), n + 2);
    assert_eq!(rig.last().header.seq, rig.profile.seq(rig.tick));
    assert_eq!(rig.status.state, State::Run);
}

/// Found by a campaign: 0x180 and 0x080 differ in one bit. Taken as a TICK, an observation moved the node by 50 million
/// periods, and it left control at once.
#[test]
fn an_observation_with_a_damaged_identifier_is_no_tick() {
    for rig in rigs() {
        let mut rig = rig.running();
        let before = rig.status.counters;
        // A third within a second would be too many damaged frames.
        for _ in 0..2 {
            rig.now += T;
            rig.tick += 1;
            rig.push_tick(rig.tick);
            for (i, frame) in rig.observation(rig.tick, &GOOD).into_iter().enumerate() {
                let id = standard(0x080 + i as u16);
                let wrong = match rig.profile {
                    Profile::FdF32 => Frame::fd(id, frame.payload(), true),
                    Profile::ClassicI16 => Frame::classic(id, frame.payload()),
                };
                rig.push(if i == 0 { wrong.unwrap() } else { frame });
            }
            rig.poll();
            rig.steps(4);
            let counters = rig.status.counters;
            assert_eq!((rig.status.state, rig.status.fault), (State::Run, Fault::None), "{counters:?}");
            assert_eq!(counters.acted + counters.missed, rig.tick, "every period has its answer");
        }
        let counters = rig.status.counters;
        assert_eq!(counters.missed, before.missed + 2, "its period had no observation");
        let told = match rig.profile {
            Profile::FdF32 => (before.crc_errors + 2, before.sequence),
            Profile::ClassicI16 => (before.crc_errors, before.sequence + 2),
        };
        assert_eq!((counters.crc_errors, counters.sequence), told);
    }
}

#[test]
fn a_duplicate_tick_is_ignored_and_a_jump_of_three_is_a_loss() {
    for rig in rigs() {
        let mut rig = rig.running();
        let n = rig.acts.len();
        rig.push_tick(rig.tick);
        rig.poll();
        assert_eq!((rig.acts.len(), rig.status.counters.sequence), (n, 1));
        rig.tick += 1;
        rig.now += T;
        rig.step(Some(&GOOD));
        assert_eq!(rig.status.state, State::Run, "one tick lost");
        assert_eq!(rig.status.counters.missed, 1);
        rig.tick += 2;
        rig.now += 2 * T;
        rig.step(Some(&GOOD));
        assert_eq!(rig.status.state, State::Safe, "three periods since the last good set");
    }
}

#[test]
fn a_restarted_plant_is_followed_from_safe() {
    for rig in rigs() {
        let mut rig = rig.running();
        rig.tick = 0;
        for _ in 0..3 {
            rig.step(Some(&GOOD));
        }
        assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::TickLost));
        rig.steps(6);
        rig.mode(ModeCommand::Run);
        assert_eq!(rig.status.state, State::Run);
    }
}

#[test]
fn silence_is_noticed_by_the_timer_and_by_the_time_of_the_next_tick() {
    let mut rig = Rig::local().running();
    rig.now += 3 * T;
    rig.poll();
    assert_eq!(rig.status.state, State::Run, "3 T and a tolerance");
    rig.now += T / 5 + 1;
    rig.poll();
    assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::ObservationLost));
    let n = rig.acts.len();
    for _ in 0..10 {
        rig.now += 2 * T;
        rig.poll();
    }
    assert_eq!(rig.acts.len(), n + 10, "the safe action goes on without ticks");

    let mut rig = Rig::new(Profile::FdF32, TimeSource::Tick).running();
    rig.now += 300_000;
    rig.step(Some(&GOOD));
    assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::TickLost));
}

#[test]
fn a_slow_plant_has_three_periods_instead_of_300_ms() {
    // 200 ms period: 300 ms would be less than two periods.
    let config = NodeConfig { time: TimeSource::Local, ..NodeConfig::default() };
    let mut rig = Rig::with(config, leak(&policy_bytes(200_000)), 4096).ready();
    rig.mode(ModeCommand::Run);
    rig.push(Tick { tick: 1, time_us: 0 }.frame());
    rig.poll();
    for ms in [301, 599, 600] {
        rig.now = ms * 1000;
        rig.poll();
        assert_eq!(rig.status.state, State::Run);
    }
    rig.now = 601_000;
    rig.poll();
    assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::TickLost));
}

#[test]
fn a_host_that_never_spoke_is_not_missed_and_one_that_stopped_is() {
    let mut rig = Rig::local().running();
    rig.steps(100);
    assert_eq!(rig.status.state, State::Run);
    rig.host_beat();
    rig.steps(30);
    assert_eq!(rig.status.state, State::Run);
    rig.steps(2);
    assert_eq!((rig.status.state, rig.status.fault), (State::Safe, Fault::HostLost));
}

#[test]
fn a_few_damaged_frames_are_dropped_and_counted() {
    let mut rig = Rig::local().running();
    rig.steps(60);
    for _ in 0..5 {
        rig.steps(12);
        rig.now += T;
        rig.tick += 1;
        rig.push_tick(rig.tick);
        let mut bad = rig.observation(rig.tick, &GOOD)[0];
        bad.payload_mut()[9] ^= 0x40;
        rig.push(bad);
        rig.poll();
    }
    assert_eq!((rig.status.state, rig.status.counters.crc_errors), (State::Run, 5));
}

#[test]
fn frames_of_another_policy_never_reach_the_policy() {
    let mut rig = Rig::local().ready();
    rig.mode(ModeCommand::Run);
    let other = Rig::with(NodeConfig::default(), leak(&policy_bytes(9_999)), 4096);
    drop(other);
    let foreign = gadm_node::Layout::new(
        Profile::FdF32,
        support::node_id(),
        0x1234,
        core::iter::repeat_n((-1.0, 1.0), 5),
        support::HEADS.into_iter(),
    )
    .unwrap();
    for _ in 0..3 {
        rig.now += T;
        rig.tick += 1;
        rig.push_tick(rig.tick);
        rig.push(foreign.observation_frame(0, rig.profile.seq(rig.tick), &GOOD).unwrap());
        rig.poll();
    }
    assert_eq!(rig.status.state, State::Safe);
    assert_eq!((rig.status.counters.acted, rig.status.counters.crc_errors), (0, 3));
}

#[test]
fn an_uneven_plant_is_flagged_and_a_slow_one_too() {
    let mut rig = Rig::local().running();
    rig.now += T / 2;
    rig.step(Some(&GOOD));
    assert_eq!((rig.status.state, rig.status.fault), (State::Run, Fault::PeriodJitter));
    assert!(rig.last().has(Flags::LATE));
    rig.settle();
    assert_eq!(rig.beats.last().unwrap().fault, Fault::PeriodJitter.code());
    rig.steps(128);
    assert_eq!(rig.status.fault, Fault::None);
    for _ in 0..128 {
        rig.now += T / 4;
        rig.step(Some(&GOOD));
    }
    rig.mode(ModeCommand::Run);
    assert_eq!(rig.status.state, State::Run);
    assert_ne!(rig.status.fault, Fault::None);
}

#[test]
fn bus_off_is_restarted_three_times_a_minute() {
    let mut rig = Rig::local().running();
    rig.wire.borrow_mut().heals = true;
    for expected in 1..=3 {
        rig.wire.borrow_mut().off = true;
        rig.poll();
        rig.poll();
        assert_eq!((rig.status.state, rig.wire.borrow().restarts), (State::Safe, expected));
    }
    rig.now += 61_000_000;
    rig.wire.borrow_mut().off = true;
    rig.poll();
    rig.poll();
    assert_eq!((rig.status.state, rig.wire.borrow().restarts), (State::Safe, 4));
    assert_eq!(rig.beats.last().unwrap().fault, Fault::BusOff.code());
}

#[test]
fn a_fault_is_left_by_reset_only_and_sends_the_safe_action() {
    let mut rig = Rig::local().faulty();
    let n = rig.acts.len();
    rig.steps(10);
    assert_eq!(rig.acts.len(), n + 10);
    assert!(rig.acts[n..].iter().all(|a| a.has(Flags::SAFE)));
    rig.mode(ModeCommand::Run);
    assert_eq!(rig.status.state, State::Fault);
    rig.mode(ModeCommand::Reset);
    rig.settle();
    assert_eq!((rig.status.state, rig.status.counters.safe), (State::Ready, 0));
}

#[test]
fn a_rate_limit_cuts_and_says_so() {
    let config = NodeConfig { time: TimeSource::Local, rate_limit: Some(0.1), ..NodeConfig::default() };
    let mut rig = Rig::with(config, leak(&policy_bytes(T as u32)), 4096).ready();
    rig.mode(ModeCommand::Run);
    rig.step(Some(&GOOD)); // latent 0 wants -2.0 and 1.0 from the safe 0.5 and 0.25
    assert_eq!(rig.last().values[2], 0.0);
    assert!(rig.last().has(Flags::CLIPPED));
    rig.steps(30);
    assert_eq!(rig.last().values[2], -2.0);
    assert!(!rig.last().has(Flags::CLIPPED));
}

#[test]
fn heartbeats_come_every_100_ms_and_on_change_with_all_pages() {
    for rig in rigs() {
        let mut rig = rig.ready();
        let states: Vec<u8> = rig.beats.iter().map(|b| b.state).collect();
        assert_eq!(states, [State::Boot, State::SelfTest, State::Ready].map(State::code));
        rig.mode(ModeCommand::Run);
        rig.steps(1);
        let n = rig.beats.len();
        rig.steps(1000);
        let more = &rig.beats[n..];
        assert!((99..=100).contains(&more.len()), "{}", more.len());
        for &page in Page::ALL {
            assert!(more.iter().any(|b| b.page == page.code()), "{page:?}");
        }
        for pair in rig.beats.windows(2) {
            assert_eq!(pair[1].seq, pair[0].seq.wrapping_add(1));
        }
        let page = |p: Page| more.iter().find(|b| b.page == p.code()).map(|b: &Heartbeat| b.value).unwrap();
        let policy = gadm_runtime::Policy::load(leak(&policy_bytes(T as u32))).unwrap();
        let hash = u64::from(page(Page::InterfaceHigh)) << 32 | u64::from(page(Page::InterfaceLow));
        assert_eq!(hash, policy.interface_hash());
        assert_eq!(page(Page::PolicyCrc), policy.header().payload_crc32);
    }
}

#[test]
fn requests_are_answered_in_order_and_unknown_ones_refused() {
    let mut rig = Rig::local().ready();
    rig.push(Request { node: 1, op: OP_READ, page: Page::PolicyCrc.code(), tag: 7, value: 0 }.frame());
    rig.push(Request { node: 2, op: OP_READ, page: 0, tag: 8, value: 0 }.frame());
    rig.push(Request { node: 1, op: OP_READ, page: 200, tag: 9, value: 0 }.frame());
    rig.push(Request { node: 1, op: 77, page: 0, tag: 10, value: 0 }.frame());
    let _ = rig.node.poll(rig.now);
    let replies: Vec<Reply> = rig.wire.borrow().tx.iter().filter_map(Reply::parse).collect();
    assert_eq!(
        replies.iter().map(|r| (r.op, r.tag)).collect::<Vec<_>>(),
        [(OP_READ, 7), (OP_REFUSED, 9), (OP_REFUSED, 10)]
    );
    assert_eq!(replies[2].value, 77);
}

#[test]
fn sequence_numbers_and_ticks_wrap() {
    for rig in rigs() {
        let mut rig = rig.ready();
        rig.tick = u32::MAX - 300;
        rig.now = 0xFFFF_FFFF - 50 * T;
        rig.steps(1);
        rig.mode(ModeCommand::Run);
        rig.steps(600);
        assert_eq!((rig.status.state, rig.status.fault), (State::Run, Fault::None));
        assert_eq!((rig.status.counters.acted, rig.status.counters.missed), (600, 0));
    }
}
