//! Traces in the text form of `candump -L`, which can-utils, python-can and cantools read.
//!
//! `(0000000001.234567) vcan0 181##1…`: six digits of microseconds; `#` before the data of a classic frame, `##` and
//! a digit of flags (1 = bit-rate switch) before that of an FD frame, `#R` for a remote frame.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufRead as _, BufReader, Write};
use std::path::Path;

use gadm_node::Frame;
use gadm_node::frame::{FD_LENGTHS, Kind, extended, standard};

use crate::SimError;
use crate::bus::loopback::Tap;

/// Name of the bus in traces.
pub const INTERFACE: &str = "vcan0";

/// Marks of the kernel's `can_id` that are not part of an identifier.
const ERROR_FRAME: u32 = 0x2000_0000;

/// Writes frames as lines.
#[derive(Debug)]
pub struct TraceWriter<W: Write> {
    out: W,
    line: String,
}

impl<W: Write> TraceWriter<W> {
    /// Writes to `out`, which should be buffered.
    pub fn new(out: W) -> Self {
        Self { out, line: String::new() }
    }

    /// One line.
    ///
    /// # Errors
    /// Those of `out`.
    pub fn write(&mut self, time_us: u64, frame: &Frame) -> io::Result<()> {
        self.line.clear();
        format_line(&mut self.line, time_us, frame);
        self.line.push('\n');
        self.out.write_all(self.line.as_bytes())
    }
}

impl<W: Write> Tap for TraceWriter<W> {
    fn frame(&mut self, time_us: u64, frame: &Frame) -> io::Result<()> {
        self.write(time_us, frame)
    }
}

/// Appends the line of a frame, without line end.
pub fn format_line(line: &mut String, time_us: u64, frame: &Frame) {
    let id = frame.raw_id();
    let width = if frame.standard_id().is_some() { 3 } else { 8 };
    // Writing to a String cannot fail.
    let _ = write!(line, "({:010}.{:06}) {INTERFACE} {id:0width$X}#", time_us / 1_000_000, time_us % 1_000_000);
    match frame.kind() {
        Kind::Classic => {}
        Kind::Remote => line.push('R'),
        Kind::Fd { brs } => line.push_str(if brs { "#1" } else { "#0" }),
    }
    if let Some(dlc @ 1..) = frame.remote_dlc() {
        let _ = write!(line, "{dlc}");
    }
    for byte in frame.payload() {
        let _ = write!(line, "{byte:02X}");
    }
}

/// One line of a trace.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Time stamp, microseconds.
    pub time_us: u64,
    /// Name of the bus.
    pub interface: String,
    /// The frame; `None` for an error frame of the controller.
    pub frame: Option<Frame>,
}

/// Reads a whole trace; empty lines are skipped.
///
/// # Errors
/// [`SimError::Read`], and [`SimError::Trace`] with the first line that is not one of a trace.
pub fn read(path: &Path) -> Result<Vec<Record>, SimError> {
    let failed = |source| SimError::Read { path: path.to_owned(), source };
    let file = BufReader::new(File::open(path).map_err(failed)?);
    let mut records = Vec::new();
    for (i, line) in file.lines().enumerate() {
        let line = line.map_err(failed)?;
        if line.trim().is_empty() {
            continue;
        }
        let wrong = |source| SimError::Trace { path: path.to_owned(), line: i + 1, source };
        records.push(parse_line(&line).map_err(wrong)?);
    }
    Ok(records)
}

/// What is wrong with a line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected {expected}, found `{found}`")]
pub struct LineError {
    /// What should be there.
    pub expected: &'static str,
    /// What is there.
    pub found: String,
}

fn wrong(expected: &'static str, found: &str) -> LineError {
    LineError { expected, found: found.chars().take(80).collect() }
}

/// Reads one line.
///
/// # Errors
/// Says which part of the line is wrong.
pub fn parse_line(line: &str) -> Result<Record, LineError> {
    let mut words = line.split_ascii_whitespace();
    let stamp = words.next().unwrap_or("");
    let time_us = stamp
        .strip_prefix('(')
        .and_then(|s| s.strip_suffix(')'))
        .and_then(|s| s.split_once('.'))
        .filter(|(_, fraction)| fraction.len() == 6)
        .and_then(|(s, f)| {
            let digits = |t: &str| t.bytes().all(|b| b.is_ascii_digit());
            if !digits(s) || !digits(f) {
                return None;
            }
            s.parse::<u64>().ok()?.checked_mul(1_000_000)?.checked_add(f.parse().ok()?)
        })
        .ok_or_else(|| wrong("a time stamp `(seconds.microseconds)` with six decimals", stamp))?;
    let interface = words.next().ok_or_else(|| wrong("the name of a bus after the time stamp", line))?;
    let body = words.next().ok_or_else(|| wrong("a frame `ID#DATA` after the name of the bus", line))?;
    if let Some(extra) = words.next().filter(|w| !matches!(*w, "R" | "T")) {
        return Err(wrong("the direction `R` or `T`, or nothing, after the frame", extra));
    }
    let (id, data) = body.split_once('#').ok_or_else(|| wrong("`#` between identifier and data", body))?;
    let number = u32::from_str_radix(id, 16).map_err(|_| wrong("a hexadecimal identifier", id))?;
    let id = match id.len() {
        3 if number < 0x800 => standard(number as u16),
        8 if number & ERROR_FRAME != 0 => return Ok(Record { time_us, interface: interface.to_owned(), frame: None }),
        8 if number < 0x2000_0000 => extended(number),
        _ => return Err(wrong("an identifier of 3 digits (up to 7FF) or 8 digits (up to 1FFFFFFF)", id)),
    };
    let frame = if let Some(rest) = data.strip_prefix('#') {
        let brs = rest
            .chars()
            .next()
            .and_then(|c| c.to_digit(16))
            .ok_or_else(|| wrong("a digit of flags after `##`", data))?
            & 1
            == 1;
        let bytes = hex(&rest[1..])?;
        if FD_LENGTHS.contains(&bytes.len()) { Frame::fd(id, &bytes, brs) } else { None }
    } else if let Some(rest) = data.strip_prefix(['R', 'r']) {
        let dlc = if rest.is_empty() { Some(0) } else { rest.parse().ok() };
        dlc.and_then(|dlc| Frame::remote(id, dlc))
    } else {
        // `_9` to `_F`: the raw length code of a classic frame, where it is above 8. The bytes are 8 all the same.
        let bytes = match data.split_once('_') {
            Some((bytes, dlc)) if matches!(dlc.as_bytes(), [b'9' | b'A'..=b'F']) => bytes,
            _ => data,
        };
        Frame::classic(id, &hex(bytes)?)
    };
    let frame = frame.ok_or_else(|| wrong("a length that CAN (0-8) or CAN FD (0-8, 12, 16, … 64) has", data))?;
    Ok(Record { time_us, interface: interface.to_owned(), frame: Some(frame) })
}

fn hex(text: &str) -> Result<Vec<u8>, LineError> {
    let error = || wrong("pairs of hexadecimal digits", text);
    if !text.len().is_multiple_of(2) || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
        return Err(error());
    }
    (0..text.len() / 2).map(|i| u8::from_str_radix(&text[2 * i..2 * i + 2], 16).map_err(|_| error())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn line(time_us: u64, frame: &Frame) -> String {
        let mut s = String::new();
        format_line(&mut s, time_us, frame);
        s
    }

    #[test]
    fn lines_as_candump_writes_them() {
        let f = Frame::classic(standard(0x123), &[0x11, 0x22]).unwrap();
        assert_eq!(line(1_234_567, &f), "(0000000001.234567) vcan0 123#1122");
        let f = Frame::fd(standard(0x7), &[0xAB; 9], true).unwrap();
        assert_eq!(line(0, &f), "(0000000000.000000) vcan0 007##1ABABABABABABABABAB000000");
        assert_eq!(line(0, &Frame::remote(standard(0x7), 4).unwrap()), "(0000000000.000000) vcan0 007#R4");
        let f = Frame::classic(extended(0x1234567), &[]).unwrap();
        assert_eq!(line(0, &f), "(0000000000.000000) vcan0 01234567#");
    }

    #[test]
    fn other_writers_lines_are_read() {
        let r = parse_line("(1600000000.000001) can0 123##5112233 R").unwrap();
        assert_eq!((r.time_us, r.interface.as_str()), (1_600_000_000_000_001, "can0"));
        assert_eq!(r.frame.unwrap().kind(), Kind::Fd { brs: true });
        assert_eq!(parse_line("(0.000000) can0 20000040#0000000000000000").unwrap().frame, None);
        let raw = parse_line("(0.000000) can0 123#1122334455667788_E").unwrap().frame.unwrap();
        assert_eq!((raw.kind(), raw.payload()[7]), (Kind::Classic, 0x88));
        assert_eq!(parse_line("(0.000000) can0 123#R").unwrap().frame, Frame::remote(standard(0x123), 0));
    }

    #[test]
    fn wrong_lines_say_what_is_wrong() {
        for (text, expected) in [
            ("", "time stamp"),
            ("(1.5) can0 123#", "time stamp"),
            ("(1.00000x) can0 123#", "time stamp"),
            ("(99999999999999999999.000000) can0 123#", "time stamp"),
            ("(1.000000)", "name of a bus"),
            ("(1.000000) can0", "a frame"),
            ("(1.000000) can0 123", "`#`"),
            ("(1.000000) can0 12#", "3 digits"),
            ("(1.000000) can0 FFF#", "3 digits"),
            ("(1.000000) can0 123#1", "pairs"),
            ("(1.000000) can0 123#1122334455667788_8", "pairs"),
            ("(1.000000) can0 123#112233445566778899", "length"),
            ("(1.000000) can0 123##1112233445566778899", "length"),
            ("(1.000000) can0 123##", "digit of flags"),
            ("(1.000000) can0 123##é", "digit of flags"),
            ("(1.000000) can0 123#R9", "length"),
            ("(1.000000) can0 123#11 X", "direction"),
        ] {
            let error = parse_line(text).unwrap_err();
            assert!(error.expected.contains(expected), "{text}: {error}");
        }
    }

    proptest! {
        #[test]
        fn write_and_read_is_identity(time_us in 0_u64..1 << 50, id in 0_u32..0x2000_0000, ext: bool, kind in 0..3,
                                      brs: bool, data in prop::collection::vec(any::<u8>(), 0..=64)) {
            let id = if ext { extended(id) } else { standard((id & 0x7FF) as u16) };
            let frame = match kind {
                0 => Frame::classic(id, &data[..data.len().min(8)]),
                1 => Frame::remote(id, data.len().min(8)),
                _ => Frame::fd(id, &data, brs),
            }.unwrap();
            let record = parse_line(&line(time_us, &frame)).unwrap();
            prop_assert_eq!((record.time_us, record.frame), (time_us, Some(frame)));
        }

        #[test]
        fn any_text_is_refused_or_read_without_panic(text in "\\PC*") {
            let _ = parse_line(&text);
            let _ = parse_line(&format!("(1.000000) can0 {text}"));
        }
    }
}
