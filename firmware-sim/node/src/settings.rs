//! What a board must know before it can talk: node number, profile and source of time, as a record in its flash.
//!
//! The record is a [postcard](https://postcard.jamesmunns.com) message and CRC-32/ISO-HDLC of it, little endian, at the start of
//! [`SETTINGS_LEN`] bytes; the rest is erased (0xFF). Its fields, in order:
//!
//! | field | type | meaning |
//! | --- | --- | --- |
//! | magic | 4 bytes | `GNOD` |
//! | version | u8 | 1 |
//! | node | u8 | node number, 1 to 63 |
//! | profile | enum | 0 `fd-f32`, 1 `classic-i16` |
//! | time | enum | 0 TICK frames (lockstep), 1 timer of the board |
//! | `ramp_ticks` | u16 | control periods that the way to the safe action takes |
//! | `rate_limit` | option of f32 | largest change of a continuous action in one period, fraction of its range, above 0 |
//!
//! Where the first four bytes are erased (all 0xFF or all zero) the defaults of [`NodeConfig`] hold.

use serde::{Deserialize, Serialize};

use crate::codec::Profile;
use crate::control::{NodeConfig, TimeSource};
use crate::protocol::NodeId;
use crate::slots::CRC32;

/// Bytes that the record may take.
pub const SETTINGS_LEN: usize = 24;

const MAGIC: [u8; 4] = *b"GNOD";
const VERSION: u8 = 1;
const ERASED: u8 = 0xFF;

/// The record, before its CRC: 16 bytes at most.
#[derive(Serialize, Deserialize)]
struct Record {
    magic: [u8; 4],
    version: u8,
    node: u8,
    profile: Profile,
    time: TimeSource,
    ramp_ticks: u16,
    rate_limit: Option<f32>,
}

/// The record is there and damaged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SettingsError;

impl core::fmt::Display for SettingsError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the settings record is damaged: magic, version, a field or the CRC-32 is wrong; write it again")
    }
}

impl core::error::Error for SettingsError {}

/// The record of a configuration. What is not in the record (slot, restart) is not kept.
#[must_use]
pub fn write_settings(config: &NodeConfig) -> [u8; SETTINGS_LEN] {
    let fields = Record {
        magic: MAGIC,
        version: VERSION,
        node: config.node.get(),
        profile: config.profile,
        time: config.time,
        ramp_ticks: config.ramp_ticks,
        rate_limit: config.rate_limit,
    };
    let mut record = [ERASED; SETTINGS_LEN];
    // The fields always fit; a test writes the longest record.
    let _ = postcard::to_slice_crc32(&fields, &mut record, CRC32.digest());
    record
}

/// The configuration of a record; the defaults where there is none.
///
/// # Errors
/// Where the record is damaged.
pub fn read_settings(record: &[u8; SETTINGS_LEN]) -> Result<NodeConfig, SettingsError> {
    if record.starts_with(&[ERASED; 4]) || record.starts_with(&[0; 4]) {
        return Ok(NodeConfig::default());
    }
    let fields: Record = postcard::from_bytes_crc32(record, CRC32.digest()).map_err(|_| SettingsError)?;
    let config = NodeConfig {
        node: NodeId::new(fields.node).ok_or(SettingsError)?,
        profile: fields.profile,
        time: fields.time,
        ramp_ticks: fields.ramp_ticks,
        rate_limit: fields.rate_limit,
        ..NodeConfig::default()
    };
    let rate_is_legal = config.rate_limit.is_none_or(|rate| rate > 0.0);
    // Writing is the inverse of reading, so this checks magic, version and the erased rest at once.
    if rate_is_legal && write_settings(&config) == *record { Ok(config) } else { Err(SettingsError) }
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
            ramp_ticks: u16::MAX,
            rate_limit: Some(0.25),
            ..NodeConfig::default()
        };
        // The longest record: magic, version, number, two enums, a number of three bytes, an option of four, the CRC.
        assert_eq!(write_settings(&config)[20..], [ERASED; SETTINGS_LEN - 20]);
        assert_ne!(write_settings(&config)[19], ERASED);
        assert_eq!(read_settings(&write_settings(&config)), Ok(config));
        assert_eq!(read_settings(&write_settings(&NodeConfig::default())), Ok(NodeConfig::default()));
        assert_eq!(read_settings(&[0xFF; SETTINGS_LEN]), Ok(NodeConfig::default()));
        assert_eq!(read_settings(&[0; SETTINGS_LEN]), Ok(NodeConfig::default()));
    }

    #[test]
    fn fields_out_of_range_are_damage() {
        let refused = |change: &dyn Fn(&mut Record)| {
            let mut fields = Record {
                magic: MAGIC,
                version: VERSION,
                node: 1,
                profile: Profile::FdF32,
                time: TimeSource::Tick,
                ramp_ticks: 0,
                rate_limit: None,
            };
            change(&mut fields);
            let mut record = [ERASED; SETTINGS_LEN];
            postcard::to_slice_crc32(&fields, &mut record, CRC32.digest()).unwrap();
            read_settings(&record).is_err()
        };
        assert!(!refused(&|_| {}));
        assert!(refused(&|fields| fields.version = 2));
        assert!(refused(&|fields| fields.magic = *b"GNOP"));
        assert!(refused(&|fields| fields.node = 0));
        assert!(refused(&|fields| fields.node = 64));
        for rate in [0.0, -0.5, f32::NAN] {
            assert!(refused(&|fields| fields.rate_limit = Some(rate)), "{rate}");
        }
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
