//! `gadm-sim trace`.

use std::collections::BTreeMap;
use std::io::{BufWriter, Write};
#[cfg(feature = "mcap")]
use std::path::Path;
use std::path::PathBuf;
use std::process::ExitCode;

use gadm_runtime::Policy;
use gadm_sim::SimError;
use gadm_sim::bus::trace;
use gadm_sim::decode::{Decoder, profile_of};
use gadm_sim::sil::read_image;
use serde_json::{Value, json};

use super::say;

const EXAMPLES: &str = "\
Examples:
  gadm-sim trace run.log --policy policy.bin | less
  gadm-sim trace run.log --policy policy.bin --json | jq 'select(.name==\"ACT\")'
  gadm-sim trace run.log --policy policy.bin --mcap run.mcap

Frames of another policy or damaged ones are shown with the reason; the exit
code is 0 all the same. A line that is not candump text is an error (1).";

/// Arguments of `trace`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Trace in the text form of `candump -L`
    file: PathBuf,
    /// Policy file that the trace was made with: names, ranges, interface hash
    #[arg(long, value_name = "FILE")]
    policy: PathBuf,
    /// One JSON object per frame
    #[arg(long)]
    json: bool,
    /// Write signals and events to FILE for Foxglove, and print no frames
    #[cfg(feature = "mcap")]
    #[arg(long, value_name = "FILE", conflicts_with = "json")]
    mcap: Option<PathBuf>,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    #[cfg(feature = "mcap")]
    if let Some(path) = &args.mcap {
        let written = write_mcap(&args.policy, &args.file, path)?;
        say(&format!("{}: {} messages, {} of them events", path.display(), written.messages, written.events));
        return Ok(ExitCode::SUCCESS);
    }
    let image = read_image(&args.policy)?;
    let policy = Policy::load(&image).map_err(SimError::Policy)?;
    let records = trace::read(&args.file)?;
    let profile = profile_of(records.iter().filter_map(|r| r.frame.as_ref())).unwrap_or(gadm_sim::Profile::FdF32);
    let decoder = Decoder::new(&policy, profile)?;
    let mut out = BufWriter::new(std::io::stdout().lock());
    let mut counts: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
    for record in &records {
        let Some(frame) = &record.frame else {
            counts.entry("error frame").or_default().0 += 1;
            continue;
        };
        let decoded = decoder.decode(frame);
        let count = counts.entry(decoded.name).or_default();
        count.0 += 1;
        count.1 += u64::from(decoded.error.is_some());
        if args.json {
            let mut value = json!({ "time_us": record.time_us });
            if let (Value::Object(all), Value::Object(rest)) = (&mut value, serde_json::to_value(&decoded)?) {
                all.extend(rest);
            }
            writeln!(out, "{value}")?;
        } else {
            let time_s = record.time_us as f64 / 1e6;
            write!(out, "{time_s:>14.6} {:>3X} {:<14}", decoded.id, decoded.name)?;
            for (name, value) in &decoded.signals {
                match value {
                    Value::String(s) => write!(out, " {name}={s}")?,
                    value => write!(out, " {name}={value}")?,
                }
            }
            if let Some(error) = &decoded.error {
                write!(out, " !! {error}")?;
            }
            writeln!(out)?;
        }
    }
    out.flush()?;
    for (name, (frames, wrong)) in counts {
        let note = if wrong > 0 { format!(", {wrong} not readable") } else { String::new() };
        say(&format!("  {name:<16} {frames}{note}"));
    }
    Ok(ExitCode::SUCCESS)
}

/// Writes the MCAP file of a trace.
#[cfg(feature = "mcap")]
pub(super) fn write_mcap(policy: &Path, trace: &Path, path: &Path) -> anyhow::Result<gadm_sim::mcap::Written> {
    use anyhow::Context as _;

    let image = read_image(policy)?;
    let policy = Policy::load(&image).map_err(SimError::Policy)?;
    let records = trace::read(trace)?;
    let file = std::fs::File::create(path).map_err(|source| SimError::Write { path: path.to_owned(), source })?;
    gadm_sim::mcap::export(&policy, &records, BufWriter::new(file)).with_context(|| path.display().to_string())
}
