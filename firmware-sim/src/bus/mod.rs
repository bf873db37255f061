//! Buses: the one in process and those between processes; traces, load.

pub mod address;
pub mod exchange;
pub mod hub;
pub mod load;
pub mod lockstep;
pub mod loopback;
#[cfg(all(target_os = "linux", feature = "socketcan"))]
pub mod socketcan;
pub mod stream;
pub mod trace;

use std::io;
use std::time::Duration;

use gadm_node::{Link, LinkError};

pub use address::Address;
use load::BitRate;

/// A bus between processes, as one participant sees it.
pub trait Bus: Link {
    /// Sends what [`Link::send`] queued.
    ///
    /// # Errors
    /// Where the bus is gone or takes nothing for five seconds.
    fn flush(&mut self) -> io::Result<()>;

    /// Waits until there may be something to receive, at most `timeout`.
    ///
    /// # Errors
    /// Where the bus is gone.
    fn wait(&mut self, timeout: Duration) -> io::Result<()>;
}

/// Joins the bus at `address`.
///
/// # Errors
/// Where there is none, or this program was built without it.
pub fn open(address: &Address, rate: BitRate) -> io::Result<Box<dyn Bus>> {
    match address {
        Address::SocketCan(interface) => open_socketcan(interface),
        _ => Ok(Box::new(stream::SlcanStream::open(address, rate)?)),
    }
}

#[cfg(all(target_os = "linux", feature = "socketcan"))]
fn open_socketcan(interface: &str) -> io::Result<Box<dyn Bus>> {
    Ok(Box::new(socketcan::SocketCan::open(interface)?))
}

#[cfg(not(all(target_os = "linux", feature = "socketcan")))]
fn open_socketcan(_: &str) -> io::Result<Box<dyn Bus>> {
    Err(io::Error::new(
        io::ErrorKind::Unsupported,
        "this program has no SocketCAN: it needs Linux and the feature `socketcan` at build time",
    ))
}

/// What a node is told of an error of the operating system: its number, where it has one.
pub(crate) fn link_error(error: &io::Error) -> LinkError {
    LinkError::Other(error.raw_os_error().and_then(|n| u16::try_from(n).ok()).unwrap_or(u16::MAX))
}
