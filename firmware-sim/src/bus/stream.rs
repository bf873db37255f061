//! A bus behind a stream of bytes that carries SLCAN: a hub's socket, a pseudo-terminal, a serial adapter.

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use gadm_node::slcan::{Command, Decoder, MAX_LINE, encode};
use gadm_node::{Frame, Link, LinkError};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::Bus;
use super::address::Address;
use super::load::BitRate;

/// Received frames that may wait; a reader that lags further behind loses the bus and is told.
const INBOX: usize = 1 << 16;

/// Bytes that may wait to be sent before [`Link::send`] says that the queue is full.
const OUTBOX: usize = 1 << 20;

/// How long an adapter may take to answer when it is opened.
const OPENING: Duration = Duration::from_secs(10);
/// After which time without an answer the opening is said again.
const RETRY: Duration = Duration::from_secs(1);
/// Time without a byte after which no answer to an earlier try is expected.
const QUIET: Duration = Duration::from_millis(200);

/// Speed of a serial device, bit/s. USB adapters ignore it.
const BAUD: u32 = 115_200;

/// One participant of a bus, on the host's side of an SLCAN adapter.
#[derive(Debug)]
pub struct SlcanStream {
    file: File,
    decoder: Decoder,
    inbox: VecDeque<Frame>,
    outbox: Vec<u8>,
    /// Lines that are not SLCAN, and frames that the adapter refused.
    bad_lines: u64,
    refused: u64,
    answered: bool,
}

impl SlcanStream {
    /// Connects and opens the channel.
    ///
    /// # Errors
    /// Where there is nothing at `address`, or nothing that answers as an SLCAN adapter does, or where it has no letter
    /// for the bit rate.
    pub fn open(address: &Address, rate: BitRate) -> io::Result<Self> {
        let (fd, hardware) = match address {
            Address::Unix(path) => (OwnedFd::from(UnixStream::connect(path)?), false),
            Address::Tcp(text) => (OwnedFd::from(connect_tcp(text)?), false),
            Address::Serial(path) => (OwnedFd::from(open_serial(path)?), true),
            Address::SocketCan(_) => return Err(io::Error::new(ErrorKind::Unsupported, "not a stream of bytes")),
        };
        let mut stream = Self::over(fd)?;
        let letters = match opening(rate) {
            Ok(letters) => letters,
            Err(error) if hardware => return Err(error),
            Err(_) => "C\rO\r".to_owned(), // a hub has no bit rate
        };
        // The version is answered after everything before it: the channel is open then. A board that still boots loses
        // what comes, so it is said again.
        let end = deadline(OPENING);
        let mut tries = 0;
        while !stream.answered {
            stream.outbox.extend_from_slice(letters.as_bytes());
            stream.outbox.extend_from_slice(b"V\r");
            tries += 1;
            let again = deadline(RETRY);
            while !stream.answered
                && let Some(left) = left(again)
            {
                stream.flush()?;
                stream.read_available()?;
                if !stream.answered {
                    stream.wait(left)?;
                }
            }
            if !stream.answered && left(end).is_none() {
                let what = "what is there does not answer as an SLCAN adapter does";
                return Err(io::Error::new(ErrorKind::TimedOut, what));
            }
        }
        // Answers to the other tries may still be under way, and what was said while the channel was closed is lost.
        let end = deadline(RETRY);
        while tries > 1 && left(end).is_some() && stream.ready(PollFlags::IN, QUIET)?.contains(PollFlags::IN) {
            stream.read_available()?;
        }
        stream.inbox.clear();
        Ok(stream)
    }

    /// A participant on an open stream, without the opening conversation.
    ///
    /// # Errors
    /// Where the descriptor cannot be set up.
    pub fn over(fd: OwnedFd) -> io::Result<Self> {
        fcntl_setfl(&fd, fcntl_getfl(&fd)? | OFlags::NONBLOCK)?;
        Ok(Self {
            file: File::from(fd),
            decoder: Decoder::host(),
            inbox: VecDeque::new(),
            outbox: Vec::new(),
            bad_lines: 0,
            refused: 0,
            answered: false,
        })
    }

    /// Lines that were not SLCAN, and BELs, so far.
    #[must_use]
    pub fn errors(&self) -> (u64, u64) {
        (self.bad_lines, self.refused)
    }

    fn read_available(&mut self) -> io::Result<()> {
        let mut bytes = [0; 4096];
        loop {
            match self.file.read(&mut bytes) {
                Ok(0) => return Err(io::Error::new(ErrorKind::ConnectionReset, "the bus closed the connection")),
                Ok(n) => self.take(&bytes[..n])?,
                Err(e) if e.kind() == ErrorKind::WouldBlock => return Ok(()),
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
    }

    fn take(&mut self, bytes: &[u8]) -> io::Result<()> {
        for line in bytes.iter().filter_map(|&b| self.decoder.push(b)) {
            match line {
                Ok(Command::Frame(frame)) if self.inbox.len() < INBOX => self.inbox.push_back(frame),
                Ok(Command::Frame(_)) => return Err(io::Error::other("more frames came than could be handled")),
                Ok(Command::Refused) => self.refused += 1,
                Ok(Command::Answer(b'V')) => self.answered = true,
                Ok(_) => {}
                Err(_) => self.bad_lines += 1,
            }
        }
        Ok(())
    }

    fn ready(&self, events: PollFlags, timeout: Duration) -> io::Result<PollFlags> {
        let time = Timespec::try_from(timeout).map_err(|_| ErrorKind::InvalidInput)?;
        let mut fds = [PollFd::from_borrowed_fd(self.file.as_fd(), events)];
        match poll(&mut fds, Some(&time)) {
            Ok(_) => Ok(fds[0].revents()),
            Err(rustix::io::Errno::INTR) => Ok(PollFlags::empty()),
            Err(e) => Err(e.into()),
        }
    }
}

impl Link for SlcanStream {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        if self.inbox.is_empty() {
            self.read_available().map_err(|e| super::link_error(&e))?;
        }
        let next = self.inbox.pop_front();
        if let Some(next) = next {
            *frame = next;
        }
        Ok(next.is_some())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        if self.outbox.len() + MAX_LINE > OUTBOX {
            return Err(LinkError::Full);
        }
        let mut line = [0; MAX_LINE];
        let len = encode(frame, &mut line);
        self.outbox.extend_from_slice(&line[..len]);
        Ok(())
    }
}

impl Bus for SlcanStream {
    fn flush(&mut self) -> io::Result<()> {
        let mut sent = 0;
        while sent < self.outbox.len() {
            match self.file.write(&self.outbox[sent..]) {
                Ok(n) => sent += n,
                Err(e) if e.kind() == ErrorKind::WouldBlock => {
                    // Read meanwhile: the other side may wait for us to.
                    let ready = self.ready(PollFlags::IN | PollFlags::OUT, Duration::from_secs(5))?;
                    if ready.is_empty() {
                        return Err(io::Error::new(ErrorKind::TimedOut, "the bus takes no bytes"));
                    }
                    if ready.intersects(PollFlags::IN | PollFlags::HUP | PollFlags::ERR) {
                        self.read_available()?;
                    }
                }
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
        self.outbox.clear();
        Ok(())
    }

    fn wait(&mut self, timeout: Duration) -> io::Result<()> {
        if self.inbox.is_empty() {
            self.ready(PollFlags::IN, timeout)?;
        }
        Ok(())
    }
}

/// The letters that set the bit rates and open the channel.
fn opening(rate: BitRate) -> io::Result<String> {
    let wrong = |what: &str, bps: u32, has: &str| {
        io::Error::new(
            ErrorKind::InvalidInput,
            format!("SLCAN has no letter for a {what} bit rate of {bps}: it has {has}"),
        )
    };
    let nominal = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];
    let s = nominal.iter().position(|&n| n == rate.nominal).ok_or_else(|| {
        wrong("nominal", rate.nominal, "10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000, 1000000")
    })?;
    let y = match rate.data {
        2_000_000 => 2,
        5_000_000 => 5,
        other => return Err(wrong("data", other, "2000000, 5000000")),
    };
    Ok(format!("C\rS{s}\rY{y}\rO\r"))
}

fn connect_tcp(text: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::new(ErrorKind::NotFound, "the name has no address");
    for address in text.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, OPENING) {
            Ok(stream) => {
                stream.set_nodelay(true)?; // a set and its answer are small
                return Ok(stream);
            }
            Err(e) => last = e,
        }
    }
    Err(last)
}

fn open_serial(path: &Path) -> io::Result<File> {
    let flags = (OFlags::NOCTTY | OFlags::NONBLOCK).bits().cast_signed();
    let mut options = OpenOptions::new();
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, flags);
    let file = options.read(true).write(true).open(path)?;
    let mut settings = tcgetattr(&file)?;
    settings.make_raw();
    settings.set_speed(BAUD)?;
    tcsetattr(&file, OptionalActions::Flush, &settings)?;
    Ok(file)
}

#[expect(clippy::disallowed_methods, reason = "a guard against a partner that is gone; no result depends on it")]
pub(crate) fn deadline(after: Duration) -> Instant {
    Instant::now() + after
}

/// Time left until `deadline`; `None` when it has passed.
#[expect(clippy::disallowed_methods, reason = "a guard against a partner that is gone; no result depends on it")]
pub(crate) fn left(deadline: Instant) -> Option<Duration> {
    deadline.checked_duration_since(Instant::now()).filter(|d| !d.is_zero())
}

#[cfg(test)]
mod tests {
    use super::*;
    use gadm_node::frame::standard;

    fn pair() -> (SlcanStream, UnixStream) {
        let (ours, theirs) = UnixStream::pair().unwrap();
        (SlcanStream::over(ours.into()).unwrap(), theirs)
    }

    #[test]
    fn frames_cross_in_order_and_noise_is_counted() {
        let (mut stream, mut adapter) = pair();
        adapter.write_all(b"t12311\r\x07?\rt1231FF\rz\rt124103\r").unwrap();
        stream.wait(Duration::from_secs(5)).unwrap();
        let mut frame = Frame::empty();
        let mut got = Vec::new();
        while stream.receive(&mut frame).unwrap() {
            got.push(frame);
        }
        assert_eq!(got, [(0x123, 0xFF), (0x124, 3)].map(|(id, b)| Frame::classic(standard(id), &[b]).unwrap()));
        assert_eq!(stream.errors(), (2, 1));
        stream.send(&got[1]).unwrap();
        stream.flush().unwrap();
        let mut bytes = [0; 64];
        assert_eq!(adapter.read(&mut bytes).unwrap(), 8);
        assert_eq!(&bytes[..8], b"t124103\r");
    }

    #[test]
    fn a_partner_that_is_gone_is_an_error_and_one_that_does_not_read_fills_the_queue() {
        let (mut stream, adapter) = pair();
        let frame = Frame::fd(standard(1), &[0; 64], true).unwrap();
        let taken = (0..OUTBOX).take_while(|_| stream.send(&frame).is_ok()).count();
        assert!(taken * 134 <= OUTBOX && taken * 134 > OUTBOX - 300);
        drop(adapter);
        assert!(stream.flush().is_err());
        assert!(stream.receive(&mut Frame::empty()).is_err());
    }

    #[test]
    fn bit_rates_that_slcan_lacks_are_named() {
        assert_eq!(opening(BitRate::default()).unwrap(), "C\rS6\rY2\rO\r");
        assert!(opening(BitRate { nominal: 333_333, data: 2_000_000 }).unwrap_err().to_string().contains("333333"));
        assert!(opening(BitRate { nominal: 500_000, data: 3_000_000 }).unwrap_err().to_string().contains("5000000"));
    }
}
