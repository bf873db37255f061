//! Where the frames of a monitor come from. A thread of its own reads them, so that a slow terminal does not hold up a bus.

use std::io::{self, BufRead};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use gadm_node::Frame;

use crate::bus::load::BitRate;
use crate::bus::trace::parse_line;
use crate::bus::{self, Address};

/// Items that may wait. When they are full the reader waits, and what it reads from with it.
const QUEUE: usize = 1 << 16;

/// What a source gives.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    /// A frame and its time, microseconds.
    Frame(u64, Frame),
    /// An error frame of the controller and its time.
    ErrorFrame(u64),
    /// A line that is no frame: what is wrong with it.
    BadLine(String),
    /// There is no more.
    End(End),
}

/// Why there is no more.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// All was read.
    Done,
    /// The source broke off: why.
    Broken(String),
}

/// Frames from somewhere.
#[derive(Debug)]
pub struct Source {
    items: Receiver<Item>,
    ended: Option<End>,
}

impl Source {
    /// Candump text. With a pace of `x` a second of the trace takes `1 / x` seconds; without, it is read at once.
    pub fn trace(input: impl BufRead + Send + 'static, pace: Option<f64>) -> Self {
        Self::from_thread(move |items| read_trace(input, pace, items))
    }

    /// A bus, listening only. Times are those of arrival.
    pub fn bus(address: Address, rate: BitRate) -> Self {
        Self::from_thread(move |items| read_bus(&address, rate, items))
    }

    fn from_thread(read: impl FnOnce(&SyncSender<Item>) -> io::Result<()> + Send + 'static) -> Self {
        let (sender, items) = sync_channel(QUEUE);
        // It ends by itself: at the end of its input, or when nobody takes its items any more.
        thread::spawn(move || {
            let end = read(&sender).map_or_else(|e| End::Broken(e.to_string()), |()| End::Done);
            let _ = sender.send(Item::End(end));
        });
        Self { items, ended: None }
    }

    /// The next item that is there; `None` where there is none yet, or never will be.
    pub fn try_next(&mut self) -> Option<Item> {
        let item = match self.items.try_recv() {
            Ok(item) => item,
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => Item::End(End::Done),
        };
        self.note(item)
    }

    /// The next item, waiting for at most `timeout`.
    pub fn next_within(&mut self, timeout: Duration) -> Option<Item> {
        let item = match self.items.recv_timeout(timeout) {
            Ok(item) => item,
            Err(RecvTimeoutError::Timeout) => return None,
            Err(RecvTimeoutError::Disconnected) => Item::End(End::Done),
        };
        self.note(item)
    }

    fn note(&mut self, item: Item) -> Option<Item> {
        if let Item::End(end) = item {
            self.ended.get_or_insert(end);
            return None;
        }
        Some(item)
    }

    /// `Some` where there will be no more.
    #[must_use]
    pub fn ended(&self) -> Option<&End> {
        self.ended.as_ref()
    }
}

#[expect(clippy::disallowed_methods, reason = "a person watches; no result depends on it")]
fn now() -> Instant {
    Instant::now()
}

fn read_trace(input: impl BufRead, pace: Option<f64>, items: &SyncSender<Item>) -> io::Result<()> {
    let started = now();
    let mut first_us = None;
    for (i, line) in input.lines().enumerate() {
        let line = line?;
        if line.trim().is_empty() {
            continue;
        }
        let item = match parse_line(&line) {
            Ok(record) => {
                let first_us = *first_us.get_or_insert(record.time_us);
                if let Some(pace) = pace {
                    let due_s = record.time_us.saturating_sub(first_us) as f64 / 1e6 / pace;
                    let left_s = due_s - started.elapsed().as_secs_f64();
                    if left_s > 0.0 {
                        thread::sleep(Duration::from_secs_f64(left_s.min(3600.0)));
                    }
                }
                record.frame.map_or(Item::ErrorFrame(record.time_us), |frame| Item::Frame(record.time_us, frame))
            }
            Err(error) => Item::BadLine(format!("line {}: {error}", i + 1)),
        };
        if items.send(item).is_err() {
            break; // nobody listens
        }
    }
    Ok(())
}

fn read_bus(address: &Address, rate: BitRate, items: &SyncSender<Item>) -> io::Result<()> {
    let mut bus = bus::open(address, rate)
        .map_err(|error| io::Error::new(error.kind(), format!("cannot join {address}: {error}")))?;
    let started = now();
    let mut frame = Frame::empty();
    loop {
        while bus.receive(&mut frame).map_err(|error| io::Error::other(format!("{address}: {error}")))? {
            let time_us = started.elapsed().as_micros() as u64;
            if items.send(Item::Frame(time_us, frame)).is_err() {
                return Ok(());
            }
        }
        bus.wait(Duration::from_millis(200))?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trace_is_read_to_its_end_and_wrong_lines_are_told() {
        let text = "(1.000000) can0 080#0000000000000000\n\nnonsense\n(2.000000) can0 20000040#0000000000000000\n";
        let mut source = Source::trace(text.as_bytes(), None);
        let mut items = Vec::new();
        while source.ended().is_none() {
            items.extend(source.next_within(Duration::from_secs(10)));
        }
        assert!(matches!(items[0], Item::Frame(1_000_000, _)));
        assert!(matches!(&items[1], Item::BadLine(what) if what.starts_with("line 3: ")), "{items:?}");
        assert_eq!(items[2..], [Item::ErrorFrame(2_000_000)]);
        assert_eq!(source.ended(), Some(&End::Done));
    }

    #[test]
    fn a_bus_that_is_not_there_is_an_end_with_a_reason() {
        let mut source = Source::bus(Address::Unix("/nowhere/can.sock".into()), BitRate::default());
        while source.ended().is_none() {
            assert_eq!(source.next_within(Duration::from_secs(10)), None);
        }
        let end = source.ended().unwrap();
        assert!(matches!(end, End::Broken(why) if why.starts_with("cannot join unix:/nowhere/can.sock: ")), "{end:?}");
    }
}
