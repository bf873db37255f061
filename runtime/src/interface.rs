//! The interface record: what a policy expects to see and what it drives.
//!
//! The records stay in the image and are decoded when asked for; `load` has checked every one.

use crate::fields::{f32_at, text_at, u16_at, u32_at};
use crate::space::ActionHead;

/// Bytes of the fixed part of the section.
pub(crate) const INTERFACE_HEAD: usize = 16;
/// Bytes of an observation record.
pub(crate) const OBSERVATION_LEN: usize = 16;
/// Bytes of an action record.
pub(crate) const ACTION_LEN: usize = 24;

/// Codes of [`ActionHead`] in an action record.
pub(crate) const HEAD_CONTINUOUS: u16 = 0;
pub(crate) const HEAD_DISCRETE: u16 = 1;
pub(crate) const HEAD_BINARY: u16 = 2;

/// One observation signal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObservationSignal<'a> {
    /// Name, unique in the policy.
    pub name: &'a str,
    /// Unit, empty when the signal has none.
    pub unit: &'a str,
    /// Lower bound of the usual range, in that unit; scales integer bus profiles.
    pub lo: f32,
    /// Upper bound of the usual range, in that unit.
    pub hi: f32,
}

/// One action slot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActionSignal<'a> {
    /// Name, unique in the policy.
    pub name: &'a str,
    /// Unit, empty when the signal has none.
    pub unit: &'a str,
    /// What the slot may hold, with bounds in that unit.
    pub head: ActionHead,
    /// Value that brings the actuator to a safe state, in that unit.
    pub safe: f32,
}

/// The records of the interface section.
#[derive(Clone, Copy, Debug)]
pub(crate) struct InterfaceView<'a> {
    pub(crate) observations: &'a [[u8; OBSERVATION_LEN]],
    pub(crate) actions: &'a [[u8; ACTION_LEN]],
    pub(crate) text: &'a [u8],
}

impl<'a> InterfaceView<'a> {
    pub(crate) fn observation_signals(self) -> impl Iterator<Item = ObservationSignal<'a>> + Clone + use<'a> {
        self.observations.iter().map(move |record| self.observation(record))
    }

    pub(crate) fn action_signals(self) -> impl Iterator<Item = ActionSignal<'a>> + Clone + use<'a> {
        self.actions.iter().map(move |record| self.action(record))
    }

    /// Name and unit of a record of either kind.
    fn texts(self, record: &[u8]) -> (&'a str, &'a str) {
        let at = u32_at(record, 0).unwrap_or_default() as usize;
        let name_len = usize::from(u16_at(record, 4).unwrap_or_default());
        let unit_len = usize::from(u16_at(record, 6).unwrap_or_default());
        (text_at(self.text, at, name_len), text_at(self.text, at.wrapping_add(name_len), unit_len))
    }

    fn observation(self, record: &[u8; OBSERVATION_LEN]) -> ObservationSignal<'a> {
        let (name, unit) = self.texts(record);
        let lo = f32_at(record, 8).unwrap_or_default();
        ObservationSignal { name, unit, lo, hi: f32_at(record, 12).unwrap_or_default() }
    }

    fn action(self, record: &[u8; ACTION_LEN]) -> ActionSignal<'a> {
        let (name, unit) = self.texts(record);
        ActionSignal { name, unit, head: action_head(record), safe: f32_at(record, 20).unwrap_or_default() }
    }
}

/// The head of an action record.
pub(crate) fn action_head(record: &[u8; ACTION_LEN]) -> ActionHead {
    match u16_at(record, 8) {
        Some(HEAD_DISCRETE) => ActionHead::Discrete { n: u16_at(record, 10).unwrap_or_default() },
        Some(HEAD_BINARY) => ActionHead::Binary,
        _ => ActionHead::Continuous {
            lo: f32_at(record, 12).unwrap_or_default(),
            hi: f32_at(record, 16).unwrap_or_default(),
        },
    }
}

/// Hash of an interface: FNV-1a, 64 bits, over a byte stream that does not depend on the file format. `load` feeds it while
/// it checks the records.
///
/// The stream is: control period (u32); number of observations (u16), then per observation name, `0x00`, unit, `0x00`,
/// lo, hi (f32); number of actions (u16), then per action name, `0x00`, unit, `0x00`, kind (u16: 0 continuous,
/// 1 discrete, 2 binary), n (u16), lo, hi, safe (f32). Numbers are little endian; unused numbers are zero.
#[inline(never)]
pub(crate) fn fnv(hash: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(hash, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3))
}

/// The hash of nothing.
pub(crate) const FNV_START: u64 = 0xCBF2_9CE4_8422_2325;

/// The hash of records that are being written.
#[cfg(feature = "encode")]
pub(crate) fn interface_hash(interface: InterfaceView<'_>, control_period_us: u32) -> u64 {
    let mut hash = FNV_START;
    let count = |len: usize| u16::try_from(len).unwrap_or(u16::MAX).to_le_bytes();
    let names = |hash: u64, name: &str, unit: &str, record: &[u8]| {
        let parts = [name.as_bytes(), &[0], unit.as_bytes(), &[0], record.get(8..).unwrap_or_default()];
        parts.into_iter().fold(hash, fnv)
    };
    hash = fnv(hash, &control_period_us.to_le_bytes());
    hash = fnv(hash, &count(interface.observations.len()));
    for (signal, record) in interface.observation_signals().zip(interface.observations) {
        hash = names(hash, signal.name, signal.unit, record);
    }
    hash = fnv(hash, &count(interface.actions.len()));
    for (signal, record) in interface.action_signals().zip(interface.actions) {
        hash = names(hash, signal.name, signal.unit, record);
    }
    hash
}

#[cfg(test)]
mod tests {
    use super::{FNV_START, fnv};

    #[test]
    fn fnv_matches_the_published_vectors() {
        assert_eq!(fnv(FNV_START, b""), 0xCBF2_9CE4_8422_2325);
        assert_eq!(fnv(FNV_START, b"a"), 0xAF63_DC4C_8601_EC8C);
        assert_eq!(fnv(fnv(FNV_START, b"foo"), b"bar"), 0x8594_4171_F739_67E8);
    }

    #[cfg(feature = "encode")]
    #[test]
    fn the_hash_sees_names_units_ranges_and_period() {
        use super::{InterfaceView, interface_hash};
        let record = |lo: f32| {
            let mut bytes = [0; 16];
            bytes[4] = 2;
            bytes[6] = 1;
            bytes[8..12].copy_from_slice(&lo.to_le_bytes());
            bytes
        };
        let hash = |text: &[u8], lo: f32, period| {
            interface_hash(InterfaceView { observations: &[record(lo)], actions: &[], text }, period)
        };
        let base = hash(b"abm", 0.0, 10);
        assert_ne!(base, hash(b"acm", 0.0, 10));
        assert_ne!(base, hash(b"abs", 0.0, 10));
        assert_ne!(base, hash(b"abm", 1.0, 10));
        assert_ne!(base, hash(b"abm", 0.0, 11));
        assert_eq!(base, hash(b"abm", 0.0, 10));
    }
}
