//! Command lines of flashing tools, to be pasted. Nothing here runs them.
//!
//! Source: the tools' manuals: probe-rs 0.32 `download --help`, OpenOCD user's guide (`program`), dfu-util(1).

use std::path::Path;

use crate::{Chip, Format};

/// A file that was written and what is known of the place where it goes.
#[derive(Clone, Copy, Debug)]
pub struct FlashJob<'a> {
    /// The file.
    pub file: &'a Path,
    /// Its format.
    pub format: Format,
    /// A raw binary of the policy, for tools that read nothing else.
    pub raw: Option<&'a Path>,
    /// Address of the policy.
    pub address: u32,
    /// The chip, when it was named.
    pub chip: Option<&'a Chip>,
}

/// A line for one tool.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// Name of the tool.
    pub tool: &'static str,
    /// The line for a shell; where the chip was not named, words in capitals are to be filled in.
    pub command: String,
}

/// Lines that write the file into flash and compare it there; none for a C header, which the compiler takes.
#[must_use]
pub fn flashing_lines(job: &FlashJob<'_>) -> Vec<Line> {
    if job.format == Format::CHeader {
        return Vec::new();
    }
    let mut lines = vec![probe_rs(job)];
    lines.extend(openocd(job));
    lines.extend(dfu_util(job));
    lines.extend(drive(job));
    lines
}

fn probe_rs(job: &FlashJob<'_>) -> Line {
    let chip = job.chip.map_or("CHIP", |chip| chip.probe_rs);
    let format = match job.format {
        Format::Bin => format!("bin --base-address {:#010x}", job.address),
        other => other.extension().to_owned(),
    };
    let file = quoted(job.file);
    Line {
        tool: "probe-rs",
        command: format!("probe-rs download --chip {chip} --binary-format {format} --verify {file}"),
    }
}

fn openocd(job: &FlashJob<'_>) -> Option<Line> {
    // OpenOCD knows Intel HEX and ELF by their content, and no UF2.
    let (file, address) = match job.format {
        Format::Hex | Format::Elf => (job.file, String::new()),
        Format::Bin => (job.file, format!(" {:#010x}", job.address)),
        Format::Uf2 | Format::CHeader => (job.raw?, format!(" {:#010x}", job.address)),
    };
    let (interface, target) = job
        .chip
        .map_or(("interface/PROBE.cfg", "target/CHIP.cfg"), |chip| (chip.openocd_interface, chip.openocd_target));
    // Braces keep a path together in Tcl; the shell sees double quotes.
    let script = format!("program {{{}}}{address} verify reset exit", file.display());
    let script = script.replace('\\', "\\\\").replace('"', "\\\"").replace('$', "\\$").replace('`', "\\`");
    Some(Line { tool: "OpenOCD", command: format!("openocd -f {interface} -f {target} -c \"{script}\"") })
}

fn dfu_util(job: &FlashJob<'_>) -> Option<Line> {
    if job.chip.is_some_and(|chip| !chip.dfu) {
        return None;
    }
    let raw = if job.format == Format::Bin { job.file } else { job.raw? };
    let command = format!("dfu-util -a 0 -s {:#010x} -D {}", job.address, quoted(raw));
    Some(Line { tool: "dfu-util", command })
}

fn drive(job: &FlashJob<'_>) -> Option<Line> {
    let uf2 = job.format == Format::Uf2;
    uf2.then(|| Line { tool: "UF2 drive", command: format!("cp {} DRIVE", quoted(job.file)) })
}

/// A path as a word of a POSIX shell, never taken for an option.
fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let text = if text.starts_with('-') { format!("./{text}") } else { text };
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./+=:,@%".contains(c);
    if !text.is_empty() && text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chip;

    fn job<'a>(file: &'a str, format: Format, raw: Option<&'a str>, name: Option<&str>) -> FlashJob<'a> {
        FlashJob {
            file: Path::new(file),
            format,
            raw: raw.map(Path::new),
            address: 0x0806_0000,
            chip: name.and_then(chip),
        }
    }

    fn text(job: &FlashJob<'_>) -> Vec<String> {
        flashing_lines(job).into_iter().map(|line| line.command).collect()
    }

    #[test]
    fn lines_for_a_named_chip() {
        assert_eq!(
            text(&job("policy.bin", Format::Bin, None, Some("stm32f405"))),
            [
                "probe-rs download --chip STM32F405RGTx --binary-format bin --base-address 0x08060000 --verify policy.bin",
                "openocd -f interface/stlink.cfg -f target/stm32f4x.cfg -c \"program {policy.bin} 0x08060000 verify reset exit\"",
                "dfu-util -a 0 -s 0x08060000 -D policy.bin",
            ]
        );
        let hex = text(&job("policy.hex", Format::Hex, Some("models/policy.bin"), Some("stm32f405")));
        assert!(hex[0].ends_with("--binary-format hex --verify policy.hex"), "{}", hex[0]);
        assert!(hex[1].contains("program {policy.hex} verify"), "{}", hex[1]);
        assert_eq!(hex[2], "dfu-util -a 0 -s 0x08060000 -D models/policy.bin");
    }

    #[test]
    fn tools_that_cannot_are_left_out() {
        let uf2 = flashing_lines(&job("policy.uf2", Format::Uf2, None, Some("rp2040")));
        assert_eq!(uf2.iter().map(|line| line.tool).collect::<Vec<_>>(), ["probe-rs", "UF2 drive"]);
        assert!(flashing_lines(&job("policy.h", Format::CHeader, None, None)).is_empty());
        let unnamed = text(&job("policy.elf", Format::Elf, None, None));
        assert!(unnamed[0].contains("--chip CHIP") && unnamed[1].contains("target/CHIP.cfg"), "{unnamed:?}");
    }

    #[test]
    fn names_that_a_shell_would_cut() {
        let lines = text(&job("my policy's.bin", Format::Bin, None, None));
        assert!(lines[0].ends_with(r"--verify 'my policy'\''s.bin'"), "{}", lines[0]);
        assert!(lines[1].contains("program {my policy's.bin} 0x08060000"), "{}", lines[1]);
        assert!(text(&job("-x.bin", Format::Bin, None, None))[0].ends_with("--verify ./-x.bin"));
    }
}
