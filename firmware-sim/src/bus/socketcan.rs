//! A network interface of the Linux kernel: `vcan0`, `can0`.

use std::io::{self, ErrorKind};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::Duration;

use gadm_node::frame::{Kind, extended, standard};
use gadm_node::{Frame, Link, LinkError};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use socketcan::id::FdFlags;
use socketcan::{
    CanAnyFrame, CanDataFrame, CanFdFrame, CanFdSocket, CanRemoteFrame, EmbeddedFrame, Frame as _, Socket as _,
    SocketOptions as _,
};

use super::Bus;

/// Receive buffer that is asked for, bytes. A full one drops frames without a word; the kernel's default holds some 280.
const RECEIVE_BUFFER: usize = 8 << 20;

/// Bus-off in the identifier of an error frame (linux/can/error.h).
const ERROR_BUS_OFF: u32 = 0x40;

/// One participant on an interface. Clones are the same participant.
#[derive(Clone, Debug)]
pub struct SocketCan {
    socket: Arc<CanFdSocket>,
    interface: String,
}

impl SocketCan {
    /// Opens `interface` for classic and FD frames.
    ///
    /// # Errors
    /// Where the kernel has no CAN, there is no such interface, or it is down; each says what to do.
    pub fn open(interface: &str) -> io::Result<Self> {
        let hint = |e: io::Error| {
            let why = match e.raw_os_error() {
                Some(97 | 93) => "the kernel has no SocketCAN; `modprobe can can-raw vcan`, or use another bus",
                Some(19) => {
                    "no such interface; for a virtual one: `ip link add dev vcan0 type vcan; ip link set vcan0 mtu 72 up`"
                }
                Some(100) => "the interface is down; `ip link set INTERFACE up`",
                Some(1 | 13) => "this user may not open CAN sockets",
                _ => return e,
            };
            io::Error::new(e.kind(), format!("{e}: {why}"))
        };
        let socket = CanFdSocket::open(interface).map_err(hint)?;
        socket.set_nonblocking(true)?;
        socket.set_error_filter_accept_all()?;
        socket.as_raw_socket().set_recv_buffer_size(RECEIVE_BUFFER)?;
        Ok(Self { socket: Arc::new(socket), interface: interface.to_owned() })
    }

    /// Name of the interface.
    #[must_use]
    pub fn interface(&self) -> &str {
        &self.interface
    }
}

impl Link for SocketCan {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        loop {
            match self.socket.read_frame() {
                Ok(CanAnyFrame::Error(error)) if error.error_bits() & ERROR_BUS_OFF != 0 => {
                    return Err(LinkError::BusOff);
                }
                Ok(CanAnyFrame::Error(_)) => {}
                Ok(received) => {
                    if let Some(received) = from_kernel(&received) {
                        *frame = received;
                        return Ok(true);
                    }
                }
                Err(e) if e.kind() == ErrorKind::WouldBlock => return Ok(false),
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(super::link_error(&e)),
            }
        }
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        let out = to_kernel(frame).ok_or(LinkError::Unsupported)?;
        for _ in 0..1000 {
            match self.socket.write_frame(&out) {
                Ok(()) => return Ok(()),
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                // The queue of a real controller is short and empties at the bit rate.
                Err(e) if e.kind() == ErrorKind::WouldBlock || e.raw_os_error() == Some(105) => {
                    if !ready(&self.socket, PollFlags::OUT, Duration::from_millis(1)).is_ok_and(|r| r) {
                        continue;
                    }
                    std::thread::sleep(Duration::from_micros(100));
                }
                Err(e) if e.raw_os_error() == Some(22) => return Err(LinkError::Unsupported),
                Err(e) => return Err(super::link_error(&e)),
            }
        }
        Err(LinkError::Full)
    }

    // `restart` has nothing to do: the kernel restarts a controller by itself where the interface has `restart-ms`.
}

impl Bus for SocketCan {
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }

    fn wait(&mut self, timeout: Duration) -> io::Result<()> {
        ready(&self.socket, PollFlags::IN, timeout).map(|_| ())
    }
}

fn ready(socket: &CanFdSocket, events: PollFlags, timeout: Duration) -> io::Result<bool> {
    let time = Timespec::try_from(timeout).map_err(|_| ErrorKind::InvalidInput)?;
    match poll(&mut [PollFd::from_borrowed_fd(socket.as_fd(), events)], Some(&time)) {
        Ok(n) => Ok(n > 0),
        Err(rustix::io::Errno::INTR) => Ok(false),
        Err(e) => Err(e.into()),
    }
}

/// `None` for what is no frame of a bus.
fn from_kernel(frame: &CanAnyFrame) -> Option<Frame> {
    let id = if frame.is_extended() { extended(frame.raw_id()) } else { standard(frame.raw_id() as u16) };
    match frame {
        CanAnyFrame::Normal(f) => Frame::classic(id, f.data()),
        CanAnyFrame::Remote(f) => Frame::remote(id, f.dlc()),
        CanAnyFrame::Fd(f) => Frame::fd(id, f.data(), f.is_brs()),
        CanAnyFrame::Error(_) => None,
    }
}

fn to_kernel(frame: &Frame) -> Option<CanAnyFrame> {
    let id = frame.identifier();
    match frame.kind() {
        Kind::Classic => CanDataFrame::new(id, frame.payload()).map(Into::into),
        Kind::Remote => CanRemoteFrame::new_remote(id, frame.remote_dlc()?).map(Into::into),
        Kind::Fd { brs } => {
            let flags = if brs { FdFlags::BRS } else { FdFlags::empty() };
            CanFdFrame::with_flags(id, frame.payload(), flags).map(Into::into)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_survive_the_kernel_form() {
        for frame in [
            Frame::classic(standard(0x7FF), &[1, 2, 3]),
            Frame::classic(extended(0x1FFF_FFFF), &[0; 8]),
            Frame::classic(extended(0), &[]),
            Frame::remote(standard(5), 8),
            Frame::fd(standard(0), &[7; 64], true),
            Frame::fd(extended(0x12345), &[7; 12], false),
            Frame::fd(standard(1), &[], true),
        ] {
            let frame = frame.unwrap();
            assert_eq!(from_kernel(&to_kernel(&frame).unwrap()), Some(frame));
        }
    }

    #[test]
    fn an_interface_that_is_not_there_is_named_with_the_fix() {
        let error = SocketCan::open("gadm-no-such").unwrap_err().to_string();
        assert!(error.contains("ip link") || error.contains("modprobe"), "{error}");
    }
}
