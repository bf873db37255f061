//! The program as people and programs meet it.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use support::direct;
use support::program::{policy_file, sim, stderr};

#[test]
fn run_prints_a_table_for_people_and_json_for_programs() {
    let dir = tempfile::tempdir().unwrap();
    let policy = policy_file(dir.path(), "moving", 11);
    let out = sim(&["run", &policy, "--episodes", "3", "--seed", "9", "--json"]);
    assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
    for word in ["return", "latents used", "bus load", "held, late, safe"] {
        assert!(stderr(&out).contains(word), "{}", stderr(&out));
    }
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!((json["version"].as_u64(), json["plant"].as_str()), (Some(1), Some("moving")));
    let image = std::fs::read(&policy).unwrap();
    let image = gadm_runtime::encode::AlignedImage::new(&image);
    let mut env = gadm_envs::make("moving").unwrap();
    for (i, episode) in json["episodes"].as_array().unwrap().iter().enumerate() {
        let (ret, _) = direct(&image, &mut *env, 9, i as u64);
        assert_eq!(episode["return"].as_f64().unwrap().to_bits(), ret.to_bits());
    }
}

#[test]
fn quiet_is_quiet_and_criteria_have_their_own_exit_code() {
    let dir = tempfile::tempdir().unwrap();
    let policy = policy_file(dir.path(), "moving", 11);
    let out = sim(&["run", &policy, "--episodes", "1", "--quiet"]);
    assert_eq!((out.status.code(), stderr(&out).as_str(), out.stdout.len()), (Some(0), "", 0));
    let out = sim(&["run", &policy, "--episodes", "1", "--min-return", "1e9"]);
    assert_eq!(out.status.code(), Some(3));
    assert!(stderr(&out).contains("missed: min_return: required"), "{}", stderr(&out));
    let out = sim(&["run", &policy, "--episodes", "1", "--min-return", "-1e9"]);
    assert_eq!(out.status.code(), Some(0));
}

#[test]
fn errors_say_what_where_and_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let policy = policy_file(dir.path(), "moving", 11);
    let junk = dir.path().join("junk.bin");
    std::fs::write(&junk, b"hello, this is no policy").unwrap();
    let cases: [(&[&str], i32, &[&str]); 8] = [
        (&["run", "/nowhere/p.bin"], 1, &["cannot read /nowhere/p.bin: No such file or directory (os error 2)\n"]),
        (&["run", junk.to_str().unwrap()], 1, &["not a policy", "gadm export"]),
        (&["run", &policy, "--plant", "pendulum"], 1, &["does not fit plant `pendulum`", "--plant moving"]),
        (&["run", &policy, "--plant", "hoper-v5"], 1, &["hoper-v5", "hopper-v5"]),
        (&["run", &policy, "--trace", "/nowhere/t.log"], 1, &["cannot write /nowhere/t.log"]),
        (&["run", &policy, "--profil", "x"], 2, &["--profile"]),
        (&["run", &policy, "--episodes", "0"], 2, &["episodes"]),
        (&["trace", junk.to_str().unwrap(), "--policy", &policy], 1, &["line 1", "time stamp", "candump"]),
    ];
    for (args, code, words) in cases {
        let out = sim(args);
        assert_eq!(out.status.code(), Some(code), "{args:?}: {}", stderr(&out));
        for word in words {
            assert!(stderr(&out).contains(word), "{args:?}: {}", stderr(&out));
        }
        assert!(out.stdout.is_empty());
    }
}

#[test]
fn damaged_policies_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let good = std::fs::read(policy_file(dir.path(), "moving", 11)).unwrap();
    let mut wrong_bit = good.clone();
    wrong_bit[good.len() / 2] ^= 4;
    let mut newer = good.clone();
    newer[8] = 99;
    for (name, bytes) in [("wrong bit", &wrong_bit[..]), ("newer", &newer), ("cut", &good[..100]), ("empty", &[])] {
        let path = dir.path().join("bad.bin");
        std::fs::write(&path, bytes).unwrap();
        let out = sim(&["run", path.to_str().unwrap(), "--episodes", "1"]);
        assert_eq!(out.status.code(), Some(1), "{name}: {}", stderr(&out));
        assert!(stderr(&out).starts_with("error: not a policy that can be run: "), "{name}: {}", stderr(&out));
    }
}

#[test]
fn a_full_disk_is_an_error() {
    if !Path::new("/dev/full").exists() {
        say("not run: a_full_disk_is_an_error (this system has no /dev/full)");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let policy = policy_file(dir.path(), "moving", 11);
    let out = sim(&["run", &policy, "--episodes", "2", "--trace", "/dev/full"]);
    assert_eq!(out.status.code(), Some(1));
    assert!(stderr(&out).contains("cannot write /dev/full"), "{}", stderr(&out));
}

#[test]
fn help_fits_a_terminal_and_shows_examples() {
    for args in [&["--help"][..], &["run", "--help"], &["trace", "--help"]] {
        let out = sim(args);
        let text = String::from_utf8(out.stdout).unwrap();
        assert!(text.lines().all(|l| l.chars().count() <= 80), "{text}");
        assert!(args.len() == 1 || text.contains("Examples:"), "{text}");
        assert!(text.contains("xit codes") || args[0] == "trace", "{text}");
    }
}

#[test]
fn trace_decodes_what_run_wrote() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("run.log");
    let log = log.to_str().unwrap();
    for (profile, id) in [("fd-f32", "inverted-pendulum-v5"), ("classic-i16", "moving")] {
        let policy = policy_file(dir.path(), id, 11);
        let out = sim(&["run", &policy, "--episodes", "2", "--profile", profile, "--trace", log, "--json", "-q"]);
        let run: Value = serde_json::from_slice(&out.stdout).unwrap();
        let out = sim(&["trace", log, "--policy", &policy, "--json"]);
        assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
        let lines: Vec<Value> =
            String::from_utf8(out.stdout).unwrap().lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        assert_eq!(lines.len() as u64, run["bus"]["frames"].as_u64().unwrap());
        assert!(lines.iter().all(|l| l["error"].is_null() && l["name"] != "UNKNOWN"));
        let ticks = lines.iter().filter(|l| l["name"] == "TICK").count() as u64;
        assert_eq!(ticks, run["steps"].as_u64().unwrap());
        if profile == "fd-f32" {
            assert_actions_are_exact(&lines, &policy, id);
        }
        let out = sim(&["trace", log, "--policy", &policy]);
        assert_eq!(String::from_utf8(out.stdout).unwrap().lines().count(), lines.len());
    }
}

/// The decimals that `trace --json` prints read back to the very f32 that the policy computes.
fn assert_actions_are_exact(lines: &[Value], policy: &str, id: &str) {
    let image = gadm_runtime::encode::AlignedImage::new(&std::fs::read(policy).unwrap());
    let mut env = gadm_envs::make(id).unwrap();
    let mut steps = Vec::new();
    for episode in 0..2 {
        steps.extend(direct(&image, &mut *env, 0, episode).1);
    }
    let is_safe = |l: &Value| l["signals"]["flags"].as_array().unwrap().iter().any(|f| f == "safe");
    let acts: Vec<&Value> = lines.iter().filter(|l| l["name"] == "ACT" && !is_safe(l)).collect();
    assert_eq!(acts.len(), steps.len());
    for (line, step) in acts.iter().zip(&steps) {
        assert_eq!(line["signals"]["latent"].as_u64(), Some(u64::from(step.latent)));
        for (signal, value) in env.spec().actions.iter().zip(&step.action) {
            let printed: f32 = line["signals"][&signal.name].to_string().parse().unwrap();
            assert_eq!(printed.to_bits(), value.to_bits(), "{line}");
        }
    }
}

/// A Python that has python-can: the one in the environment variable `PYTHON`, one in the build's target folder (which
/// this makes, once), or none.
fn python_can() -> Result<PathBuf, String> {
    let check = |python: &Path| {
        let out = Command::new(python).args(["-c", "import can; print(can.__version__)"]).output();
        out.is_ok_and(|o| o.status.success())
    };
    let venv = Path::new(env!("CARGO_TARGET_TMPDIR")).join("python-can-4.6.1");
    let python = venv.join("bin/python");
    if check(&python) {
        return Ok(python);
    }
    let run = |program: &Path, args: &[&str]| {
        let out = Command::new(program).args(args).output().map_err(|e| format!("{}: {e}", program.display()))?;
        if out.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&out.stderr).trim().to_owned()) }
    };
    run(Path::new("python3"), &["-m", "venv", venv.to_str().unwrap()])?;
    run(&python, &["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "python-can==4.6.1"])?;
    if check(&python) { Ok(python) } else { Err("python-can was installed but cannot be imported".to_owned()) }
}

fn say(text: &str) {
    use std::io::Write as _;
    // Past the test harness's capture, so that a test that did not run is seen.
    let _ = writeln!(std::io::stderr(), "{text}");
}

const READER: &str = r"
import sys, can
for m in can.CanutilsLogReader(sys.argv[1]):
    print('%d %X %d %d %d %s' % (round(m.timestamp * 1e6), m.arbitration_id, m.is_extended_id, m.is_fd,
                                 m.bitrate_switch, m.data.hex().upper()))
";

#[test]
fn python_can_reads_the_traces() {
    let python = match python_can() {
        Ok(python) => python,
        Err(why) => {
            say(&format!("not run: python_can_reads_the_traces (needs python3 with venv and pip: {why})"));
            return;
        }
    };
    let dir = tempfile::tempdir().unwrap();
    let policy = policy_file(dir.path(), "pendulum", 11);
    for (profile, fd) in [("fd-f32", true), ("classic-i16", false)] {
        let log = dir.path().join(format!("{profile}.log"));
        let log = log.to_str().unwrap();
        let out = sim(&["run", &policy, "--episodes", "2", "--profile", profile, "--trace", log, "-q"]);
        assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
        let out = Command::new(&python).args(["-c", READER, log]).output().unwrap();
        assert!(out.status.success(), "{}", stderr(&out));
        let read = String::from_utf8(out.stdout).unwrap();
        let ours: Vec<String> = std::fs::read_to_string(log)
            .unwrap()
            .lines()
            .map(|line| {
                let record = gadm_sim::bus::trace::parse_line(line).unwrap();
                let frame = record.frame.unwrap();
                let is_fd = matches!(frame.kind(), gadm_node::frame::Kind::Fd { .. });
                let hex = frame.payload().iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().concat();
                let (id, n) = (frame.raw_id(), u8::from(is_fd));
                format!("{} {id:X} 0 {n} {n} {hex}", record.time_us)
            })
            .collect();
        assert!(ours.len() > 800);
        assert_eq!(ours.iter().any(|l| l.split(' ').nth(3) == Some("1")), fd);
        assert_eq!(read.lines().collect::<Vec<_>>(), ours);
    }
}
