//! `gadm-sim bus hub`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc;
use std::time::Duration;

use anyhow::Context as _;
use clap::{ArgGroup, ValueEnum};
use gadm_sim::SimError;
use gadm_sim::bus::exchange::Limits;
use gadm_sim::bus::hub::{Event, Hub, Options, Slow};
use gadm_sim::bus::loopback::Tap;
use gadm_sim::bus::trace::TraceWriter;
use serde_json::json;

use super::say;

const EXAMPLES: &str = "\
Examples:
  gadm-sim bus hub --unix can.sock --trace bus.log
  gadm-sim bus hub --tcp 127.0.0.1:29536 --pty --socketcan vcan0

All members speak SLCAN, the lines of serial CAN adapters. python-can joins
with interface=\"slcan\", channel=\"socket://127.0.0.1:29536\",
sleep_after_open=0; slcand and python-can open the pseudo-terminal.
Every byte from a member is taken as hostile: queues are bounded, and TCP is
for this machine only unless --allow-remote is given. Ctrl-C ends the hub.";

/// Arguments of `bus hub`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
// A group of its own: one on the structure would hold all of its arguments, so that `--quiet` alone were enough.
#[command(group = ArgGroup::new("ways").required(true).multiple(true).args(["unix", "tcp", "pty", "socketcan"]))]
#[expect(clippy::struct_excessive_bools, reason = "flags of a command line")]
pub(crate) struct Args {
    /// Listen on a unix socket, which only this user may open
    #[arg(long, value_name = "PATH")]
    unix: Vec<PathBuf>,
    /// Listen on TCP; with port 0 the system chooses one
    #[arg(long, value_name = "ADDRESS:PORT")]
    tcp: Vec<SocketAddr>,
    /// Make a pseudo-terminal, for programs that want a serial port
    #[arg(long)]
    pty: bool,
    /// Join a SocketCAN interface with the hub
    #[arg(long, value_name = "INTERFACE")]
    socketcan: Option<String>,
    /// Let --tcp be reached from other machines; the bus has no password
    #[arg(long)]
    allow_remote: bool,
    /// Write all frames to FILE, as `candump -L` does
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Members at a time
    #[arg(long, value_name = "N", default_value_t = Limits::default().members)]
    members: usize,
    /// Frames that may wait for one member
    #[arg(long, value_name = "N", default_value_t = Limits::default().queue)]
    queue: usize,
    /// What happens when a member does not read
    #[arg(long, value_enum, default_value = "drop")]
    slow: SlowArg,
    /// Print where the hub listens as JSON on standard output
    #[arg(long)]
    json: bool,
    /// Do not tell where it listens and who comes and goes
    #[arg(long, short)]
    quiet: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum SlowArg {
    /// It loses frames, which are counted
    Drop,
    /// The others wait for it up to 5 s, then it is shut out
    Wait,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let trace: Option<Box<dyn Tap + Send>> = match &args.trace {
        None => None,
        Some(path) => {
            let file = File::create(path).map_err(|source| SimError::Write { path: path.clone(), source })?;
            Some(Box::new(TraceWriter::new(BufWriter::new(file))))
        }
    };
    let options = Options {
        limits: Limits { members: args.members, queue: args.queue.max(2) },
        slow: match args.slow {
            SlowArg::Drop => Slow::Drop,
            SlowArg::Wait => Slow::Wait(Duration::from_secs(5)),
        },
    };
    let (quiet, path) = (args.quiet, args.trace.clone());
    let mut hub = Hub::new(options, trace, move |event| tell(&event, quiet, path.as_ref()));
    let mut ways = Vec::new();
    for path in &args.unix {
        hub.listen_unix(path).with_context(|| format!("cannot listen on unix:{}", path.display()))?;
        ways.push(format!("unix:{}", path.display()));
    }
    for address in &args.tcp {
        let bound = hub
            .listen_tcp(*address, args.allow_remote)
            .with_context(|| format!("cannot listen on tcp:{address} (--allow-remote lets other machines in)"))?;
        ways.push(format!("tcp:{bound}"));
    }
    if args.pty {
        let path = hub.open_pty().context("cannot make a pseudo-terminal")?;
        ways.push(format!("serial:{}", path.display()));
    }
    if let Some(interface) = &args.socketcan {
        join(&mut hub, interface).with_context(|| format!("cannot join socketcan:{interface}"))?;
    }
    let (stop, stopped) = mpsc::channel();
    // Where a handler is set already, the hub ends as that handler wants.
    let _ = ctrlc::set_handler(move || {
        let _ = stop.send(());
    });
    if args.json {
        let mut out = std::io::stdout().lock();
        writeln!(out, "{}", json!({ "version": 1, "listens": ways }))?;
        out.flush()?;
    } else if !args.quiet {
        for way in &ways {
            say(&format!("listening: {way}"));
        }
    }
    let _ = stopped.recv();
    drop(hub);
    Ok(ExitCode::SUCCESS)
}

#[cfg(all(target_os = "linux", feature = "socketcan"))]
fn join(hub: &mut Hub, interface: &str) -> std::io::Result<()> {
    hub.add_socketcan(interface)
}

#[cfg(not(all(target_os = "linux", feature = "socketcan")))]
fn join(_: &mut Hub, _: &str) -> std::io::Result<()> {
    Err(std::io::Error::new(std::io::ErrorKind::Unsupported, "this program was built without SocketCAN"))
}

fn tell(event: &Event, quiet: bool, trace: Option<&PathBuf>) {
    let text = match event {
        Event::Trace(error) => {
            let path = trace.map_or_else(String::new, |p| p.display().to_string());
            say(&format!("error: cannot write {path}: {error}; the trace ends here"));
            return;
        }
        _ if quiet => return,
        Event::Joined { member, from } => format!("member {member} joined from {from}"),
        Event::Full { from } => format!("turned {from} away: no room (--members)"),
        Event::Left { member, counts, too_slow } => format!(
            "member {member} {}: sent {}, received {}, lost {}, lines refused {}",
            if *too_slow { "was too slow and is shut out" } else { "left" },
            counts.sent,
            counts.received,
            counts.dropped,
            counts.refused
        ),
    };
    say(&text);
}
