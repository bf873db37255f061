//! `gadm-sim node`.

use std::path::PathBuf;
use std::process::ExitCode;

use gadm_node::{NodeConfig, NodeId};
use gadm_runtime::Policy;
use gadm_sim::bus::{self, Address};
use gadm_sim::sil::read_image;
use gadm_sim::target::{ServeOptions, serve};
use gadm_sim::{BitRate, SimError};

use super::run::{ProfileArg, factor};
use super::say;

const EXAMPLES: &str = "\
Examples:
  gadm-sim node policy.bin --connect unix:can.sock
  gadm-sim node policy.bin --connect socketcan:vcan0 --realtime

In lockstep, the default, the node has the plant's time and waits for
`gadm-sim run policy.bin --bus BUS --external-node` (or `gadm-sim plant`) to
start it; each run starts it afresh. It ends when the bus does.";

/// Arguments of `node`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Policy file
    policy: PathBuf,
    /// The bus: unix:PATH, tcp:HOST:PORT, serial:DEVICE, socketcan:INTERFACE
    #[arg(long, value_name = "BUS")]
    connect: Address,
    /// How values travel
    #[arg(long, value_enum, default_value = "fd-f32")]
    profile: ProfileArg,
    /// Node number, 1 to 63
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=63))]
    node: u8,
    /// Take time from the wall, FACTOR times as fast; without this, from the TICK frames (lockstep)
    #[arg(long, value_name = "FACTOR", num_args = 0..=1, default_missing_value = "1", value_parser = factor)]
    realtime: Option<f64>,
    /// Bit rate that a serial adapter is set to, bit/s
    #[arg(long, default_value_t = BitRate::default().nominal, value_name = "BPS")]
    bitrate: u32,
    /// Bit rate of the data of FD frames that a serial adapter is set to, bit/s
    #[arg(long, default_value_t = BitRate::default().data, value_name = "BPS")]
    data_bitrate: u32,
    /// Say nothing
    #[arg(long, short)]
    quiet: bool,
    /// End when standard input does: for a program that starts this one
    #[arg(long, hide = true)]
    until_input_ends: bool,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let image = read_image(&args.policy)?;
    Policy::load(&image).map_err(SimError::Policy)?;
    let node = NodeId::new(args.node).unwrap_or(NodeId::DEFAULT);
    let config = NodeConfig { node, profile: args.profile.into(), ..NodeConfig::default() };
    let rate = BitRate { nominal: args.bitrate, data: args.data_bitrate };
    let mut joined = bus::open(&args.connect, rate)
        .map_err(|e| SimError::Remote { bus: args.connect.to_string(), what: format!("cannot join the bus: {e}") })?;
    if args.until_input_ends {
        std::thread::spawn(|| {
            // Whatever comes, and also an error, is the end.
            let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
            std::process::exit(0);
        });
    }
    let tell = |text: &str| {
        if !args.quiet {
            say(text);
        }
    };
    tell(&format!("node {} on {}", args.node, args.connect));
    serve(&mut *joined, &image, ServeOptions { config, realtime: args.realtime }, &mut |_| tell("started afresh"))?;
    tell("the bus is gone");
    Ok(ExitCode::SUCCESS)
}
