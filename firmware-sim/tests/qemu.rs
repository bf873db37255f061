//! The firmware on emulated boards. These need `qemu-system-arm` and the firmware of `firmware-sim/firmware/build.sh --check`, so
//! `cargo test` leaves this file out (`test = false` in Cargo.toml) and stage `boards` of `.ci/test.py` names it, after stage
//! `firmware` has built what it needs: `cargo test -p gadm-sim --test qemu`.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use gadm_envs::TimeLimit;
use gadm_image::{EncodeOptions, Format, PolicyImage};
use gadm_node::protocol::NodeId;
use gadm_node::reason::Reason;
use gadm_node::service::{Heartbeat, Mode, ModeCommand, Page, Request, Tick};
use gadm_node::slots::SlotState;
use gadm_node::{Fault, Frame, NodeConfig, State, TimeSource};
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{Policy, Scratch};
use gadm_sim::bus::{Address, Bus, open};
use gadm_sim::install::{InstallOptions, install};
use gadm_sim::rung::{Job, Place, Rung};
use gadm_sim::sil::{Recorder, read_image, simulate_on};
use gadm_sim::target::qemu::{Board, Emulator, Machine};
use gadm_sim::{BitRate, Profile, RunOptions};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use support::program::{sim, stderr};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn model(name: &str) -> AlignedImage {
    read_image(&root().join("models").join(name).join("policy.bin")).unwrap()
}

fn board(machine: Machine, variant: &str) -> Board {
    let firmware = root().join(format!("target/firmware/{}{variant}.elf", machine.name()));
    Board { machine, firmware }
}

/// How long a run is: episodes, and the most steps of each.
#[derive(Clone, Copy)]
struct Length {
    episodes: u64,
    steps: u32,
}

/// Frames of a run.
fn trace(place: Place, image: &AlignedImage, plant: &str, profile: Profile, length: Length) -> Vec<(u64, Frame)> {
    let options = RunOptions { episodes: length.episodes, seed: 11, profile, ..RunOptions::new("policy.bin") };
    let env = Box::new(TimeLimit::new(gadm_envs::make(plant).unwrap(), length.steps));
    let recorder = Recorder::default();
    let config = NodeConfig { profile, time: TimeSource::Tick, ..NodeConfig::default() };
    let mut scratch = vec![0; Policy::load(image).unwrap().spec().scratch_words];
    let job = Job { policy: Path::new(""), image, config, bit_rate: options.bit_rate, scratch: &mut scratch };
    let rung = Rung { place, realtime: None };
    let tap = Some(Box::new(recorder.clone()) as Box<_>);
    simulate_on(&options, image, env, tap, &mut |_| {}, |port, bus| rung.target(port, bus, job)).unwrap();
    recorder.frames()
}

/// The same run in process and on the board, in both profiles: the same frames at the same times, of `periods` control
/// periods at the least.
fn equal(machine: Machine, name: &str, plant: &str, length: Length, periods: usize) {
    let image = model(name);
    for profile in Profile::ALL {
        let here = trace(Place::InProcess, &image, plant, profile, length);
        let there = trace(Place::Board(board(machine, "")), &image, plant, profile, length);
        let differs = here.iter().zip(&there).position(|(a, b)| a != b);
        assert_eq!(differs, None, "{machine}, {plant}, {}: frame {differs:?} differs", profile.name());
        assert_eq!(here.len(), there.len());
        let ticks = here.iter().filter(|(_, frame)| Tick::parse(frame).is_some()).count();
        assert!(ticks >= periods, "{ticks} periods in {plant}");
    }
}

#[test]
fn inverted_pendulum_on_a_cortex_m4_sends_the_frames_of_the_run_in_process() {
    equal(Machine::Mps2An386, "inverted-pendulum-v5", "inverted-pendulum-v5", Length { episodes: 1, steps: 400 }, 400);
}

#[test]
fn hopper_on_a_cortex_m4_sends_the_frames_of_the_run_in_process() {
    equal(Machine::Mps2An386, "hopper-v5", "hopper-v5", Length { episodes: 1, steps: 300 }, 300);
}

#[test]
fn moving_on_a_cortex_m4_sends_the_frames_of_the_run_in_process() {
    equal(Machine::Mps2An386, "moving", "moving", Length { episodes: 8, steps: 300 }, 300);
}

#[test]
fn hopper_on_a_cortex_m7_and_on_an_stm32f405_sends_the_frames_of_the_run_in_process() {
    for machine in [Machine::Mps2An500, Machine::NetduinoPlus2] {
        equal(machine, "hopper-v5", "hopper-v5", Length { episodes: 1, steps: 60 }, 60);
    }
}

/// A participant on the UART of a board.
struct Peer {
    bus: Box<dyn Bus>,
    emulator: Emulator,
}

impl Peer {
    fn connect(board: &Board, policy: &[u8], config: &NodeConfig) -> Self {
        let emulator = board.power_on(policy, config).unwrap();
        let bus = open(&Address::Unix(emulator.socket().to_owned()), BitRate::default()).unwrap();
        let mut peer = Self { bus, emulator };
        // What the node said before the channel was open is gone; after RESET it says it again.
        peer.send(Mode { command: ModeCommand::Reset, node: 0 }.frame());
        peer
    }

    fn send(&mut self, frame: Frame) {
        self.bus.send(&frame).unwrap();
        self.bus.flush().unwrap();
    }

    #[expect(clippy::disallowed_methods, reason = "the guard of a test that waits for an emulator")]
    fn wait<T>(&mut self, what: &str, found: impl Fn(&Frame) -> Option<T>) -> T {
        let end = Instant::now() + Duration::from_mins(1);
        let mut frame = Frame::empty();
        while Instant::now() < end {
            while self.bus.receive(&mut frame).unwrap() {
                if let Some(found) = found(&frame) {
                    return found;
                }
            }
            self.bus.wait(Duration::from_millis(100)).unwrap();
        }
        panic!("no {what} within a minute");
    }

    fn heartbeat(&mut self, state: State) -> Heartbeat {
        self.wait(state.name(), |f| Heartbeat::parse(f).filter(|h| h.state == state.code()))
    }

    fn page(&mut self, page: Page) -> u32 {
        self.send(Request::read(1, page, 99).frame());
        self.wait("reply", |f| gadm_node::service::Reply::parse(f).filter(|r| r.tag == 99)).value
    }
}

fn fix_checksums(image: &mut [u8]) {
    let payload = u32::from_le_bytes(image[16..20].try_into().unwrap()) as usize;
    let sum = gadm_node::transfer::checksum(&image[64..64 + payload]);
    image[20..24].copy_from_slice(&sum.to_le_bytes());
    let sum = gadm_node::transfer::checksum(&image[..60]);
    image[60..64].copy_from_slice(&sum.to_le_bytes());
}

#[test]
fn a_bad_policy_is_refused_and_the_status_frame_says_why() {
    let good = model("inverted-pendulum-v5").to_vec();
    let changed = |f: &dyn Fn(&mut Vec<u8>)| {
        let mut image = good.clone();
        f(&mut image);
        image
    };
    let tests = u32::from_le_bytes(good[64 + 40..64 + 44].try_into().unwrap()) as usize;
    let obs_dim = usize::from(Policy::load(&AlignedImage::new(&good)).unwrap().spec().obs_dim);
    let latent = tests + 16 + 4 * obs_dim;
    let cases = [
        (vec![0xFF; 4096], Fault::PolicyLoad, Reason::Erased),
        (changed(&|i| i[..4].copy_from_slice(b"\x7FELF")), Fault::PolicyLoad, Reason::NotAPolicy),
        (changed(&|i| i[9] = 0x7F), Fault::PolicyLoad, Reason::HeaderChecksum),
        (changed(&|i| i.truncate(20_000)), Fault::PolicyLoad, Reason::Checksum),
        (changed(&|i| i[1000] ^= 1), Fault::PolicyLoad, Reason::Checksum),
        (
            changed(&|i| {
                i[8] = 99;
                fix_checksums(i);
            }),
            Fault::PolicyLoad,
            Reason::Version,
        ),
        (
            changed(&|i| {
                i[latent] ^= 1;
                fix_checksums(i);
            }),
            Fault::PolicySelfTest,
            Reason::SelfTest,
        ),
    ];
    let board = board(Machine::Mps2An386, "");
    for (image, fault, reason) in cases {
        let mut peer = Peer::connect(&board, &image, &NodeConfig::default());
        let beat = peer.heartbeat(State::NoPolicy);
        assert_eq!(beat.fault, fault.code(), "{reason:?}");
        assert_eq!((beat.page, beat.value & 0xFF), (Page::PolicyError.code(), u32::from(reason.code())), "{reason:?}");
        peer.send(Mode { command: ModeCommand::Run, node: 1 }.frame());
        peer.send(Mode { command: ModeCommand::Reset, node: 1 }.frame());
        assert_eq!(peer.heartbeat(State::NoPolicy).fault, fault.code(), "it does not run");
    }
}

/// Flashed as `gadm image` packs it: the file says where it goes, and QEMU's loader reads it.
#[test]
fn a_policy_in_an_intel_hex_file_boots_and_runs() {
    let image = model("inverted-pendulum-v5");
    let crc = Policy::load(&image).unwrap().header().payload_crc32;
    let policy = PolicyImage::check(&image).unwrap();
    for machine in Machine::ALL {
        let slot = machine.addresses().0;
        let options = EncodeOptions { address: Some(slot), ..EncodeOptions::default() };
        let hex = Format::Hex.encode(&policy, &options).unwrap();
        let mut peer = Peer::connect(&board(machine, ""), &hex, &NodeConfig::default());
        assert_eq!(peer.heartbeat(State::Ready).fault, Fault::None.code(), "{machine}");
        assert_eq!(peer.page(Page::PolicyCrc), crc, "{machine}");
        peer.send(Mode { command: ModeCommand::Run, node: 1 }.frame());
        peer.heartbeat(State::Run);
        // The same file for another address leaves the slot erased.
        let options = EncodeOptions { address: Some(slot + 0x2_0000), ..EncodeOptions::default() };
        let beside = Format::Hex.encode(&policy, &options).unwrap();
        let beat = Peer::connect(&board(machine, ""), &beside, &NodeConfig::default()).heartbeat(State::NoPolicy);
        assert_eq!(beat.value & 0xFF, u32::from(Reason::Erased.code()), "{machine}");
    }
}

#[test]
fn a_hanging_program_is_restarted_by_the_watchdog_and_says_so() {
    let image = model("inverted-pendulum-v5");
    let mut peer = Peer::connect(&board(Machine::Mps2An386, "-hang"), &image, &NodeConfig::default());
    assert_eq!(peer.heartbeat(State::Ready).fault, Fault::None.code());
    peer.send(Request { node: 1, op: 0x7F, page: 0, tag: 1, value: 0 }.frame());
    peer.heartbeat(State::Boot);
    assert_eq!(peer.heartbeat(State::Ready).fault, Fault::Restarted.code());
    peer.send(Mode { command: ModeCommand::Run, node: 1 }.frame());
    assert_eq!(peer.heartbeat(State::Run).fault, Fault::None.code(), "until the first RUN");
    drop(peer.emulator);
}

#[test]
fn with_the_boards_timer_silence_leads_to_safe() {
    let image = model("inverted-pendulum-v5");
    let config = NodeConfig { time: TimeSource::Local, node: NodeId::new(5).unwrap(), ..NodeConfig::default() };
    for machine in [Machine::Mps2An386, Machine::Mps2An500] {
        let mut peer = Peer::connect(&board(machine, ""), &image, &config);
        peer.heartbeat(State::Ready);
        let later = peer.heartbeat(State::Ready);
        assert_eq!((later.node, later.fault), (5, 0), "heartbeats come by themselves");
        peer.send(Mode { command: ModeCommand::Run, node: 5 }.frame());
        peer.heartbeat(State::Run);
        assert_eq!(peer.heartbeat(State::Safe).fault, Fault::ObservationLost.code());
    }
}

/// The same policy with a sequence number that much higher.
fn successor(policy: &[u8], by: u32) -> Vec<u8> {
    let mut new = policy.to_vec();
    let seq = u32::from_le_bytes(new[32..36].try_into().unwrap()) + by;
    new[32..36].copy_from_slice(&seq.to_le_bytes());
    fix_checksums(&mut new);
    new
}

#[test]
fn a_policy_comes_over_the_bus_and_the_one_before_stays_in_its_slot() {
    let old = model("inverted-pendulum-v5");
    let new = successor(&old, 1);
    let mut peer = Peer::connect(&board(Machine::Mps2An386, ""), &old, &NodeConfig::default());
    peer.heartbeat(State::Ready);
    let options = InstallOptions { node: NodeId::DEFAULT, fd: true, anew: false, activate: true };
    let done = install(peer.bus.as_mut(), "uart", options, &new, &mut |_| {}).unwrap();
    assert_eq!((done.slot, done.resumed_at, done.bytes), (1, 0, new.len() as u32));
    let [first, second, running, trial] = peer.page(Page::Slots).to_le_bytes();
    assert_eq!([first, second].map(SlotState::from_code), [Some(SlotState::Flashed), Some(SlotState::Confirmed)]);
    assert_eq!((running, trial), (1, 0));
    // An older one is refused, and says what to do.
    let error = install(peer.bus.as_mut(), "uart", options, &old, &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("refused END") && error.contains("sequence number"), "{error}");
    // The new one boots by itself.
    peer.send(Mode { command: ModeCommand::Reset, node: 1 }.frame());
    peer.heartbeat(State::Ready);
    assert_eq!(peer.page(Page::Slot), 1);
    // A board whose flash cannot be written says so.
    let mut peer = Peer::connect(&board(Machine::NetduinoPlus2, ""), &old, &NodeConfig::default());
    peer.heartbeat(State::Ready);
    let error = install(peer.bus.as_mut(), "uart", options, &new, &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("no slot that it can write"), "{error}");
}

#[test]
fn the_program_flashes_a_board_over_its_uart() {
    let old = model("inverted-pendulum-v5");
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, image: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, image).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let (old_file, new_file) = (file("old.bin", &old), file("new.bin", &successor(&old, 1)));
    let newest = file("newest.bin", &successor(&old, 2));
    let emulator = board(Machine::Mps2An386, "").power_on(&old, &NodeConfig::default()).unwrap();
    let uart = format!("unix:{}", emulator.socket().display());
    let flash = |policy: &str, more: &[&str]| sim(&[&["flash", policy, "--connect", &uart][..], more].concat());

    let out = flash(&new_file, &["--json"]);
    assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
    let done: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    let expected = serde_json::json!({ "version": 1, "node": 1, "slot": 1, "bytes": old.len(), "resumed_at": 0,
                                       "state": "confirmed" });
    assert_eq!(done, expected);

    let out = flash(&old_file, &[]);
    assert_eq!(out.status.code(), Some(1), "an older one: {}", stderr(&out));
    assert!(stderr(&out).contains("sequence number"), "{}", stderr(&out));
    // Into the other slot, in classic frames, and only that; what is there already is not sent again.
    for resumed in ["; staged", "were there already; staged"] {
        let out = flash(&newest, &["--classic", "--stage"]);
        assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
        assert!(stderr(&out).contains("bytes in slot 0") && stderr(&out).contains(resumed), "{}", stderr(&out));
    }
    let out = flash(&file("cut.bin", &old[..1000]), &[]);
    assert_eq!(out.status.code(), Some(1), "no policy: {}", stderr(&out));

    let bus = open(&Address::Unix(emulator.socket().to_owned()), BitRate::default()).unwrap();
    let mut peer = Peer { bus, emulator };
    let [first, second, running, trial] = peer.page(Page::Slots).to_le_bytes();
    assert_eq!([first, second].map(SlotState::from_code), [Some(SlotState::Staged), Some(SlotState::Confirmed)]);
    assert_eq!((running, trial), (1, 0));
}

/// Observations of all kinds: uniform over the declared ranges and beyond, extreme, and from episodes of the policy.
fn observations(policy: &Policy, plant: &str, count: usize) -> Vec<Vec<f32>> {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let ranges: Vec<_> = policy.observation_signals().map(|s| (s.lo, s.hi)).collect();
    let extremes =
        [0.0, -0.0, f32::MAX, f32::MIN, f32::MIN_POSITIVE, -f32::MIN_POSITIVE, f32::from_bits(1), 1e30, -1e-30, 1.0];
    let mut all: Vec<Vec<f32>> = Vec::new();
    while all.len() < count * 2 / 5 {
        let wide = if all.len().is_multiple_of(2) { 1.0 } else { 3.0 };
        all.push(ranges.iter().map(|&(lo, hi)| lo + (hi - lo) * (0.5 + wide * (rng.random::<f32>() - 0.5))).collect());
    }
    while all.len() < count / 2 {
        let mut one = |&(lo, hi): &(f32, f32)| match rng.random_range(0..12_usize) {
            10 => lo,
            11 => hi,
            n => extremes[n],
        };
        all.push(ranges.iter().map(&mut one).collect());
    }
    let mut env = gadm_envs::make(plant).unwrap();
    let mut memory = vec![0; policy.spec().scratch_words];
    let (mut obs, mut action) = (vec![0.0; ranges.len()], vec![0.0; usize::from(policy.spec().action_dim)]);
    for seed in 0.. {
        env.reset(seed, &mut obs);
        loop {
            all.push(obs.clone());
            if all.len() == count {
                return all;
            }
            policy.act(&obs, &mut Scratch::new(&mut memory), &mut action).unwrap();
            let step = env.step(&action, &mut obs);
            if step.terminated || step.truncated {
                break;
            }
        }
    }
    all
}

/// What `vectors.rs` of the firmware writes.
fn decisions(policy: &Policy, observations: &[Vec<f32>]) -> Vec<u8> {
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut action = vec![0.0; usize::from(policy.spec().action_dim)];
    let mut out = Vec::new();
    for obs in observations {
        let d = policy.act(obs, &mut Scratch::new(&mut memory), &mut action).unwrap();
        out.extend(d.latent.to_le_bytes());
        out.extend([u8::from(d.fallback), u8::from(d.clipped)]);
        for word in 0..8_u16 {
            let bits = (0..32).filter(|bit| d.allowed.contains(32 * word + bit)).fold(0_u32, |b, bit| b | 1 << bit);
            out.extend(bits.to_le_bytes());
        }
        out.extend(action.iter().flat_map(|a| a.to_le_bytes()));
    }
    out
}

fn same_decisions(name: &str, plant: &str, count: usize) {
    let image = model(name);
    let policy = Policy::load(&image).unwrap();
    let observations = observations(&policy, plant, count);
    assert_eq!(observations.len(), count);
    let expected = decisions(&policy, &observations);
    let input: Vec<u8> = observations.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
    for machine in [Machine::Mps2An386, Machine::Mps2An500] {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("vectors.in"), &input).unwrap();
        std::fs::write(folder.path().join("policy.bin"), &image[..]).unwrap();
        let status = std::process::Command::new("qemu-system-arm")
            .current_dir(folder.path())
            .args(["-M", machine.name(), "-display", "none", "-monitor", "none", "-serial", "none"])
            .args(["-semihosting-config", "enable=on,target=native", "-kernel"])
            .arg(board(machine, "-vectors").firmware.canonicalize().unwrap())
            .args(["-device", &format!("loader,file=policy.bin,addr={:#x},force-raw=on", machine.addresses().0)])
            .status()
            .unwrap();
        assert!(status.success(), "{machine}: {status}");
        let found = std::fs::read(folder.path().join("vectors.out")).unwrap();
        let record = expected.len() / count;
        let differs = expected.chunks(record).zip(found.chunks(record)).position(|(a, b)| a != b);
        assert_eq!(differs, None, "{machine}, {name}: observation {:?}", differs.map(|i| &observations[i]));
        assert_eq!(found.len(), expected.len(), "{machine}, {name}");
    }
}

#[test]
fn ten_thousand_observations_give_the_same_latents_masks_and_action_bits_on_host_m4_and_m7() {
    same_decisions("inverted-pendulum-v5", "inverted-pendulum-v5", 4000);
    same_decisions("moving", "moving", 3000);
    same_decisions("hopper-v5", "hopper-v5", 3000);
}
