//! The boundary to a bus: receive into a frame, send a frame.

use crate::frame::Frame;

/// Why a bus did not do what was asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LinkError {
    /// The controller left the bus after too many transmit errors; [`Link::restart`] asks it to come back.
    BusOff,
    /// The transmit queue is full; the frame was not taken.
    Full,
    /// The bus cannot carry this frame (an FD frame on a classic controller, say).
    Unsupported,
    /// Anything else that the adapter knows about; the number is the adapter's own.
    Other(u16),
}

impl core::fmt::Display for LinkError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::BusOff => f.write_str("the CAN controller is bus-off"),
            Self::Full => f.write_str("the transmit queue is full"),
            Self::Unsupported => f.write_str("the bus cannot carry this kind of frame"),
            Self::Other(code) => write!(f, "bus error {code}"),
        }
    }
}

impl core::error::Error for LinkError {}

/// A bus as one participant sees it. Frames come in the order in which they were on the wire.
pub trait Link {
    /// Takes the next received frame, if there is one. Does not wait.
    ///
    /// # Errors
    /// [`LinkError::BusOff`] while the controller is off the bus, else what the adapter reports.
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError>;

    /// Queues a frame for sending. Does not wait.
    ///
    /// # Errors
    /// [`LinkError::Full`], [`LinkError::BusOff`] or [`LinkError::Unsupported`]; the frame was then not queued.
    fn send(&mut self, frame: &Frame) -> Result<(), LinkError>;

    /// Starts the recovery from bus-off (128 times 11 recessive bits, ISO 11898-1). A bus that cannot be off has
    /// nothing to do.
    ///
    /// # Errors
    /// What the adapter reports.
    fn restart(&mut self) -> Result<(), LinkError> {
        Ok(())
    }
}

impl<L: Link + ?Sized> Link for &mut L {
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        (**self).receive(frame)
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        (**self).send(frame)
    }

    fn restart(&mut self) -> Result<(), LinkError> {
        (**self).restart()
    }
}
