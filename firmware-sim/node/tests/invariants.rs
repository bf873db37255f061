//! Whatever happens on the bus, some things never do.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use gadm_node::frame::{extended, standard};
use gadm_node::protocol::NO_LATENT;
use gadm_node::safety::{HOLD_LIMIT, TRANSITIONS};
use gadm_node::service::{Estop, Mode, ModeCommand, Tick};
use gadm_node::{Fault, Flags, Frame, Profile, State, TimeSource};
use gadm_runtime::ActionHead;
use proptest::prelude::*;
use support::{GOOD, HEADS, Rig, T};

#[derive(Clone, Debug)]
enum Op {
    /// A whole period with an observation.
    Period,
    /// TICK without its observation.
    Silent,
    /// An observation with an invalid value.
    Invalid,
    /// The observation before its TICK.
    Early,
    /// One part of the observation is missing.
    Torn,
    /// A wrong bit in every part.
    Damaged,
    /// A wrong bit in the identifier of the first part: it may look like a frame of another function.
    Misled(u16),
    /// The set of the previous period once more.
    Replay,
    /// Any tick number.
    AnyTick(u32, u32),
    /// Ticks skipped.
    Skip(u32),
    /// Only time.
    Wait(u64),
    Mode(ModeCommand),
    Estop,
    HostBeat,
    Any {
        id: u32,
        long: bool,
        fd: bool,
        data: Vec<u8>,
    },
    BusOff,
    BusOn,
}

fn op() -> impl Strategy<Value = Op> {
    let data = prop::collection::vec(any::<u8>(), 0..=64);
    prop_oneof![
        30 => Just(Op::Period),
        4 => Just(Op::Silent),
        3 => Just(Op::Invalid),
        2 => Just(Op::Early),
        2 => Just(Op::Torn),
        2 => Just(Op::Damaged),
        2 => (0_u16..11).prop_map(Op::Misled),
        2 => Just(Op::Replay),
        1 => (any::<u32>(), any::<u32>()).prop_map(|(a, b)| Op::AnyTick(a, b)),
        1 => (1_u32..5).prop_map(Op::Skip),
        2 => (0_u64..400_000).prop_map(Op::Wait),
        6 => Just(Op::Mode(ModeCommand::Run)),
        1 => Just(Op::Mode(ModeCommand::Stop)),
        1 => Just(Op::Mode(ModeCommand::Reset)),
        1 => Just(Op::Estop),
        2 => Just(Op::HostBeat),
        3 => (0_u32..0x800, any::<bool>(), any::<bool>(), data).prop_map(|(id, long, fd, data)| Op::Any { id, long, fd, data }),
        1 => Just(Op::BusOff),
        2 => Just(Op::BusOn),
    ]
}

fn apply(rig: &mut Rig, op: &Op) {
    let begin = |rig: &mut Rig| {
        rig.now += T;
        rig.tick = rig.tick.wrapping_add(1);
        rig.push_tick(rig.tick);
    };
    match op {
        Op::Period => rig.step(Some(&GOOD)),
        Op::Silent => rig.step(None),
        Op::Invalid => rig.step(Some(&[f32::NAN, 0.0, 0.0, 0.0, f32::INFINITY])),
        Op::Early => {
            let next = rig.tick.wrapping_add(1);
            for f in rig.observation(next, &GOOD) {
                rig.push(f);
            }
            begin(rig);
            rig.poll();
        }
        Op::Torn => {
            begin(rig);
            for f in rig.observation(rig.tick, &GOOD).into_iter().skip(1) {
                rig.push(f);
            }
            rig.poll();
        }
        Op::Damaged => {
            begin(rig);
            for mut f in rig.observation(rig.tick, &GOOD) {
                f.payload_mut()[3] ^= 0x10;
                rig.push(f);
            }
            rig.poll();
        }
        Op::Misled(bit) => {
            begin(rig);
            let parts = rig.observation(rig.tick, &GOOD);
            let id = standard(parts[0].standard_id().unwrap() ^ 1 << bit);
            let first = match rig.profile {
                Profile::FdF32 => Frame::fd(id, parts[0].payload(), true),
                Profile::ClassicI16 => Frame::classic(id, parts[0].payload()),
            };
            rig.push(first.unwrap());
            for f in &parts[1..] {
                rig.push(*f);
            }
            rig.poll();
        }
        Op::Replay => {
            for f in rig.observation(rig.tick.wrapping_sub(1), &GOOD) {
                rig.push(f);
            }
            rig.poll();
        }
        Op::AnyTick(tick, time_us) => {
            rig.push(Tick { tick: *tick, time_us: *time_us }.frame());
            rig.poll();
        }
        Op::Skip(n) => {
            rig.tick = rig.tick.wrapping_add(*n);
            rig.now += u64::from(*n) * T;
            rig.poll();
        }
        Op::Wait(us) => {
            rig.now += us;
            rig.poll();
        }
        Op::Mode(command) => {
            rig.push(Mode { command: *command, node: 0 }.frame());
            rig.poll();
        }
        Op::Estop => rig.estop(),
        Op::HostBeat => {
            rig.host_beat();
            rig.poll();
        }
        Op::Any { id, long, fd, data } => {
            let id = if *long { extended(*id) } else { standard(*id as u16) };
            let frame = if *fd { Frame::fd(id, data, true) } else { Frame::classic(id, &data[..data.len().min(8)]) };
            rig.push(frame.unwrap());
            rig.poll();
        }
        Op::BusOff => {
            rig.wire.borrow_mut().off = true;
            rig.poll();
        }
        Op::BusOn => {
            rig.wire.borrow_mut().off = false;
            rig.poll();
        }
    }
}

fn legal(value: f32, head: ActionHead) -> bool {
    match head {
        // classic-i16 rounds to a step of the range, which may lie half a step beyond the bound by float rounding only
        ActionHead::Continuous { lo, hi } => value >= lo - (hi - lo) * 1e-6 && value <= hi + (hi - lo) * 1e-6,
        ActionHead::Discrete { n } => value.fract() == 0.0 && value >= 0.0 && value < f32::from(n),
        ActionHead::Binary => value == 0.0 || value == 1.0,
    }
}

/// States that a chain of at most `arrows` within one poll leads to.
fn reachable(from: State, to: State, arrows: usize) -> bool {
    from == to || (arrows > 0 && TRANSITIONS.iter().any(|t| t.from == from && reachable(t.to, to, arrows - 1)))
}

/// Frames that came while the node booted: it takes them all with the next poll.
struct Waiting {
    frames: usize,
    ticks: u32,
    /// RUN or ESTOP, which lead from READY to where actions are sent.
    control: bool,
    reset: bool,
}

impl Waiting {
    fn of(rig: &Rig) -> Self {
        let rx = &rig.wire.borrow().rx;
        let mode = |command| rx.iter().any(|f| Mode::parse(f).is_some_and(|m| m.command == command));
        Self {
            frames: rx.len(),
            ticks: rx.iter().filter(|f| Tick::parse(f).is_some()).count() as u32,
            control: mode(ModeCommand::Run) || rx.iter().any(|f| Estop::parse(f).is_some()),
            reset: mode(ModeCommand::Reset),
        }
    }
}

fn check(profile: Profile, time: TimeSource, ops: &[Op]) -> Result<(), TestCaseError> {
    let mut rig = Rig::new(profile, time).ready();
    rig.mode(ModeCommand::Run);
    let (mut seen_acts, mut sets, mut last_act_seq) = (rig.acts.len(), 0_u32, None);
    let (mut alive_us, mut before) = (rig.now, rig.status);
    let mut since_good = 0_u32;
    // In lockstep there is no time before the first TICK since the boot, and no action that could grow old.
    let mut clock = time == TimeSource::Local;
    for op in ops {
        let waiting = Waiting::of(&rig);
        prop_assert!(
            waiting.frames == 0 || matches!(before.state, State::Boot | State::SelfTest | State::Ready),
            "frames wait in {:?}",
            before.state
        );
        apply(&mut rig, op);
        let now = rig.status;
        let arrows = 3 + waiting.frames.min(3); // six arrows lead wherever any number does
        prop_assert!(reachable(before.state, now.state, arrows), "{:?} to {:?} by {op:?}", before.state, now.state);
        let reset = matches!(op, Op::Mode(ModeCommand::Reset)) || before.state == State::Boot || waiting.reset;
        for act in &rig.acts[seen_acts..] {
            for (&v, head) in act.values.iter().zip(HEADS) {
                prop_assert!(legal(v, head), "{v} is not legal for {head:?}");
            }
            if act.has(Flags::SAFE) {
                prop_assert_eq!(act.header.latent, NO_LATENT);
                last_act_seq = None; // what is held from here on is the safe action
            } else if act.has(Flags::HELD) {
                if let Some(seq) = last_act_seq {
                    let age = profile.ahead(act.header.seq, seq);
                    prop_assert!((0..=HOLD_LIMIT as i16).contains(&age), "held {age} periods");
                }
            } else {
                last_act_seq = Some(act.header.seq);
            }
        }
        let new = (rig.acts.len() - seen_acts) as u32;
        if matches!(before.state, State::Boot | State::SelfTest | State::NoPolicy | State::Ready)
            && matches!(now.state, State::Boot | State::SelfTest | State::NoPolicy | State::Ready)
            && !waiting.control
        {
            prop_assert_eq!(new, 0, "actions without control in {:?}", now.state);
        }
        if matches!(now.state, State::Safe | State::Fault) && now.state == before.state {
            prop_assert!(rig.acts[seen_acts..].iter().all(|a| a.has(Flags::SAFE)));
        }
        seen_acts = rig.acts.len();
        let (c, b) = (now.counters, before.counters);
        if reset {
            sets = c.acted + c.held + c.safe;
        } else {
            sets += new;
            let counted = c.acted + c.held + c.safe;
            // A set that a dead bus did not take is counted but cannot be seen here.
            let off = rig.wire.borrow().off || c.bus_errors > b.bus_errors;
            prop_assert!(counted == sets || (off && counted >= sets), "{counted} counted, {sets} seen");
            sets = counted;
            for (a, b) in [
                (c.acted, b.acted),
                (c.held, b.held),
                (c.safe, b.safe),
                (c.missed, b.missed),
                (c.late, b.late),
                (c.torn, b.torn),
                (c.sequence, b.sequence),
                (c.crc_errors, b.crc_errors),
                (c.invalid, b.invalid),
                (c.safe_entries, b.safe_entries),
                (c.refused, b.refused),
                (c.bus_errors, b.bus_errors),
            ] {
                prop_assert!(a >= b, "a counter went back: {c:?} after {b:?}");
            }
            prop_assert!(c.held <= c.missed, "what is held was missed: {c:?}");
            prop_assert!(c.missed - b.missed < 100_000, "believed a leap of {} periods", c.missed - b.missed);
        }
        if now.state != State::Run || before.state != State::Run || c.acted > b.acted || !clock {
            alive_us = rig.now;
        }
        let period =
            matches!(op, Op::Period | Op::Silent | Op::Invalid | Op::Early | Op::Torn | Op::Damaged | Op::Misled(_));
        let ticks = period || matches!(op, Op::AnyTick(..));
        if matches!(now.state, State::Boot | State::SelfTest) {
            clock = time == TimeSource::Local;
        } else {
            clock |= (ticks && !rig.wire.borrow().off) || waiting.ticks > 0;
        }
        if time == TimeSource::Local && now.state == State::Run {
            let silent = rig.now - alive_us;
            prop_assert!(silent <= 3 * T + T / 5, "in control {silent} us after the last decision");
        }
        // Safe within three periods of any loss: a TICK that the node takes, without a decision, is a period lost.
        let ticked = period && c.sequence == b.sequence;
        if now.state != State::Run || before.state != State::Run || c.acted > b.acted {
            since_good = 0;
        } else if ticked && !rig.wire.borrow().off {
            since_good += 1;
            prop_assert!(since_good <= HOLD_LIMIT, "in control for {since_good} periods without a decision");
            if time == TimeSource::Tick {
                let held_us = rig.now - alive_us;
                prop_assert!(held_us <= 3 * T + T / 5, "in control {held_us} us after the last decision");
            }
        }
        if now.state == State::Safe && before.state == State::Run {
            prop_assert_eq!(c.safe_entries, b.safe_entries + 1);
            prop_assert!(now.fault != Fault::None, "SAFE without a reason");
        }
        if !reset {
            // Counters tell one story: what was entered was sent, what was decided was not missed.
            prop_assert!(c.held <= c.missed && c.clipped <= c.acted && c.fallback <= c.acted, "{c:?}");
            let most = 1 + u32::from(matches!(op, Op::Any { .. })) + waiting.ticks;
            prop_assert!(c.acted - b.acted <= most, "{} decisions for {most} ticks", c.acted - b.acted);
        }
        before = now;
    }
    Ok(())
}

const RESET: Op = Op::Mode(ModeCommand::Reset);
const RUN: Op = Op::Mode(ModeCommand::Run);
const STOP: Op = Op::Mode(ModeCommand::Stop);

/// What random operations found once.
#[test]
fn found_before() {
    let found: [&[Op]; 7] = [
        // The first TICK comes late: the node has sent nothing yet, and its time in lockstep begins there ...
        &[Op::Skip(3), Op::Torn, Op::Silent, Op::Silent, Op::Silent],
        &[Op::Wait(22_001), Op::Torn, Op::Silent, Op::Silent],
        // ... but not for the ticks after it.
        &[Op::Skip(3), Op::Period, Op::Wait(2 * T), Op::Torn, Op::Wait(2 * T), Op::Silent],
        &[RESET, Op::Wait(0), RUN, Op::Wait(40_000), Op::Silent, Op::Wait(20_000), Op::Silent, Op::Silent],
        // Frames that wait while the node boots are taken in one poll.
        &[RESET, RESET, RUN, Op::Period, Op::Period],
        &[RESET, RUN, Op::Period, STOP],
        &[RESET, RESET, RUN, Op::Period, STOP, RESET, RESET, RESET, Op::BusOff, Op::BusOn],
    ];
    for ops in found {
        for profile in Profile::ALL {
            for time in [TimeSource::Tick, TimeSource::Local] {
                check(profile, time, ops).unwrap();
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn lockstep_fd(ops in prop::collection::vec(op(), 1..120)) {
        check(Profile::FdF32, TimeSource::Tick, &ops)?;
    }

    #[test]
    fn own_timer_fd(ops in prop::collection::vec(op(), 1..120)) {
        check(Profile::FdF32, TimeSource::Local, &ops)?;
    }

    #[test]
    fn lockstep_classic(ops in prop::collection::vec(op(), 1..120)) {
        check(Profile::ClassicI16, TimeSource::Tick, &ops)?;
    }

    #[test]
    fn own_timer_classic(ops in prop::collection::vec(op(), 1..120)) {
        check(Profile::ClassicI16, TimeSource::Local, &ops)?;
    }
}
