//! What a board must know before it can talk: node number, profile and source of time, as a record in its flash.
//!
//! | byte | field | type | meaning |
//! | --- | --- | --- | --- |
//! | 0 | magic | 4 bytes | `GNOD` |
//! | 4 | node | u8 | node number, 1 to 63 |
//! | 5 | profile | u8 | 0 `fd-f32`, 1 `classic-i16` |
//! | 6 | time | u8 | 0 TICK frames (lockstep), 1 timer of the board |
//! | 7 | – | u8 | 0 |
//! | 8 | `ramp_ticks` | u16 | control periods that the way to the safe action takes |
//! | 10 | – | u16 | 0 |
//! | 12 | `rate_limit` | f32 | largest change of a continuous action in one period, fraction of its range; 0 = none |
//! | 16 | crc | u32 | CRC-32/ISO-HDLC of the bytes before |
//!
//! Numbers are little endian. Where the first four bytes are erased (all 0xFF or all zero) the defaults of
//! [`NodeConfig`] hold.

use crate::codec::Profile;
use crate::control::{NodeConfig, TimeSource};
use crate::protocol::NodeId;
use crate::slots::CRC32;

/// Bytes of the record.
pub const SETTINGS_LEN: usize = 20;

const MAGIC: [u8; 4] = *b"GNOD";

/// The record is there and damaged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SettingsError;

impl core::fmt::Display for SettingsError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the settings record is damaged: magic, a field or the CRC-32 is wrong; write it again")
    }
}

impl core::error::Error for SettingsError {}

/// The record of a configuration. What is not in the record (slot, restart) is not kept.
#[must_use]
pub fn write_settings(config: &NodeConfig) -> [u8; SETTINGS_LEN] {
    let [m0, m1, m2, m3] = MAGIC;
    let profile = match config.profile {
        Profile::FdF32 => 0,
        Profile::ClassicI16 => 1,
    };
    let time = match config.time {
        TimeSource::Tick => 0,
        TimeSource::Local => 1,
    };
    let [r0, r1] = config.ramp_ticks.to_le_bytes();
    let [l0, l1, l2, l3] = config.rate_limit.unwrap_or(0.0).to_le_bytes();
    let head = [m0, m1, m2, m3, config.node.get(), profile, time, 0, r0, r1, 0, 0, l0, l1, l2, l3];
    let mut record = [0; SETTINGS_LEN];
    for (place, byte) in record.iter_mut().zip(head.into_iter().chain(CRC32.checksum(&head).to_le_bytes())) {
        *place = byte;
    }
    record
}

/// The configuration of a record; the defaults where there is none.
///
/// # Errors
/// Where the record is damaged.
pub fn read_settings(record: &[u8; SETTINGS_LEN]) -> Result<NodeConfig, SettingsError> {
    let [m0, m1, m2, m3, node, profile, time, _, r0, r1, _, _, l0, l1, l2, l3, ..] = *record;
    let magic = [m0, m1, m2, m3];
    if magic == [0xFF; 4] || magic == [0; 4] {
        return Ok(NodeConfig::default());
    }
    let rate = f32::from_le_bytes([l0, l1, l2, l3]);
    let config = NodeConfig {
        node: NodeId::new(node).ok_or(SettingsError)?,
        profile: match profile {
            0 => Profile::FdF32,
            1 => Profile::ClassicI16,
            _ => return Err(SettingsError),
        },
        time: match time {
            0 => TimeSource::Tick,
            1 => TimeSource::Local,
            _ => return Err(SettingsError),
        },
        ramp_ticks: u16::from_le_bytes([r0, r1]),
        rate_limit: (rate > 0.0).then_some(rate),
        ..NodeConfig::default()
    };
    // Writing is the inverse of reading, so this checks magic, CRC, reserved bytes and the sign of the rate at once.
    if write_settings(&config) == *record { Ok(config) } else { Err(SettingsError) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_comes_back_and_erased_memory_means_defaults() {
        let config = NodeConfig {
            node: NodeId::new(63).unwrap(),
            profile: Profile::ClassicI16,
            time: TimeSource::Local,
            ramp_ticks: 700,
            rate_limit: Some(0.25),
            ..NodeConfig::default()
        };
        assert_eq!(read_settings(&write_settings(&config)), Ok(config));
        assert_eq!(read_settings(&write_settings(&NodeConfig::default())), Ok(NodeConfig::default()));
        assert_eq!(read_settings(&[0xFF; SETTINGS_LEN]), Ok(NodeConfig::default()));
        assert_eq!(read_settings(&[0; SETTINGS_LEN]), Ok(NodeConfig::default()));
    }

    #[test]
    fn any_changed_bit_is_found() {
        let record = write_settings(&NodeConfig::default());
        for bit in 0..SETTINGS_LEN * 8 {
            let mut damaged = record;
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(read_settings(&damaged), Err(SettingsError), "bit {bit}");
        }
    }
}
