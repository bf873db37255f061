//! `gadm image`: a policy as a flash image, and reading one back. It writes files and never touches a device.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context as _, bail};
use gadm_image::{
    CHIPS, Chip, EncodeOptions, Expected, FlashJob, Format, Layout, Placement, PolicyImage, Summary, chip, decode,
    flashing_lines, verify,
};
use gadm_trainer::atomic;
use serde_json::{Value, json};

use super::{print, print_json, say};

const EXAMPLES: &str = "\
Examples:
  gadm image policy.bin --address 0x08060000 --chip stm32f405 -o policy.hex
  gadm image policy.bin --address 0x10100000 --chip rp2040 -o policy.uf2 -o policy.elf
  gadm image policy.bin --address 0x00200000 --erase-block 4K --region 0x00200000..0x00400000 -o policy.hex
  gadm image verify policy.hex --address 0x08060000 --against policy.bin

The ending of an output chooses its format: .bin .hex .uf2 .elf .h. Only a policy that the
runtime loads and that passes its self-test is written. Nothing is flashed: the lines for
probe-rs, OpenOCD and dfu-util are printed on standard output, to be pasted.";

const VERIFY_EXAMPLES: &str = "\
Examples:
  gadm image verify policy.uf2
  gadm image verify readback.bin --address 0x08060000 --against policy.bin

Finds the policy in any of the formats, or in a memory dump, loads it as the device does
and runs its self-test. Exit code 1 where something is wrong, with the reason.";

/// Arguments of `image`.
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true, after_help = EXAMPLES)]
pub struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    /// Policy file that `gadm export` wrote
    #[arg(required = true)]
    policy: Option<PathBuf>,
    /// File to write: .bin, .hex, .uf2, .elf or .h; may be given several times
    #[arg(short, long, value_name = "FILE", required = true)]
    output: Vec<PathBuf>,
    /// Address of the policy in flash, a multiple of 16 (0x08060000); .h can do without
    #[arg(long, value_name = "ADDRESS", value_parser = address)]
    address: Option<u32>,
    #[command(flatten)]
    place: Place,
    /// Family number of a UF2 file, instead of the chip's
    #[arg(long, value_name = "NUMBER", value_parser = address)]
    uf2_family: Option<u32>,
    /// Print the result as JSON on standard output
    #[arg(long)]
    json: bool,
}

/// Where a policy may lie.
#[derive(clap::Args)]
struct Place {
    /// Chip whose erase blocks the place is checked against (stm32f405, rp2040, …)
    #[arg(long, value_name = "NAME", value_parser = named_chip, conflicts_with = "erase_block")]
    chip: Option<&'static Chip>,
    /// Size of the erase blocks instead of a chip, in bytes (4096, 0x1000, 4K, 1M); needs --region
    #[arg(long, value_name = "BYTES", value_parser = size, requires = "region")]
    erase_block: Option<u32>,
    /// Addresses that are free for the policy, the last one excluded; with --erase-block the blocks count from the first
    #[arg(long, value_name = "FIRST..BEHIND", value_parser = region)]
    region: Option<Range<u32>>,
}

#[derive(clap::Subcommand)]
enum Command {
    /// Read an image back: find the policy, load it, run its self-test
    Verify(VerifyArgs),
}

/// Arguments of `image verify`.
#[derive(clap::Args)]
#[command(after_help = VERIFY_EXAMPLES)]
struct VerifyArgs {
    /// Image in any of the formats, or a raw dump of flash
    file: PathBuf,
    /// Address where the policy must be; for a raw file, the address of its first byte
    #[arg(long, value_name = "ADDRESS", value_parser = address)]
    address: Option<u32>,
    /// Policy file that the image must hold, byte for byte
    #[arg(long, value_name = "POLICY")]
    against: Option<PathBuf>,
    #[command(flatten)]
    place: Place,
    /// Print the result as JSON on standard output
    #[arg(long)]
    json: bool,
}

/// A 32-bit number, hexadecimal behind `0x`; underscores are for the eye.
fn address(text: &str) -> Result<u32, String> {
    let plain = text.replace('_', "");
    let number = match plain.strip_prefix("0x").or_else(|| plain.strip_prefix("0X")) {
        Some(digits) => u32::from_str_radix(digits, 16),
        None => plain.parse(),
    };
    number.map_err(|_| format!("`{text}` is no number of 32 bits; write it as 0x08060000 or 134610944"))
}

/// As [`address`], with K and M for 1024 and 1024².
fn size(text: &str) -> Result<u32, String> {
    let upper = text.to_ascii_uppercase();
    let (digits, unit) = match upper.as_bytes().last() {
        Some(b'K') => (&text[..text.len() - 1], 1 << 10),
        Some(b'M') => (&text[..text.len() - 1], 1 << 20),
        _ => (text, 1),
    };
    let wrong = || format!("`{text}` is no size in bytes; write it as 4096, 0x1000, 4K or 1M");
    address(digits).ok().and_then(|n| n.checked_mul(unit)).filter(|n| *n > 0).ok_or_else(wrong)
}

fn region(text: &str) -> Result<Range<u32>, String> {
    let wrong = || format!("`{text}` is no region; write FIRST..BEHIND, such as 0x08060000..0x08080000");
    let (first, behind) = text.split_once("..").ok_or_else(wrong)?;
    let range = address(first)?..address(behind)?;
    if range.start < range.end { Ok(range) } else { Err(wrong()) }
}

fn named_chip(name: &str) -> Result<&'static Chip, String> {
    chip(name).ok_or_else(|| {
        let known: Vec<_> = CHIPS.iter().map(|chip| chip.name).collect();
        format!(
            "no chip `{name}` in the table; known: {}; for another one give --erase-block and --region",
            known.join(", ")
        )
    })
}

impl Place {
    /// The erase blocks, when enough was given to know them.
    fn layout(&self) -> anyhow::Result<Option<Layout>> {
        Ok(match (self.chip, self.erase_block, &self.region) {
            (Some(chip), _, None) => Some(Layout::of_chip(chip)),
            (Some(chip), _, Some(region)) => Some(Layout::of_chip(chip).within(region.clone())?),
            (None, Some(block), Some(region)) => Some(Layout::uniform(block, region.clone())?),
            (None, None, Some(_)) => {
                bail!("--region alone does not tell the erase blocks: add --chip or --erase-block")
            }
            (None, _, None) => None,
        })
    }
}

/// Runs `image`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    match &args.command {
        Some(Command::Verify(args)) => read_back(args),
        None => write(args),
    }
}

fn read(path: &Path) -> anyhow::Result<Vec<u8>> {
    std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))
}

fn write(args: &Args) -> anyhow::Result<ExitCode> {
    let input = args.policy.as_deref().context("no policy file")?;
    let bytes = read(input)?;
    let policy = PolicyImage::check(&bytes).with_context(|| input.display().to_string())?;
    let len = policy.bytes().len();
    let formats = args.output.iter().map(|path| Format::of_path(path)).collect::<Result<Vec<_>, _>>()?;
    let layout = args.place.layout()?;
    let placement = match (&layout, args.address) {
        (Some(layout), Some(address)) => Some(layout.place(address, len)?),
        (Some(layout), None) => {
            let fits: Vec<_> = layout.suggestions(len).iter().map(|at| format!("{at:#010x}")).collect();
            let fits = if fits.is_empty() { "nowhere".to_owned() } else { fits.join(", ") };
            bail!("no --address to check; {len} bytes fit there at: {fits}")
        }
        (None, _) => None,
    };
    let family = args.uf2_family.or(args.place.chip.map(|chip| chip.uf2_family));
    let options = EncodeOptions { address: args.address, uf2_family: family };
    // All of them are made before the first is written.
    let mut files = Vec::new();
    for (path, format) in args.output.iter().zip(&formats) {
        if same_file(path, input) {
            bail!("{} is the policy file itself: choose another name", path.display());
        }
        files.push((path, *format, format.encode(&policy, &options).with_context(|| path.display().to_string())?));
    }
    for (path, _, content) in &files {
        atomic::write(path, content)?;
    }

    // Tools without another format take a raw file, which must hold nothing but the policy.
    let written = files.iter().find(|(_, format, _)| *format == Format::Bin).map(|(path, _, _)| path.as_path());
    let raw = written.or((bytes.len() == len).then_some(input));
    let mut lines = Vec::new();
    for (path, format, _) in &files {
        let Some(address) = args.address else { continue };
        let job = FlashJob { file: path, format: *format, raw, address, chip: args.place.chip };
        for line in flashing_lines(&job) {
            if !lines.contains(&line) {
                lines.push(line);
            }
        }
    }
    if args.json {
        let files: Vec<_> = files
            .iter()
            .map(
                |(path, format, content)| json!({ "file": path, "format": format.extension(), "bytes": content.len() }),
            )
            .collect();
        let commands: Vec<_> = lines.iter().map(|line| json!({ "tool": line.tool, "command": line.command })).collect();
        print_json(&json!({
            "version": 1,
            "policy": policy_json(policy.summary()),
            "address": args.address,
            "chip": args.place.chip.map(|chip| chip.name),
            "erase": placement.as_ref().map(placement_json),
            "files": files,
            "commands": commands,
        }))?;
        return Ok(ExitCode::SUCCESS);
    }
    say(&summary_text(policy.summary()));
    match (&placement, args.address) {
        (Some(placement), Some(address)) => say(&placement_text(placement, address, len, &args.place)),
        (None, Some(address)) => say(&format!(
            "{len} bytes at {address:#010x}; erase blocks not checked: name the chip with --chip, or give --erase-block \
             and --region"
        )),
        _ => {}
    }
    let uf2_unnamed = formats.contains(&Format::Uf2) && family.is_none();
    if uf2_unnamed {
        say("the UF2 file names no chip family, and many boot loaders then refuse it: add --chip or --uf2-family");
    }
    for (path, format, content) in &files {
        say(&format!("wrote {} ({format}, {} bytes)", path.display(), content.len()));
    }
    for line in &lines {
        print(&line.command)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Whether both names lead to one file that is there.
fn same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

fn read_back(args: &VerifyArgs) -> anyhow::Result<ExitCode> {
    let content = read(&args.file)?;
    let against = args.against.as_deref().map(read).transpose()?;
    if let (Some(path), Some(bytes)) = (&args.against, &against) {
        PolicyImage::check(bytes).with_context(|| path.display().to_string())?;
    }
    let name = || args.file.display().to_string();
    let contents = decode(&content, Some(&args.file), args.address).with_context(name)?;
    let expected = Expected { address: args.address, policy: against.as_deref() };
    let found = verify(&contents, &expected).with_context(name)?;
    let len = found.policy.bytes().len();
    let placement = match args.place.layout()? {
        Some(_) if !contents.addressed => {
            bail!("{}: a {} holds no address to check: give --address", name(), contents.format)
        }
        Some(layout) => Some(layout.place(found.address, len).with_context(name)?),
        None => None,
    };
    if args.json {
        print_json(&json!({
            "version": 1,
            "file": args.file,
            "format": contents.format.extension(),
            "address": contents.addressed.then_some(found.address),
            "offset": (!contents.addressed).then_some(found.address),
            "uf2_family": contents.uf2_family,
            "policy": policy_json(found.policy.summary()),
            "self_test": "passed",
            "same_as": args.against,
            "other_bytes": found.other_bytes,
            "chip": args.place.chip.map(|chip| chip.name),
            "erase": placement.as_ref().map(placement_json),
        }))?;
        return Ok(ExitCode::SUCCESS);
    }
    let place = if contents.addressed { "address" } else { "offset" };
    let mut text = vec![
        format!("{}: {}, policy at {place} {:#010x}, self-test passed", name(), contents.format, found.address),
        summary_text(found.policy.summary()),
    ];
    if let Some(placement) = &placement {
        text.push(placement_text(placement, found.address, len, &args.place));
    }
    if let Some(path) = &args.against {
        text.push(format!("the same {len} bytes as {}", path.display()));
    }
    if found.other_bytes > 0 {
        text.push(format!("{} more bytes in the file that are neither the policy nor erased flash", found.other_bytes));
    }
    print(&text.join("\n"))?;
    Ok(ExitCode::SUCCESS)
}

fn summary_text(summary: &Summary) -> String {
    format!(
        "policy for {}: {} bytes, payload CRC-32 {:08x}, interface {:016x}, sequence {}, {} bytes of scratch memory",
        summary.environment,
        summary.total_len,
        summary.payload_crc32,
        summary.interface_hash,
        summary.policy_seq,
        4 * summary.scratch_words
    )
}

fn placement_text(placement: &Placement, address: u32, len: usize, place: &Place) -> String {
    let count = placement.blocks.len();
    let on = place.chip.map_or_else(String::new, |chip| format!(" of {} ({})", chip.name, chip.part));
    let plural = if count == 1 { "" } else { "s" };
    let end = placement.blocks.last().map_or(0, |block| u64::from(block.address) + u64::from(block.len) - 1);
    format!(
        "{len} bytes at {address:#010x} take {count} erase block{plural}{on}, to {end:#010x}; {} bytes of them stay unused",
        placement.unused
    )
}

fn policy_json(summary: &Summary) -> Value {
    json!({
        "environment": summary.environment,
        "bytes": summary.total_len,
        "payload_crc32": format!("{:08x}", summary.payload_crc32),
        "interface_hash": format!("{:016x}", summary.interface_hash),
        "policy_seq": summary.policy_seq,
        "weights": format!("{:?}", summary.weights),
        "observations": summary.obs_dim,
        "actions": summary.action_dim,
        "control_period_us": summary.control_period_us,
        "scratch_bytes": 4 * summary.scratch_words,
    })
}

fn placement_json(placement: &Placement) -> Value {
    let blocks: Vec<_> =
        placement.blocks.iter().map(|block| json!({ "address": block.address, "bytes": block.len })).collect();
    json!({ "blocks": blocks, "unused_bytes": placement.unused })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_as_people_write_them() {
        assert_eq!(address("0x0806_0000"), Ok(0x0806_0000));
        assert_eq!(address("4096"), Ok(4096));
        assert!(address("0x108060000").unwrap_err().contains("0x08060000"));
        assert!(address("").is_err() && address("-4").is_err());
        assert_eq!((size("128K"), size("0x1000"), size("1m")), (Ok(131_072), Ok(4096), Ok(1 << 20)));
        assert!(size("0").is_err() && size("5000M").is_err() && size("K").is_err() && size("µ").is_err());
        assert_eq!(region("0x10..0x20"), Ok(16..32));
        assert!(region("0x20..0x10").is_err() && region("0x20").unwrap_err().contains("FIRST..BEHIND"));
        assert!(named_chip("z80").unwrap_err().contains("stm32f405"));
    }
}
