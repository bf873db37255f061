//! SLCAN, the ASCII lines that serial CAN adapters speak: the bus as a stream of bytes.
//!
//! One codec serves the UART of a board, a USB adapter, python-can, Linux `slcand` and the simulator's hub. A line is
//! ASCII ended by CR; an adapter answers CR for done and BEL for refused. Frames travel both ways in the same letters:
//!
//! | line | frame |
//! | --- | --- |
//! | `tIIIL…` `TIIIIIIIIL…` | classic data, 11-bit and 29-bit identifier, `L` bytes |
//! | `rIIIL` `RIIIIIIIIL` | classic remote |
//! | `dIIIL…` `DIIIIIIIIL…` | CAN FD without bit-rate switch, `L` a data length code |
//! | `bIIIL…` `BIIIIIIIIL…` | CAN FD with bit-rate switch |
//!
//! ```
//! use gadm_node::slcan::{Command, Decoder, MAX_LINE, encode};
//! use gadm_node::{Frame, frame::standard};
//!
//! let frame = Frame::classic(standard(0x123), &[0x11, 0x22]).unwrap();
//! let mut line = [0; MAX_LINE];
//! let len = encode(&frame, &mut line);
//! assert_eq!(&line[..len], b"t12321122\r");
//!
//! let mut decoder = Decoder::new();
//! let read = line[..len].iter().find_map(|&byte| decoder.push(byte));
//! assert_eq!(read, Some(Ok(Command::Frame(frame))));
//! ```
//!
//! Source: the Lawicel CANUSB manual for the classic letters; the CANable 2 firmware for `d D b B Y`.

use embedded_can::{ExtendedId, Id, StandardId};

use crate::frame::{FD_LENGTHS, Frame, Kind};

/// Ends every line; alone, the answer "done".
pub const CR: u8 = b'\r';

/// The answer "done" to a line that asks for nothing.
pub const ACK: u8 = CR;

/// The answer "refused".
pub const BEL: u8 = 0x07;

/// Longest line, CR included: CAN FD with 29-bit identifier, 64 bytes and a time stamp.
pub const MAX_LINE: usize = 1 + 8 + 1 + 128 + 4 + 1;

/// Answer to `V`: hardware 1.0, software 1.3.
const VERSION: &[u8] = b"V1013\r";

/// Answer to `N`.
const SERIAL: &[u8] = b"NGADM\r";

/// Answer to `F`: no error.
const STATUS: &[u8] = b"F00\r";

/// What a line says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Command {
    /// `t T r R d D b B`: a frame.
    Frame(Frame),
    /// `O`: open the channel.
    Open,
    /// `L`: open it for listening only.
    Listen,
    /// `C`: close it.
    Close,
    /// `S0` to `S9`: nominal bit rate, as its number. 0 to 8 are 10, 20, 50, 100, 125, 250, 500, 800, 1000 kbit/s.
    BitRate(u8),
    /// `Y0` to `Y9`: data bit rate of CAN FD, as its number; 2 and 5 are Mbit/s.
    DataRate(u8),
    /// `sXXYY`: bit timing registers of an SJA1000.
    BitTiming(u8, u8),
    /// `V`: asks for the version.
    Version,
    /// `N`: asks for the serial number.
    Serial,
    /// `F`: asks for the status flags.
    Status,
    /// `Z0`, `Z1`: time stamps off, on.
    Timestamps(bool),
    /// A line without anything: from a host a request for a sign of life, from an adapter "done".
    Empty,
    /// `z`, `Z` from an adapter: a frame was taken.
    Sent,
    /// BEL from an adapter: the last line was refused.
    Refused,
    /// `V…`, `N…`, `F…` from an adapter: the answer to the letter in it.
    Answer(u8),
}

/// Why a line is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// It begins with a letter that is not SLCAN.
    Letter(u8),
    /// A character that is not a digit stands where a digit must be.
    Digit(u8),
    /// The number is out of range: an identifier above 11 or 29 bits, a length above 8.
    Range,
    /// It ends too early.
    Short,
    /// It goes on behind its end.
    Long,
    /// It has more than [`MAX_LINE`] characters; all up to CR were dropped.
    Overlong,
}

impl core::fmt::Display for Error {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Letter(byte) => write!(f, "expected an SLCAN letter, found 0x{byte:02X}"),
            Self::Digit(byte) => write!(f, "expected a hexadecimal digit, found 0x{byte:02X}"),
            Self::Range => f.write_str("identifier above 11 or 29 bits, or length code above 8"),
            Self::Short => f.write_str("line ends too early"),
            Self::Long => f.write_str("line goes on behind its end"),
            Self::Overlong => write!(f, "line of more than {MAX_LINE} characters"),
        }
    }
}

impl core::error::Error for Error {}

/// Bytes to commands. Never loses its place: whatever came before, the line after the next CR is read.
#[derive(Clone, Debug)]
pub struct Decoder {
    line: [u8; MAX_LINE],
    len: usize,
    overlong: bool,
    from_adapter: bool,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// For the adapter's side: reads what a host writes.
    #[must_use]
    pub const fn new() -> Self {
        Self { line: [0; MAX_LINE], len: 0, overlong: false, from_adapter: false }
    }

    /// For the host's side: reads what an adapter writes, its answers and time stamps (which are dropped) included.
    #[must_use]
    pub const fn host() -> Self {
        Self { from_adapter: true, ..Self::new() }
    }

    /// Takes one byte; says something at the end of each line. LF is ignored.
    ///
    /// # Errors
    /// `Some(Err(_))` for a line that is not SLCAN. The next line is not affected.
    pub fn push(&mut self, byte: u8) -> Option<Result<Command, Error>> {
        match byte {
            b'\n' => None,
            CR => {
                let read = if self.overlong { Err(Error::Overlong) } else { self.read() };
                (self.len, self.overlong) = (0, false);
                Some(read)
            }
            // An adapter's BEL comes between lines, never within one.
            BEL if self.from_adapter && self.len == 0 && !self.overlong => Some(Ok(Command::Refused)),
            byte => {
                // The last place is for CR.
                match self.line.get_mut(self.len) {
                    Some(place) if self.len < MAX_LINE - 1 => {
                        *place = byte;
                        self.len += 1;
                    }
                    _ => self.overlong = true,
                }
                None
            }
        }
    }

    fn read(&self) -> Result<Command, Error> {
        let Some((&letter, rest)) = self.line.get(..self.len).and_then(<[u8]>::split_first) else {
            return Ok(Command::Empty);
        };
        let mut rest = Digits(rest);
        let command = match letter {
            b't' | b'T' | b'r' | b'R' | b'd' | b'D' | b'b' | b'B' => {
                let frame = rest.frame(letter)?;
                if self.from_adapter && rest.0.len() == 4 {
                    rest.number(4)?; // time stamp
                }
                Command::Frame(frame)
            }
            b'V' | b'N' | b'F' if self.from_adapter => return Ok(Command::Answer(letter)),
            b'z' | b'Z' if self.from_adapter && rest.0.is_empty() => Command::Sent,
            b'O' => Command::Open,
            b'L' => Command::Listen,
            b'C' => Command::Close,
            b'V' => Command::Version,
            b'N' => Command::Serial,
            b'F' => Command::Status,
            b'S' => Command::BitRate(rest.decimal()?),
            b'Y' => Command::DataRate(rest.decimal()?),
            b's' => Command::BitTiming(rest.byte()?, rest.byte()?),
            b'Z' => match rest.decimal()? {
                0 => Command::Timestamps(false),
                1 => Command::Timestamps(true),
                _ => return Err(Error::Range),
            },
            other => return Err(Error::Letter(other)),
        };
        if rest.0.is_empty() { Ok(command) } else { Err(Error::Long) }
    }
}

/// What is left of a line.
struct Digits<'a>(&'a [u8]);

impl Digits<'_> {
    fn digit(&mut self) -> Result<u8, Error> {
        let (&byte, rest) = self.0.split_first().ok_or(Error::Short)?;
        let value = match byte {
            b'0'..=b'9' => byte - b'0',
            b'A'..=b'F' => byte - b'A' + 10,
            b'a'..=b'f' => byte - b'a' + 10,
            _ => return Err(Error::Digit(byte)),
        };
        self.0 = rest;
        Ok(value)
    }

    fn decimal(&mut self) -> Result<u8, Error> {
        let digit = self.digit()?;
        if digit < 10 { Ok(digit) } else { Err(Error::Range) }
    }

    fn byte(&mut self) -> Result<u8, Error> {
        Ok(self.digit()? << 4 | self.digit()?)
    }

    /// At most 8 digits.
    fn number(&mut self, digits: usize) -> Result<u32, Error> {
        (0..digits).try_fold(0, |n: u32, _| Ok(n << 4 | u32::from(self.digit()?)))
    }

    fn frame(&mut self, letter: u8) -> Result<Frame, Error> {
        let id = if letter.is_ascii_uppercase() {
            Id::Extended(ExtendedId::new(self.number(8)?).ok_or(Error::Range)?)
        } else {
            let number = u16::try_from(self.number(3)?).map_err(|_| Error::Range)?;
            Id::Standard(StandardId::new(number).ok_or(Error::Range)?)
        };
        let code = usize::from(self.digit()?);
        let letter = letter.to_ascii_lowercase();
        if letter == b'r' {
            return Frame::remote(id, code).ok_or(Error::Range);
        }
        let fd = letter != b't';
        if !fd && code > 8 {
            return Err(Error::Range);
        }
        let len = FD_LENGTHS.get(code).copied().ok_or(Error::Range)?;
        let mut data = [0; 64];
        let payload = data.get_mut(..len).ok_or(Error::Range)?;
        for byte in payload.iter_mut() {
            *byte = self.byte()?;
        }
        if fd { Frame::fd(id, payload, letter == b'b') } else { Frame::classic(id, payload) }.ok_or(Error::Range)
    }
}

/// Writes the line of a frame, CR included, to the front of `line`, and returns its length.
pub fn encode(frame: &Frame, line: &mut [u8; MAX_LINE]) -> usize {
    let mut out = Line { bytes: line, len: 0 };
    out.frame(frame);
    out.put(CR);
    out.len
}

/// As [`encode`], with the time stamp that a host asks for with `Z1`: milliseconds, modulo one minute.
pub fn encode_stamped(frame: &Frame, time_ms: u64, line: &mut [u8; MAX_LINE]) -> usize {
    let mut out = Line { bytes: line, len: 0 };
    out.frame(frame);
    out.hex(time_ms % 60_000, 4);
    out.put(CR);
    out.len
}

struct Line<'a> {
    bytes: &'a mut [u8; MAX_LINE],
    len: usize,
}

impl Line<'_> {
    fn put(&mut self, byte: u8) {
        // A frame's line fits; see MAX_LINE.
        if let Some(place) = self.bytes.get_mut(self.len) {
            *place = byte;
            self.len += 1;
        }
    }

    fn hex(&mut self, number: u64, digits: u32) {
        const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
        for i in (0..digits).rev() {
            let nibble = usize::try_from(number >> (4 * i) & 0xF).unwrap_or(0);
            self.put(DIGITS.get(nibble).copied().unwrap_or(b'0'));
        }
    }

    fn frame(&mut self, frame: &Frame) {
        let letter = match frame.kind() {
            Kind::Classic => b't',
            Kind::Remote => b'r',
            Kind::Fd { brs: false } => b'd',
            Kind::Fd { brs: true } => b'b',
        };
        let id = u64::from(frame.raw_id());
        if frame.standard_id().is_some() {
            self.put(letter);
            self.hex(id, 3);
        } else {
            self.put(letter.to_ascii_uppercase());
            self.hex(id, 8);
        }
        let len = frame.remote_dlc().unwrap_or(frame.payload().len());
        // A frame's length is always one of the table.
        let code = FD_LENGTHS.iter().position(|&l| l >= len).unwrap_or(0);
        self.hex(code as u64, 1);
        for &byte in frame.payload() {
            self.hex(u64::from(byte), 2);
        }
    }
}

/// The adapter's side of a conversation: whether the channel is open, and what to answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Adapter {
    open: bool,
    listen_only: bool,
    timestamps: bool,
}

/// What to do with a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Handled {
    /// Bytes for the host.
    pub answer: &'static [u8],
    /// A frame for the bus.
    pub frame: Option<Frame>,
}

impl Adapter {
    /// A closed channel.
    #[must_use]
    pub const fn new() -> Self {
        Self { open: false, listen_only: false, timestamps: false }
    }

    /// A channel that is open from the start, for boards whose only host is a bus.
    #[must_use]
    pub const fn opened() -> Self {
        Self { open: true, ..Self::new() }
    }

    /// Frames of the bus are to be passed to the host.
    #[must_use]
    pub const fn is_open(self) -> bool {
        self.open
    }

    /// The host wants time stamps.
    #[must_use]
    pub const fn timestamps(self) -> bool {
        self.timestamps
    }

    /// Handles what a [`Decoder::new`] said. Opening an open channel and closing a closed one are no errors, since
    /// python-can does both. Answers of adapters get no answer, so that two adapters cannot talk without end.
    pub fn handle(&mut self, line: Result<Command, Error>) -> Handled {
        const DONE: &[u8] = &[ACK];
        const REFUSED: &[u8] = &[BEL];
        let Ok(command) = line else { return Handled { answer: REFUSED, frame: None } };
        let mut frame = None;
        let answer = match command {
            Command::Frame(f) if self.open && !self.listen_only => {
                frame = Some(f);
                DONE
            }
            Command::Open | Command::Listen => {
                (self.open, self.listen_only) = (true, command == Command::Listen);
                DONE
            }
            Command::Close => {
                (self.open, self.listen_only) = (false, false);
                DONE
            }
            Command::BitRate(_) | Command::DataRate(_) | Command::BitTiming(..) if self.open => REFUSED,
            Command::Frame(_) | Command::BitRate(9) => REFUSED,
            Command::BitRate(_) | Command::DataRate(_) | Command::BitTiming(..) | Command::Empty => DONE,
            Command::Timestamps(on) => {
                self.timestamps = on;
                DONE
            }
            Command::Version => VERSION,
            Command::Serial => SERIAL,
            Command::Status => STATUS,
            Command::Sent | Command::Refused | Command::Answer(_) => &[],
        };
        Handled { answer, frame }
    }
}

#[cfg(test)]
#[path = "slcan_tests.rs"]
mod tests;
