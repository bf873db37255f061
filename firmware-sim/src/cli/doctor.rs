//! `gadm-sim doctor`.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

use serde_json::json;

const EXAMPLES: &str = "\
Examples:
  gadm-sim doctor
  gadm-sim doctor --json | jq '.findings[] | select(.ok | not) | .fix'

Exit codes: 0 ok, 4 something that every run needs is missing.";

/// Arguments of `doctor`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Print as JSON on standard output
    #[arg(long)]
    json: bool,
}

/// What was found about one thing.
struct Finding {
    what: &'static str,
    /// What it is good for.
    for_what: &'static str,
    needed: bool,
    /// What is there, or why it is not.
    found: Result<String, String>,
    /// How to get it.
    fix: String,
}

impl Finding {
    fn new(what: &'static str, for_what: &'static str, found: Result<String, String>, fix: impl Into<String>) -> Self {
        Self { what, for_what, needed: false, found, fix: fix.into() }
    }
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let mut findings = vec![mujoco(), box2d(), socketcan(), vcan(), can_interfaces(), serial(), can_utils()];
    findings.push(program(
        "QEMU for Arm",
        "nodes on an emulated board",
        &["qemu-system-arm"],
        "apt-get install -y qemu-system-arm",
    ));
    findings.push(program(
        "QEMU for x86",
        "SocketCAN tests in a guest, where this kernel has no CAN",
        &["qemu-system-x86_64"],
        "apt-get install -y qemu-system-x86",
    ));
    findings.extend(["thumbv7em-none-eabihf", "thumbv7m-none-eabi"].map(rust_target));
    findings.extend([
        python("python-can", "can", "the tests with python-can"),
        python("cantools", "cantools", "the tests with cantools"),
    ]);
    findings.push(program(
        "browser",
        "reports; any browser on any machine will do",
        &["chromium", "chromium-browser", "google-chrome", "firefox"],
        "apt-get install -y chromium",
    ));
    let ok = findings.iter().all(|f| f.found.is_ok() || !f.needed);
    let mut out = std::io::stdout().lock();
    if args.json {
        let rows: Vec<_> = findings
            .iter()
            .map(|f| {
                let (Ok(text) | Err(text)) = &f.found;
                let fix = f.found.is_err().then_some(&f.fix);
                json!({ "what": f.what, "for": f.for_what, "needed": f.needed, "ok": f.found.is_ok(),
                        "text": text, "fix": fix })
            })
            .collect();
        let value = json!({ "version": 1, "ok": ok, "system": system(), "findings": rows });
        writeln!(out, "{}", serde_json::to_string_pretty(&value)?)?;
    } else {
        writeln!(out, "{}", system())?;
        for f in &findings {
            match &f.found {
                Ok(text) => writeln!(out, "  ok       {:24} {text}", f.what)?,
                Err(text) => {
                    let mark = if f.needed { "MISSING" } else { "-" };
                    writeln!(out, "  {mark:8} {:24} {text} (for {})", f.what, f.for_what)?;
                    writeln!(out, "           {:24} fix: {}", "", f.fix)?;
                }
            }
        }
    }
    Ok(ExitCode::from(if ok { 0 } else { 4 }))
}

/// Kernel and processor.
fn system() -> String {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default().trim().to_owned();
    let release = read("/proc/sys/kernel/osrelease");
    let release = if release.is_empty() { String::new() } else { format!(" {release}") };
    format!("{}{release}, {}", std::env::consts::OS, std::env::consts::ARCH)
}

fn first_line(program: &Path, arguments: &[&str]) -> Option<String> {
    let out =
        Command::new(program).args(arguments).stdin(Stdio::null()).output().ok().filter(|o| o.status.success())?;
    Some(String::from_utf8_lossy(&out.stdout).lines().next().unwrap_or_default().trim().to_owned())
}

/// Where a program is in `PATH`.
fn which(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|dir| dir.join(name)).find(|file| file.is_file())
}

fn program(what: &'static str, for_what: &'static str, names: &[&str], fix: &str) -> Finding {
    let found = names.iter().find_map(|name| {
        let path = which(name)?;
        Some(first_line(&path, &["--version"]).unwrap_or_else(|| path.display().to_string()))
    });
    Finding::new(what, for_what, found.ok_or_else(|| format!("no {} in PATH", names.join(", "))), fix)
}

/// Whether an environment is in this build and can be stepped.
fn physics(env: &str) -> Result<String, String> {
    match gadm_envs::make(env) {
        Ok(mut env) => {
            let mut obs = vec![0.0; env.spec().obs_dim()];
            env.reset(0, &mut obs);
            let action: Vec<f32> = env.spec().actions.iter().map(|a| a.safe).collect();
            env.step(&action, &mut obs);
            let finite = obs.iter().all(|o| o.is_finite());
            finite.then(|| "steps a model".to_owned()).ok_or_else(|| "a step gives numbers that are none".to_owned())
        }
        Err(error) => Err(error.to_string()),
    }
}

fn mujoco() -> Finding {
    let found = physics("inverted-pendulum-v5");
    let fix = "make setup; a program without it: cargo build --no-default-features";
    Finding { needed: true, ..Finding::new("MuJoCo physics", "Hopper, InvertedPendulum, …", found, fix) }
}

fn box2d() -> Finding {
    Finding::new("Box2D physics", "LunarLander", physics("lunar-lander"), "make setup; cargo build")
}

/// Names in a folder; none where it cannot be read.
fn names(dir: &str) -> Vec<String> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

fn socketcan() -> Finding {
    let release = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let modules = format!("/lib/modules/{}/kernel/net/can", release.trim());
    let (found, fix) = if Path::new("/proc/net/can").exists() {
        (Ok("the kernel has CAN".to_owned()), String::new())
    } else if cfg!(not(target_os = "linux")) {
        let fix = "use a hub (gadm-sim bus hub) or a serial adapter; SocketCAN is part of Linux";
        (Err(format!("{} has none", std::env::consts::OS)), fix.to_owned())
    } else if names(&modules).iter().any(|name| name.starts_with("can.ko")) {
        (Err("not loaded".to_owned()), "sudo modprobe -a can can_raw vcan".to_owned())
    } else {
        let text = format!("kernel {} has no CAN: neither built in nor as a module in {modules}", release.trim());
        let fix = "boot a distribution's kernel (Debian: apt-get install linux-image-amd64), or use a hub \
                   (gadm-sim bus hub), which needs none; `make test` boots such a kernel in QEMU";
        (Err(text), fix.to_owned())
    };
    Finding::new("SocketCAN", "--bus socketcan:…", found, fix)
}

/// Network interfaces of type CAN. Source: `ARPHRD_CAN` of the kernel's if_arp.h.
fn interfaces() -> Vec<String> {
    let is_can = |name: &String| {
        std::fs::read_to_string(format!("/sys/class/net/{name}/type")).is_ok_and(|kind| kind.trim() == "280")
    };
    names("/sys/class/net").into_iter().filter(is_can).collect()
}

fn is_virtual(name: &str) -> bool {
    let device = std::fs::canonicalize(format!("/sys/class/net/{name}"));
    device.is_ok_and(|path| path.starts_with("/sys/devices/virtual"))
}

fn vcan() -> Finding {
    let there: Vec<String> = interfaces().into_iter().filter(|name| is_virtual(name)).collect();
    let fix = "where the kernel has CAN: sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 mtu 72 up";
    let found = if there.is_empty() { Err("no virtual CAN interface".to_owned()) } else { Ok(there.join(", ")) };
    Finding::new("vcan", "a bus between programs in the kernel", found, fix)
}

fn can_interfaces() -> Finding {
    let there: Vec<String> = interfaces().into_iter().filter(|name| !is_virtual(name)).collect();
    let fix = "plug an adapter in; then sudo ip link set can0 up type can bitrate 500000 dbitrate 2000000 fd on";
    let found = if there.is_empty() { Err("no CAN adapter".to_owned()) } else { Ok(there.join(", ")) };
    Finding::new("CAN adapter", "a board on a desk", found, fix)
}

fn serial() -> Finding {
    let device = |name: &String| name.starts_with("ttyACM") || name.starts_with("ttyUSB");
    let there: Vec<String> = names("/dev").into_iter().filter(device).map(|name| format!("/dev/{name}")).collect();
    let fix = "plug an SLCAN adapter or a board in; Linux users need the group dialout: sudo usermod -aG dialout $USER";
    let found = if there.is_empty() { Err("no serial adapter".to_owned()) } else { Ok(there.join(", ")) };
    Finding::new("serial adapter", "--bus serial:…", found, fix)
}

fn can_utils() -> Finding {
    let found = which("candump").map(|path| path.display().to_string());
    let found = found.ok_or_else(|| "no candump in PATH".to_owned());
    Finding::new("can-utils", "candump, cansend and canplayer", found, "apt-get install -y can-utils")
}

fn rust_target(triple: &'static str) -> Finding {
    let fix = format!("rustup target add {triple}");
    let Some(rustup) = which("rustup") else {
        return Finding::new(triple, "device builds", Err("no rustup in PATH".to_owned()), "install rustup, rustup.rs");
    };
    let out = Command::new(rustup).args(["target", "list", "--installed"]).stdin(Stdio::null()).output();
    let there = out.is_ok_and(|o| String::from_utf8_lossy(&o.stdout).lines().any(|line| line == triple));
    let found = if there { Ok("installed".to_owned()) } else { Err("not installed".to_owned()) };
    Finding::new(triple, "device builds", found, fix)
}

/// A module of Python: of the one in the variable `PYTHON`, of the tests' environment, or of python3.
fn python(what: &'static str, module: &str, for_what: &'static str) -> Finding {
    let given = std::env::var_os("PYTHON").map(PathBuf::from);
    let candidates = given.into_iter().chain([PathBuf::from("target/python/bin/python")]).chain(which("python3"));
    let code = format!("import {module}; print(getattr({module}, '__version__', 'installed'))");
    let found = candidates.into_iter().find_map(|python| {
        let version = first_line(&python, &["-c", &code])?;
        Some(format!("{version} in {}", python.display()))
    });
    let found = found.ok_or_else(|| format!("no Python here can import {module}"));
    Finding::new(what, for_what, found, ".ci/python.sh, which makes target/python; or set PYTHON to one that can")
}
