//! One CAN frame, classic or FD, in a fixed 64-byte buffer.

use embedded_can::{ExtendedId, Id, StandardId};

/// Payload lengths that a CAN FD frame can have, by data length code.
pub const FD_LENGTHS: [usize; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];

/// The smallest length a CAN FD frame can have that holds `len` bytes; `None` above 64.
#[must_use]
pub fn fd_length(len: usize) -> Option<usize> {
    FD_LENGTHS.into_iter().find(|&l| l >= len)
}

/// What sort of frame it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Classic data frame, at most 8 bytes.
    Classic,
    /// Classic remote frame: no data, a length code only.
    Remote,
    /// CAN FD frame, at most 64 bytes, with or without bit-rate switch.
    Fd {
        /// The data phase runs at the higher bit rate.
        brs: bool,
    },
}

/// A CAN frame of up to 64 bytes with an 11-bit or 29-bit identifier.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    id: Id,
    kind: Kind,
    len: u8,
    data: [u8; 64],
}

impl Frame {
    /// An empty classic frame with identifier 0, to receive into.
    #[must_use]
    pub const fn empty() -> Self {
        Self { id: Id::Standard(StandardId::ZERO), kind: Kind::Classic, len: 0, data: [0; 64] }
    }

    /// A classic data frame; `None` where `payload` is longer than 8 bytes.
    #[must_use]
    pub fn classic(id: impl Into<Id>, payload: &[u8]) -> Option<Self> {
        if payload.len() > 8 { None } else { Self::build(id.into(), Kind::Classic, payload.len(), payload) }
    }

    /// A CAN FD frame, padded with zeros to the next length the format has; `None` above 64 bytes.
    #[must_use]
    pub fn fd(id: impl Into<Id>, payload: &[u8], brs: bool) -> Option<Self> {
        Self::build(id.into(), Kind::Fd { brs }, fd_length(payload.len())?, payload)
    }

    /// A classic remote frame; `None` where `dlc` is above 8.
    #[must_use]
    pub fn remote(id: impl Into<Id>, dlc: usize) -> Option<Self> {
        if dlc > 8 { None } else { Self::build(id.into(), Kind::Remote, dlc, &[]) }
    }

    fn build(id: Id, kind: Kind, len: usize, payload: &[u8]) -> Option<Self> {
        let mut data = [0; 64];
        data.get_mut(..payload.len())?.copy_from_slice(payload);
        Some(Self { id, kind, len: u8::try_from(len).ok()?, data })
    }

    /// The length code of a remote frame; `None` for others.
    #[must_use]
    pub fn remote_dlc(&self) -> Option<usize> {
        (self.kind == Kind::Remote).then_some(usize::from(self.len))
    }

    /// Identifier.
    #[must_use]
    pub fn identifier(&self) -> Id {
        self.id
    }

    /// Identifier as a number, without the mark of the 29-bit form.
    #[must_use]
    pub fn raw_id(&self) -> u32 {
        match self.id {
            Id::Standard(id) => u32::from(id.as_raw()),
            Id::Extended(id) => id.as_raw(),
        }
    }

    /// The 11-bit identifier; `None` for a 29-bit one.
    #[must_use]
    pub fn standard_id(&self) -> Option<u16> {
        match self.id {
            Id::Standard(id) => Some(id.as_raw()),
            Id::Extended(_) => None,
        }
    }

    /// Classic, remote or FD.
    #[must_use]
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The payload, padding included; empty for a remote frame.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        let len = if self.kind == Kind::Remote { 0 } else { usize::from(self.len) };
        self.data.get(..len).unwrap_or(&[])
    }

    /// The payload for in-place change (fault injection); empty for a remote frame.
    pub fn payload_mut(&mut self) -> &mut [u8] {
        let len = if self.kind == Kind::Remote { 0 } else { usize::from(self.len) };
        self.data.get_mut(..len).unwrap_or(&mut [])
    }
}

impl core::fmt::Debug for Frame {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{:03X} {:?} {:02X?}", self.raw_id(), self.kind, self.payload())
    }
}

impl embedded_can::Frame for Frame {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        if data.len() <= 8 {
            Self::classic(id, data)
        } else if FD_LENGTHS.contains(&data.len()) {
            Self::fd(id, data, true)
        } else {
            None
        }
    }

    fn new_remote(id: impl Into<Id>, dlc: usize) -> Option<Self> {
        Self::remote(id, dlc)
    }

    fn is_extended(&self) -> bool {
        matches!(self.id, Id::Extended(_))
    }

    fn is_remote_frame(&self) -> bool {
        self.kind == Kind::Remote
    }

    fn id(&self) -> Id {
        self.id
    }

    /// Length in bytes (which for CAN FD is not the four-bit code).
    fn dlc(&self) -> usize {
        usize::from(self.len)
    }

    fn data(&self) -> &[u8] {
        self.payload()
    }
}

/// An 11-bit identifier; values above 0x7FF are cut to 11 bits.
#[must_use]
pub fn standard(id: u16) -> Id {
    Id::Standard(StandardId::new(id & 0x7FF).unwrap_or(StandardId::ZERO))
}

/// A 29-bit identifier; higher bits are cut.
#[must_use]
pub fn extended(id: u32) -> Id {
    Id::Extended(ExtendedId::new(id & 0x1FFF_FFFF).unwrap_or(ExtendedId::ZERO))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fd_pads_to_the_next_length_with_zeros() {
        let f = Frame::fd(standard(0x123), &[1; 13], true).unwrap();
        assert_eq!(f.payload().len(), 16);
        assert_eq!(&f.payload()[12..], [1, 0, 0, 0]);
        assert!(Frame::fd(standard(1), &[0; 65], true).is_none());
    }

    #[test]
    fn classic_refuses_nine_bytes_and_remote_has_no_data() {
        assert!(Frame::classic(standard(1), &[0; 9]).is_none());
        let r = Frame::remote(standard(1), 4).unwrap();
        assert_eq!((r.payload().len(), embedded_can::Frame::dlc(&r)), (0, 4));
    }

    #[test]
    fn embedded_can_constructor_takes_classic_and_fd_lengths_only() {
        use embedded_can::Frame as _;
        assert_eq!(<Frame as embedded_can::Frame>::new(standard(7), &[0; 8]).unwrap().kind(), Kind::Classic);
        assert_eq!(<Frame as embedded_can::Frame>::new(standard(7), &[0; 12]).unwrap().kind(), Kind::Fd { brs: true });
        assert!(<Frame as embedded_can::Frame>::new(standard(7), &[0; 13]).is_none());
        assert!(<Frame as embedded_can::Frame>::new(extended(0x1234_5678), &[]).unwrap().is_extended());
    }
}
