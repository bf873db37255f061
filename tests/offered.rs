//! What `gadm` offers people beside its results: completions that shells read, manual pages that can be rendered, films.
//! Those of `gadm-sim` are tested with it.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly, its helpers too")]

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use gadm_integration_tests::programs::program;
use gadm_integration_tests::root;

#[track_caller]
fn gadm(words: &[&str]) -> Output {
    let out = Command::new(program("gadm")).args(words).stdin(Stdio::null()).output().unwrap();
    assert!(out.status.success(), "gadm {words:?}: {}", String::from_utf8_lossy(&out.stderr));
    out
}

/// Runs a tool that this machine may lack; then that is said past the capture of the tests.
fn tool(name: &str, words: &[&str], for_what: &str) -> Option<Output> {
    let out = Command::new(name).args(words).stdin(Stdio::null()).output().ok();
    if out.is_none() {
        let _ = writeln!(std::io::stderr(), "not run: {for_what} (no {name} here)");
    }
    out
}

fn commands() -> Vec<String> {
    let help = String::from_utf8(gadm(&["--help"]).stdout).unwrap();
    let list = help.lines().skip_while(|l| !l.starts_with("Commands:")).skip(1).take_while(|l| l.starts_with("  "));
    let names = list.filter_map(|l| l.strip_prefix("  ").filter(|l| !l.starts_with(' '))?.split_whitespace().next());
    let names: Vec<String> = names.map(str::to_owned).collect();
    assert!(["train", "eval", "export"].iter().all(|c| names.iter().any(|n| n == c)), "{help}");
    names
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn completions_know_every_command_and_shells_read_them() {
    let folder = tempfile::tempdir().unwrap();
    let commands = commands();
    for (shell, check) in [
        ("bash", Some(&["bash", "-n"][..])),
        ("zsh", Some(&["zsh", "-n"])),
        ("fish", Some(&["fish", "--no-execute"])),
        ("elvish", None),
        ("powershell", None),
    ] {
        let script = String::from_utf8(gadm(&["completions", shell]).stdout).unwrap();
        for command in &commands {
            assert!(script.contains(command.as_str()), "{shell}: {command}");
        }
        let Some([name, option]) = check else { continue };
        let file = folder.path().join(shell);
        std::fs::write(&file, script).unwrap();
        if let Some(out) = tool(name, &[option, text(&file)], &format!("completions of gadm read by {shell}")) {
            assert!(out.status.success(), "{shell}: {}", String::from_utf8_lossy(&out.stderr));
        }
    }
}

#[test]
fn every_command_has_a_manual_page_that_can_be_rendered() {
    let folder = tempfile::tempdir().unwrap();
    gadm(&["man", text(folder.path())]);
    for command in commands().iter().filter(|c| *c != "help") {
        let page = folder.path().join(format!("gadm-{command}.1"));
        assert!(page.exists(), "{}", page.display());
        // As `man` calls it.
        let words = ["-Kutf8", "-man", "-Tutf8", "-ww", "-P-cbou", text(&page)];
        let Some(out) = tool("groff", &words, "rendering of the manual pages of gadm") else { return };
        let (said, told) = (String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
        assert!(out.status.success() && told.is_empty(), "{command}: {told}");
        assert!(said.contains(&format!("gadm-{command}")) && said.contains("SYNOPSIS"), "{said}");
    }
}

#[test]
fn an_episode_is_rendered_as_an_animated_gif_of_the_asked_width() {
    let folder = tempfile::tempdir().unwrap();
    let film = folder.path().join("film.gif");
    let policy = root().join("models/moving/policy.bin");
    gadm(&["eval", text(&policy), "--episodes", "1", "--render", text(&film), "--render-width", "160", "--quiet"]);
    let bytes = std::fs::read(&film).unwrap();
    assert_eq!((&bytes[..6], u16::from_le_bytes([bytes[6], bytes[7]])), (&b"GIF89a"[..], 160));
    // A graphic control block a picture.
    let pictures = bytes.windows(3).filter(|w| *w == [0x21, 0xF9, 4]).count();
    assert!(pictures > 5, "{pictures} pictures");
}
