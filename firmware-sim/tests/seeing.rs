//! What people look at: reports, the monitor, doctor, completions, manual pages.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use support::program::{sim, stderr, stdout};
use support::random_policy;

/// A policy for `id`, and the trace, report and result of a run with it.
struct Ran {
    policy: String,
    trace: String,
    html: String,
    result: Value,
}

fn run(dir: &Path, id: &str, more: &[&str]) -> Ran {
    let path = |name: &str| dir.join(name).to_str().unwrap().to_owned();
    let (policy, trace, report) = (path("policy.bin"), path("run.log"), path("report.html"));
    std::fs::write(&policy, random_policy(gadm_envs::make(id).unwrap().spec(), 11).as_bytes()).unwrap();
    let mut args = vec!["run", &policy, "--episodes", "3", "--json", "--trace", &trace, "--report", &report];
    args.extend(more);
    let out = sim(&args);
    assert!(matches!(out.status.code(), Some(0 | 3)), "{}", stderr(&out));
    let html = std::fs::read_to_string(&report).unwrap();
    Ran { result: serde_json::from_slice(&out.stdout).unwrap(), html, policy, trace }
}

/// The page less the letters of its embedded pictures, which may spell anything.
fn without_pictures(html: &str) -> String {
    let parts = html.split(";base64,").enumerate();
    parts.map(|(i, part)| if i == 0 { part } else { part.split_once('"').unwrap().1 }).collect()
}

#[test]
fn a_report_says_first_whether_the_run_was_good() {
    let dir = tempfile::tempdir().unwrap();
    let ran = run(dir.path(), "pendulum", &["--min-return", "1e6"]);
    let missed = ran.html.find("<strong>Missed</strong> 1 of 1 criteria missed").unwrap();
    assert!(missed < ran.html.find("<section").unwrap());
    assert!(ran.html.contains("<td>min_return</td>"), "the table of criteria");
    let ran = run(dir.path(), "pendulum", &["--min-return", "-1e6"]);
    assert!(ran.html.contains("<strong>Met</strong> All 1 criteria hold"));
    let ran = run(dir.path(), "pendulum", &[]);
    assert!(ran.html.contains("<strong>Note</strong> No criterion was given"));
}

#[test]
fn a_report_shows_what_happened_and_needs_nothing_else() {
    for (id, profile) in [("pendulum", "fd-f32"), ("sliding", "classic-i16"), ("hard-move-4", "fd-f32")] {
        let dir = tempfile::tempdir().unwrap();
        let Ran { html, policy, .. } = run(dir.path(), id, &["--profile", profile, "--seed", "5"]);
        for title in [
            "Return of the first episode so far",
            "Actions of the first episode",
            "Latents of the first episode",
            "States, flags and faults of the first episode",
            "Return of each episode",
            "How often each latent was chosen",
        ] {
            assert!(html.contains(&format!("<title>{title}</title>")), "{id}: {title}");
        }
        assert!(html.contains("src=\"data:image/gif;base64,R0lGODlh"), "{id}: the film");
        assert!(html.contains("<title>RUN</title>"), "{id}: the node's state");
        let command = format!("gadm-sim run {policy} --episodes 3");
        assert!(html.contains(&command) && html.contains("--seed 5"), "{id}: the command");
        let text = without_pictures(&html);
        for word in ["http:", "https:", "<script", "NaN", "href="] {
            assert!(!text.contains(word), "{id}: {word}");
        }
        assert!(!html.contains("it told none"), "{id}: every period has its latent");
    }
}

#[test]
fn a_report_of_a_run_in_real_time_has_its_histograms() {
    let dir = tempfile::tempdir().unwrap();
    let Ran { html, result, .. } = run(dir.path(), "pendulum", &["--realtime", "100"]);
    for what in ["latency", "jitter"] {
        assert!(html.contains(&format!("<title>Histogram of the {what}</title>")), "{what}");
        let times = &result["timing"][format!("{what}_us")];
        let counts = times["histogram"].as_array().unwrap().iter().map(|bin| bin["count"].as_u64().unwrap());
        assert_eq!(Some(counts.sum::<u64>()), times["n"].as_u64(), "{what}");
        assert!(times["n"].as_u64() >= result["steps"].as_u64(), "{what}");
    }
    let html = run(dir.path(), "pendulum", &[]).html;
    assert!(!html.contains("Histogram"), "in lockstep there is nothing to measure");
}

#[test]
fn a_report_does_not_change_a_run() {
    let dir = tempfile::tempdir().unwrap();
    let ran = run(dir.path(), "moving", &[]);
    let with = std::fs::read(&ran.trace).unwrap();
    let out = sim(&["run", &ran.policy, "--episodes", "3", "--trace", &ran.trace, "--json", "-q"]);
    assert_eq!(serde_json::from_slice::<Value>(&out.stdout).unwrap(), ran.result);
    assert_eq!(std::fs::read(&ran.trace).unwrap(), with);
}

#[test]
fn a_film_of_a_run_is_an_animated_gif_of_the_asked_width() {
    let dir = tempfile::tempdir().unwrap();
    let film = dir.path().join("film.gif");
    let words = ["--film", film.to_str().unwrap(), "--film-width", "120"];
    let plain = run(dir.path(), "pendulum", &[]);
    let filmed = run(dir.path(), "pendulum", &words);
    assert_eq!(plain.result, filmed.result, "it only looks on");
    let bytes = std::fs::read(&film).unwrap();
    assert_eq!((&bytes[..6], u16::from_le_bytes([bytes[6], bytes[7]])), (&b"GIF89a"[..], 120));
    let frames = bytes.windows(3).filter(|w| *w == [0x21, 0xF9, 4]).count();
    assert!(frames > 20, "{frames} frames");
}

#[test]
fn a_report_that_cannot_be_written_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let ran = run(dir.path(), "pendulum", &[]);
    let out = sim(&["run", &ran.policy, "--episodes", "1", "--report", "/nowhere/r.html"]);
    assert_eq!(out.status.code(), Some(1));
    assert!(stderr(&out).contains("cannot write /nowhere/r.html"), "{}", stderr(&out));
}

#[test]
fn the_monitor_counts_what_is_in_a_trace() {
    let dir = tempfile::tempdir().unwrap();
    for profile in ["fd-f32", "classic-i16"] {
        let Ran { policy, trace, result, .. } = run(dir.path(), "moving", &["--profile", profile]);
        let out = sim(&["bus", "monitor", "--trace", &trace, "--policy", &policy, "--once", "--json"]);
        assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
        let picture: Value = serde_json::from_slice(&out.stdout).unwrap();
        assert_eq!((&picture["version"], &picture["profile"]), (&1.into(), &profile.into()));
        assert_eq!(picture["frames"], result["bus"]["frames"]);
        assert_eq!(picture["latent_counts"], result["latent_counts"]);
        assert_eq!(picture["nodes"][0]["node"], 1);
        let rows = picture["rows"].as_array().unwrap();
        let ticks = rows.iter().find(|r| r["name"] == "TICK").unwrap();
        assert_eq!((&ticks["frames"], &ticks["gaps"]["missing"]), (&result["steps"], &0.into()));
        assert!(rows.iter().all(|r| r["errors"] == 0 && r["gaps"]["missing"] == 0), "{rows:#?}");
        let text = stdout(&sim(&["bus", "monitor", "--trace", &trace, "--policy", &policy, "--once"]));
        for word in ["TICK", "HEARTBEAT", "latents", "node 1", "load "] {
            assert!(text.contains(word), "{word}:\n{text}");
        }
        // Without a policy, and with a frame cut out and a line that is none.
        let log = std::fs::read_to_string(&trace).unwrap();
        let tick = log.lines().position(|l| l.contains(" 080#")).unwrap() + 40;
        let cut = log.lines().skip(tick).position(|l| l.contains(" 080#")).unwrap() + tick;
        let lines: Vec<&str> =
            log.lines().enumerate().map(|(i, l)| if i == cut { "what is this" } else { l }).collect();
        std::fs::write(&trace, lines.join("\n")).unwrap();
        let out = sim(&["bus", "monitor", "--trace", &trace, "--once", "--json"]);
        let picture: Value = serde_json::from_slice(&out.stdout).unwrap();
        let rows = picture["rows"].as_array().unwrap();
        let ticks = rows.iter().find(|r| r["name"] == "TICK").unwrap();
        assert_eq!((&ticks["gaps"]["missing"], &picture["bad_lines"]), (&1.into(), &1.into()));
        assert!(stderr(&out).contains(&format!("line {}", cut + 1)), "{}", stderr(&out));
    }
}

#[test]
fn the_monitor_says_what_it_cannot_do() {
    let cases: [(&[&str], i32, &str); 5] = [
        (&["bus", "monitor"], 2, "<BUS>"),
        (&["bus", "monitor", "nonsense"], 2, "unix:PATH"),
        (&["bus", "monitor", "--trace", "/nowhere/x.log", "--once"], 1, "cannot read /nowhere/x.log"),
        (&["bus", "monitor", "unix:/nowhere/x", "--once"], 1, "cannot join unix:/nowhere/x"),
        (&["bus", "monitor", "--trace", "Cargo.toml"], 1, "--once"),
    ];
    for (args, code, word) in cases {
        let out = sim(args);
        assert_eq!(out.status.code(), Some(code), "{args:?}: {}", stderr(&out));
        assert!(stderr(&out).contains(word), "{args:?}: {}", stderr(&out));
    }
}

#[test]
fn doctor_has_a_fix_for_everything_that_is_missing() {
    let out = sim(&["doctor", "--json"]);
    let report: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(out.status.code(), Some(if report["ok"] == true { 0 } else { 4 }));
    let findings = report["findings"].as_array().unwrap();
    for what in
        ["MuJoCo physics", "SocketCAN", "vcan", "QEMU for Arm", "thumbv7em-none-eabihf", "browser", "python-can"]
    {
        let finding = findings.iter().find(|f| f["what"] == what).unwrap_or_else(|| panic!("{what}"));
        let ok = finding["ok"].as_bool().unwrap();
        assert!(!finding["text"].as_str().unwrap().is_empty(), "{what}");
        assert_eq!(finding["fix"].is_null(), ok, "{finding}");
        assert!(ok || finding["fix"].as_str().is_some_and(|fix| fix.len() > 10), "{finding}");
    }
    let text = stdout(&sim(&["doctor"]));
    assert!(findings.iter().all(|f| text.contains(f["what"].as_str().unwrap())), "{text}");
}

#[test]
fn completions_and_manual_pages_know_every_command() {
    let help = stdout(&sim(&["--help"]));
    let commands: Vec<&str> = help
        .lines()
        .skip_while(|l| !l.starts_with("Commands:"))
        .skip(1)
        .take_while(|l| l.starts_with("  "))
        .filter_map(|l| l.strip_prefix("  ").filter(|l| !l.starts_with(' '))?.split_whitespace().next())
        .collect();
    assert!(commands.contains(&"run") && commands.contains(&"doctor"), "{help}");
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let out = sim(&["completions", shell]);
        assert_eq!(out.status.code(), Some(0), "{shell}: {}", stderr(&out));
        let script = stdout(&out);
        assert!(commands.iter().all(|c| script.contains(c)) && script.contains("episodes"), "{shell}");
    }
    let dir = tempfile::tempdir().unwrap();
    let out = sim(&["man", dir.path().join("man1").to_str().unwrap()]);
    assert_eq!(out.status.code(), Some(0), "{}", stderr(&out));
    for command in commands.iter().filter(|c| **c != "help") {
        let page = std::fs::read_to_string(dir.path().join(format!("man1/gadm-sim-{command}.1"))).unwrap();
        assert!(page.contains(".SH SYNOPSIS") || page.contains(".SH NAME"), "{command}");
    }
    let formatter = Command::new("groff").arg("--version").output();
    if formatter.is_ok_and(|out| out.status.success()) {
        for page in std::fs::read_dir(dir.path().join("man1")).unwrap() {
            let path = page.unwrap().path();
            let out = Command::new("groff").args(["-man", "-Tascii", "-ww", "-P-cbou"]).arg(&path).output().unwrap();
            assert!(out.status.success() && out.stderr.is_empty(), "{}: {}", path.display(), stderr(&out));
            let name = path.file_stem().unwrap().to_str().unwrap();
            assert!(stdout(&out).contains(name) && stdout(&out).contains("DESCRIPTION"), "{name}: {}", stdout(&out));
        }
    } else {
        not_run("rendering of the manual pages (no groff here)");
    }
    let out = sim(&["man", "/dev/null/x"]);
    assert_eq!(out.status.code(), Some(1));
    assert!(stderr(&out).contains("cannot write manual pages into /dev/null/x"), "{}", stderr(&out));
}

/// Says it past the test harness's capture, so that what did not run is seen.
fn not_run(what: &str) {
    use std::io::Write as _;
    let _ = writeln!(std::io::stderr(), "not run: {what}");
}

#[test]
fn bash_takes_the_completions() {
    let script = sim(&["completions", "bash"]).stdout;
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("gadm-sim.bash");
    std::fs::write(&file, script).unwrap();
    let line = format!(
        "source {} && f=$(complete -p gadm-sim) && f=${{f#*-F }} && COMP_WORDS=(gadm-sim do) && COMP_CWORD=1 && \
         ${{f%% *}} gadm-sim do gadm-sim && echo \"${{COMPREPLY[@]}}\"",
        file.display()
    );
    let Ok(out) = Command::new("bash").args(["-c", &line]).output() else {
        return not_run("bash_takes_the_completions (no bash here)");
    };
    assert_eq!(stdout(&out).trim(), "doctor", "{}", stderr(&out));
}
