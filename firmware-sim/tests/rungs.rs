//! The same run on every rung that needs nothing of the machine: node and plant in one process, and in several over a
//! hub. Same trace, byte for byte, whoever else is on the bus. SocketCAN is in `tests/guest`.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::Value;
use support::program::{Running, SIM, policy_file, sim, start, stderr};

/// A hub in a process of its own, and where it listens: unix socket, TCP, pseudo-terminal.
fn hub(dir: &Path, more: &[&str]) -> (Running, [String; 3]) {
    let socket = dir.join("bus.sock");
    let mut args =
        vec!["bus", "hub", "--unix", socket.to_str().unwrap(), "--tcp", "127.0.0.1:0", "--pty", "--json", "-q"];
    args.extend(more);
    let mut child = Command::new(SIM).args(&args).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let json: Value = serde_json::from_str(&line).unwrap();
    let ways = [0, 1, 2].map(|i| json["listens"][i].as_str().unwrap().to_owned());
    (Running(child), ways)
}

fn traced(dir: &Path, name: &str, args: &[&str]) -> Vec<u8> {
    let path: PathBuf = dir.join(name);
    let mut all = args.to_vec();
    all.extend(["--trace", path.to_str().unwrap(), "--quiet"]);
    let out = sim(&all);
    assert_eq!(out.status.code(), Some(0), "{args:?}: {}", stderr(&out));
    std::fs::read(path).unwrap()
}

#[test]
fn a_node_in_another_process_leaves_the_trace_of_one_in_process() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    for (id, profile) in [("moving", "fd-f32"), ("pendulum", "classic-i16"), ("inverted-pendulum-v5", "fd-f32")] {
        let policy = policy_file(dir, id, 11);
        let run = ["run", &policy, "--episodes", "2", "--seed", "9", "--profile", profile];
        let here = traced(dir, "a.log", &run);
        assert!(here.len() > 1000);
        let there = traced(dir, "b.log", &[&run[..], &["--bus", "hub"]].concat());
        assert!(here == there, "{id}, {profile}: traces differ");
    }
}

#[test]
fn a_scenario_with_faults_is_the_same_run_on_every_bus() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    policy_file(dir, "pendulum", 7);
    let file = dir.join("bad-bus.toml");
    let text = r#"
        policy = "pendulum-7.bin"
        episodes = 2
        seed = 8
        faults = [
            { layer = "frame", kind = "drop", p = 0.05, only = ["OBS"] },
            { layer = "frame", kind = "corrupt", p = 0.05 },
            { layer = "frame", kind = "duplicate", p = 0.1 },
            { layer = "frame", kind = "reorder", p = 0.1, within = 2 },
            { layer = "frame", kind = "jitter", target = "plant", only = ["ACT"], ticks = 1 },
            { layer = "sensor", kind = "nan", signals = ["angular_velocity"], window = [50, 60] },
        ]
        criteria = { action_bounds = true, max_action_age = 3 }
    "#;
    std::fs::write(&file, text).unwrap();
    let run = ["run", file.to_str().unwrap()];
    let here = traced(dir, "a.log", &run);
    let there = traced(dir, "b.log", &[&run[..], &["--bus", "hub"]].concat());
    assert!(here.len() > 1000 && here == there, "traces differ");
    // What the command line says comes first, and a criterion that is missed has its exit code.
    let other = traced(dir, "c.log", &[&run[..], &["--seed", "9"]].concat());
    assert!(other != here);
    let out = sim(&[&run[..], &["--min-return", "1e9", "--json", "--quiet"]].concat());
    assert_eq!(out.status.code(), Some(3), "{}", stderr(&out));
    assert!(stderr(&out).contains("missed: min_return"), "{}", stderr(&out));
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(json["verdict"]["passed"].as_bool(), Some(false));
    assert!(json["faults"].as_array().unwrap().iter().all(|f| f["injected"].as_u64().unwrap() > 0), "{json}");
}

#[test]
fn every_way_into_a_hub_and_every_next_run_give_the_same_trace() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let policy = policy_file(dir, "moving", 3);
    let here = traced(dir, "a.log", &["run", &policy, "--episodes", "2", "--seed", "1"]);
    let (_hub, [unix, tcp, serial]) = hub(dir, &["--slow", "wait"]);
    for (node, plant) in [(&unix, &unix), (&unix, &tcp), (&tcp, &serial), (&serial, &unix)] {
        let _node = start(&["node", &policy, "--connect", node]);
        // The second run finds the node of the first, which a START makes new.
        for round in 0..2 {
            let plant = ["plant", &policy, "--connect", plant, "--episodes", "2", "--seed", "1"];
            assert!(traced(dir, "b.log", &plant) == here, "node {node}, {plant:?}, round {round}");
        }
    }
}

#[test]
fn a_run_that_is_killed_takes_its_node_along() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let policy = policy_file(dir, "moving", 3);
    let here = traced(dir, "a.log", &["run", &policy, "--episodes", "2", "--seed", "1"]);
    let (_hub, [unix, _, _]) = hub(dir, &[]);
    let killed = dir.join("killed.log");
    let endless =
        start(&["run", &policy, "--episodes", "1000000", "--bus", &unix, "--trace", killed.to_str().unwrap()]);
    // It runs once the buffer of its trace has been written.
    while std::fs::metadata(&killed).map_or(0, |m| m.len()) == 0 {
        std::thread::sleep(Duration::from_millis(10));
    }
    drop(endless);
    // A second node with the same number would answer too.
    let there = traced(dir, "b.log", &["run", &policy, "--episodes", "2", "--seed", "1", "--bus", &unix]);
    assert!(here == there, "traces differ");
}

#[test]
fn hostile_slow_and_vanishing_members_change_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let policy = policy_file(dir, "pendulum", 5);
    let run = ["--episodes", "3", "--seed", "2"];
    let here = traced(dir, "a.log", &[&["run", &policy][..], &run].concat());
    let log = dir.join("hub.log");
    let (hub, [unix, tcp, _]) = hub(dir, &["--queue", "300", "--trace", log.to_str().unwrap()]);
    let path = unix.strip_prefix("unix:").unwrap();
    let address = tcp.strip_prefix("tcp:").unwrap();
    // Opens the channel and never reads: its queue and both socket buffers fill up.
    let mut slow = UnixStream::connect(path).unwrap();
    slow.write_all(b"O\r").unwrap();
    // Writes what is no SLCAN, without end, and does not read the answers; then with a line end at times.
    let noise = std::thread::spawn({
        let address = address.to_owned();
        move || {
            let mut member = TcpStream::connect(address).unwrap();
            member.set_write_timeout(Some(Duration::from_millis(200))).unwrap();
            let mut state = 1_u32;
            let end = b"t1239\r\x00\xFFT\r";
            let mut wrote = 0;
            for _ in 0..300 {
                let junk: Vec<u8> = (0..997)
                    .map(|_| {
                        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                        (state >> 24) as u8
                    })
                    .filter(|b| !b"tTrRdDbBO".contains(b)) // never a frame by chance
                    .collect();
                // The hub does not wait for who does not read.
                wrote += member.write(&junk).unwrap_or(0) + member.write(end).unwrap_or(0);
            }
            wrote
        }
    });
    // Come and go in the middle of a line.
    let visitors = std::thread::spawn({
        let path = path.to_owned();
        move || {
            for i in 0..100 {
                let mut member = UnixStream::connect(&path).unwrap();
                member.write_all(&b"O\rb12"[..i % 6]).unwrap();
                std::thread::sleep(Duration::from_millis(3));
            }
        }
    });
    let _node = start(&["node", &policy, "--connect", &unix]);
    let there = traced(dir, "b.log", &[&["plant", &policy, "--connect", &tcp][..], &run].concat());
    assert!(here == there, "traces differ");
    assert!(noise.join().unwrap() > 10_000);
    visitors.join().unwrap();
    drop(hub);
    // What the slow one can still read is whole lines, and it lost the rest.
    slow.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    let mut bytes = Vec::new();
    let _ = slow.read_to_end(&mut bytes);
    let lines = bytes.split(|&b| b == b'\r').count() - 1;
    let frames = here.split(|&b| b == b'\n').count() - 1;
    assert!(lines > 100 && lines < frames + 10_000, "{lines} of {frames}");
}

#[test]
fn a_hub_is_for_this_machine_unless_told_otherwise_and_for_so_many() {
    let out = sim(&["bus", "hub", "--tcp", "0.0.0.0:0"]);
    assert_eq!(out.status.code(), Some(1));
    for word in ["0.0.0.0", "other machines", "--allow-remote"] {
        assert!(stderr(&out).contains(word), "{}", stderr(&out));
    }
    for nowhere in [&["bus", "hub"][..], &["bus", "hub", "--quiet"], &["bus", "hub", "--trace", "x.log"]] {
        let out = sim(nowhere);
        assert_eq!(out.status.code(), Some(2), "{nowhere:?}: a hub that nobody can reach: {}", stderr(&out));
        assert!(stderr(&out).contains("--socketcan"), "{}", stderr(&out));
    }
    let dir = tempfile::tempdir().unwrap();
    let (_hub, [unix, _, _]) = hub(dir.path(), &["--members", "2"]); // the pseudo-terminal is one
    let path = unix.strip_prefix("unix:").unwrap();
    let out = sim(&["bus", "hub", "--unix", path]);
    assert!(stderr(&out).contains("another program listens there"), "{}", stderr(&out));
    // That hub looked whether somebody listens; until its visit has been noticed there is no room for us.
    let version = || -> std::io::Result<usize> {
        let mut member = UnixStream::connect(path)?;
        member.set_read_timeout(Some(Duration::from_secs(5)))?;
        member.write_all(b"V\r")?;
        let n = member.read(&mut [0; 16])?;
        if n > 0 {
            let mut third = UnixStream::connect(path)?;
            assert_eq!(third.read(&mut [0; 1])?, 0, "a third member was let in");
        }
        Ok(n)
    };
    let answered = (0..50).any(|_| {
        std::thread::sleep(Duration::from_millis(20));
        version().is_ok_and(|n| n == 6)
    });
    assert!(answered);
}

#[test]
fn what_does_not_fit_together_is_named_with_the_fix() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let (one, two) = (policy_file(dir, "moving", 1), policy_file(dir, "moving", 2));
    let out = sim(&["run", &one, "--bus", "unix:/nowhere/bus.sock"]);
    assert!(stderr(&out).contains("unix:/nowhere/bus.sock: cannot join the bus"), "{}", stderr(&out));
    let out = sim(&["run", &one, "--bus", "can0"]);
    assert_eq!(out.status.code(), Some(2));
    assert!(stderr(&out).contains("socketcan:vcan0"), "{}", stderr(&out));
    let (_hub, [unix, tcp, _]) = hub(dir, &[]);
    let _node = start(&["node", &one, "--connect", &unix]);
    for (args, words) in [
        (&["plant", &two, "--connect", &tcp][..], "another policy"),
        (&["plant", &one, "--connect", &tcp, "--profile", "classic-i16"], "--profile"),
        (&["plant", &one, "--connect", &tcp, "--realtime"], "--realtime"),
    ] {
        let out = sim(args);
        assert_eq!(out.status.code(), Some(1), "{args:?}");
        assert!(stderr(&out).contains(words), "{args:?}: {}", stderr(&out));
    }
}

#[test]
fn real_time_measures_and_does_not_judge() {
    let dir = tempfile::tempdir().unwrap();
    let policy = policy_file(dir.path(), "moving", 3);
    for bus in [&[][..], &["--bus", "hub"]] {
        let args = [&["run", &policy, "--episodes", "1", "--realtime", "4", "--json"][..], bus].concat();
        let out = sim(&args);
        assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
        assert!(stderr(&out).contains("latency") && stderr(&out).contains("jitter"), "{}", stderr(&out));
        let json: Value = serde_json::from_slice(&out.stdout).unwrap();
        let (timing, steps) = (&json["timing"], json["steps"].as_u64().unwrap());
        assert_eq!(timing["factor"].as_f64(), Some(4.0));
        assert!(timing["periods"].as_u64().unwrap() >= steps);
        assert!(timing["latency_us"]["n"].as_u64().unwrap() + timing["unanswered"].as_u64().unwrap() >= steps);
        assert!(timing["latency_us"]["p50"].as_f64().unwrap() > 0.0);
    }
}
