//! `gadm doctor`.

use std::path::Path;
use std::process::{Command, ExitCode};

use gadm_trainer::runner::origin::machine;
use serde_json::json;

use super::{ENVIRONMENT_LACKING, print, print_json};

/// Arguments of `doctor`.
#[derive(clap::Args)]
#[command(
    after_help = "Each line says what is there, or how to get it. Exit code 4 where something needed is missing."
)]
pub struct Args {
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

struct Finding {
    what: &'static str,
    needed: bool,
    ok: bool,
    text: String,
}

fn runs(program: &str, arguments: &[&str]) -> Option<String> {
    let out = Command::new(program).args(arguments).output().ok().filter(|o| o.status.success())?;
    Some(String::from_utf8_lossy(&out.stdout).lines().next().unwrap_or_default().trim().to_owned())
}

/// Whether an environment of that physics engine is in this build and gives numbers.
fn physics(what: &'static str, env: &str, needed: bool) -> Finding {
    let (ok, text) = match gadm_envs::make(env) {
        Ok(mut env) => {
            let mut obs = vec![0.0; env.spec().obs_dim()];
            env.reset(0, &mut obs);
            (obs.iter().all(|o| o.is_finite()), "steps a model".to_owned())
        }
        Err(error) => (false, error.to_string()),
    };
    Finding { what, needed, ok, text }
}

fn program(what: &'static str, name: &str, arguments: &[&str], fix: &str) -> Finding {
    let found = runs(name, arguments);
    Finding { what, needed: false, ok: found.is_some(), text: found.unwrap_or_else(|| fix.to_owned()) }
}

fn target(triple: &'static str) -> Finding {
    let installed = Command::new("rustup").args(["target", "list", "--installed"]).output().ok();
    let ok = installed.is_some_and(|o| String::from_utf8_lossy(&o.stdout).lines().any(|l| l == triple));
    let text = if ok { "installed".to_owned() } else { format!("for device builds: rustup target add {triple}") };
    Finding { what: triple, needed: false, ok, text }
}

/// Runs `doctor`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let can = Path::new("/proc/net/can").exists();
    let findings = [
        physics("MuJoCo physics", "inverted-pendulum-v5", true),
        physics("Box2D physics", "lunar-lander", false),
        program("git", "git", &["--version"], "for commits in cards: apt install git"),
        program("python3", "python3", &["--version"], "for `make setup`: apt install python3 python3-pip"),
        target("thumbv7em-none-eabihf"),
        Finding {
            what: "SocketCAN",
            needed: false,
            ok: can,
            text: if can {
                "the kernel has CAN".to_owned()
            } else {
                "not in this kernel; the in-process bus needs none".to_owned()
            },
        },
        program("QEMU for Arm", "qemu-system-arm", &["--version"], "for emulated boards: apt install qemu-system-arm"),
    ];
    let ok = findings.iter().all(|f| f.ok || !f.needed);
    if args.json {
        let rows: Vec<_> = findings
            .iter()
            .map(|f| json!({ "what": f.what, "ok": f.ok, "needed": f.needed, "text": f.text }))
            .collect();
        print_json(&json!({ "version": 1, "ok": ok, "machine": machine(), "findings": rows }))?;
    } else {
        let lines = findings.iter().map(|f| {
            let mark = if f.ok {
                "ok"
            } else if f.needed {
                "MISSING"
            } else {
                "-"
            };
            format!("{:24} {mark:8} {}", f.what, f.text)
        });
        print(&format!("{}\n{}", machine(), lines.collect::<Vec<_>>().join("\n")))?;
    }
    Ok(if ok { ExitCode::SUCCESS } else { ExitCode::from(ENVIRONMENT_LACKING) })
}
