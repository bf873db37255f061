//! Metrics as TensorBoard event files.
//!
//! A file is a sequence of TFRecords, each `length: u64, masked CRC-32C of length, data, masked CRC-32C of data` in little
//! endian; the data is a protobuf `Event`. Only the handful of fields below is written, so the encoding is by hand.
//!
//! | message | field | number | wire type |
//! | --- | --- | --- | --- |
//! | Event | `wall_time` (s), `step`, `file_version`, `summary`, `session_log` | 1, 2, 3, 5, 7 | 64 bit, varint, bytes, bytes, bytes |
//! | Summary | `value` | 1 | bytes |
//! | Summary.Value | `tag`, `simple_value` | 1, 2 | bytes, 32 bit |
//! | SessionLog | `status` (START = 1) | 1 | varint |
//!
//! Source: TensorFlow `tensorflow/core/lib/io/record_writer.h`, `tensorflow/core/util/event.proto`,
//! `tensorflow/core/framework/summary.proto`.

use super::{MetricsError, Record, check};
use crc::{CRC_32_ISCSI, Crc, NoTable};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// CRC-32C. Records are short, so the table-free form is fast enough.
const CRC_32C: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISCSI);

/// Writes scalar summaries to one event file; the tag of a scalar is its name in [`super::keys`].
#[derive(Debug)]
pub struct TensorBoardSink {
    path: PathBuf,
    file: File,
}

impl TensorBoardSink {
    /// Starts a new event file in `dir`, which must exist. `wall_time_s` is the time since the Unix epoch in seconds;
    /// it becomes part of the file's name, with a counter if the name is taken.
    ///
    /// # Errors
    /// A refusal of the file system.
    pub fn create(dir: &Path, wall_time_s: f64) -> Result<Self, MetricsError> {
        let mut counter = 0;
        let (path, file) = loop {
            // Readers take files in the order of their names, hence the fixed width.
            let path = dir.join(format!("events.out.tfevents.{:010}.gadm.{counter}", wall_time_s as u64));
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                Ok(file) => break (path, file),
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => counter += 1,
                Err(error) => return Err(MetricsError::io("create", &path)(error)),
            }
        };
        let mut sink = Self { path, file };
        let mut event = Message::default();
        event.double(1, wall_time_s);
        event.bytes(3, b"brain.Event:2");
        sink.append(&event)?;
        Ok(sink)
    }

    /// Starts a further event file for a run resumed from a checkpoint of `step`, and tells readers to drop what earlier
    /// files hold beyond it.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub fn resume(dir: &Path, step: u64, wall_time_s: f64) -> Result<Self, MetricsError> {
        let mut sink = Self::create(dir, wall_time_s)?;
        let mut session_log = Message::default();
        session_log.varint(1, 1);
        let mut event = Message::default();
        event.double(1, wall_time_s);
        // Readers drop events of this step too, and the checkpoint's own are to stay.
        event.varint(2, step + 1);
        event.bytes(7, &session_log.0);
        sink.append(&event)?;
        Ok(sink)
    }

    /// Appends the values of `record` as one event; `wall_time_s` as in [`Self::create`]. Values are stored as `f32`, the
    /// type of the format.
    ///
    /// # Errors
    /// An unknown or repeated name, or a refusal of the file system.
    pub fn write(&mut self, record: &Record, wall_time_s: f64) -> Result<(), MetricsError> {
        check(record)?;
        let mut summary = Message::default();
        for (key, value) in &record.values {
            let mut scalar = Message::default();
            scalar.bytes(1, key.as_bytes());
            scalar.float(2, *value as f32);
            summary.bytes(1, &scalar.0);
        }
        let mut event = Message::default();
        event.double(1, wall_time_s);
        event.varint(2, record.step);
        event.bytes(5, &summary.0);
        self.append(&event)
    }

    /// The event file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn append(&mut self, event: &Message) -> Result<(), MetricsError> {
        self.file.write_all(&frame(&event.0)).map_err(MetricsError::io("write", &self.path))
    }
}

/// A TFRecord around `data`.
fn frame(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut record = Vec::with_capacity(data.len() + 16);
    record.extend_from_slice(&length);
    record.extend_from_slice(&masked_crc(&length).to_le_bytes());
    record.extend_from_slice(data);
    record.extend_from_slice(&masked_crc(data).to_le_bytes());
    record
}

/// The checksum as stored: rotated and offset, so that data which contains checksums is checked well too.
// Source: TensorFlow `tensorflow/core/lib/hash/crc32c.h`, Mask().
fn masked_crc(data: &[u8]) -> u32 {
    CRC_32C.checksum(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// A protobuf message under construction.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn varint(&mut self, field: u64, value: u64) {
        self.raw_varint(field << 3);
        self.raw_varint(value);
    }

    fn double(&mut self, field: u64, value: f64) {
        self.raw_varint(field << 3 | 1);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn bytes(&mut self, field: u64, value: &[u8]) {
        self.raw_varint(field << 3 | 2);
        self.raw_varint(value.len() as u64);
        self.0.extend_from_slice(value);
    }

    fn float(&mut self, field: u64, value: f32) {
        self.raw_varint(field << 3 | 5);
        self.0.extend_from_slice(&value.to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::keys;

    /// CRC-32C by the definition, bit by bit: independent of the crate.
    fn crc32c_bitwise(data: &[u8]) -> u32 {
        let mut crc = !0u32;
        for byte in data {
            crc ^= *byte as u32;
            for _ in 0..8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
            }
        }
        !crc
    }

    /// A field of a decoded message: number and content.
    #[derive(Debug, PartialEq)]
    enum Field<'a> {
        Varint(u64, u64),
        Fixed64(u64, u64),
        Fixed32(u64, u32),
        Bytes(u64, &'a [u8]),
    }

    fn take<'a>(data: &mut &'a [u8], count: usize) -> &'a [u8] {
        let (head, tail) = data.split_at(count);
        *data = tail;
        head
    }

    fn read_varint(data: &mut &[u8]) -> u64 {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = take(data, 1)[0];
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                break;
            }
        }
        value
    }

    fn decode(mut data: &[u8]) -> Vec<Field<'_>> {
        let mut fields = Vec::new();
        while !data.is_empty() {
            let key = read_varint(&mut data);
            fields.push(match key & 7 {
                0 => Field::Varint(key >> 3, read_varint(&mut data)),
                1 => Field::Fixed64(key >> 3, u64::from_le_bytes(take(&mut data, 8).try_into().unwrap())),
                2 => {
                    let length = read_varint(&mut data) as usize;
                    Field::Bytes(key >> 3, take(&mut data, length))
                }
                5 => Field::Fixed32(key >> 3, u32::from_le_bytes(take(&mut data, 4).try_into().unwrap())),
                other => panic!("wire type {other}"),
            });
        }
        fields
    }

    /// The data of every record, with both checksums verified.
    fn records(mut file: &[u8]) -> Vec<&[u8]> {
        let unmask =
            |stored: &[u8]| u32::from_le_bytes(stored.try_into().unwrap()).wrapping_sub(0xa282_ead8).rotate_left(15);
        let mut found = Vec::new();
        while !file.is_empty() {
            let length = take(&mut file, 8);
            assert_eq!(unmask(take(&mut file, 4)), crc32c_bitwise(length));
            let data = take(&mut file, u64::from_le_bytes(length.try_into().unwrap()) as usize);
            assert_eq!(unmask(take(&mut file, 4)), crc32c_bitwise(data));
            found.push(data);
        }
        found
    }

    /// Vectors of RFC 3720, appendix B.4.
    #[test]
    fn crc_32c_matches_published_vectors() {
        let ascending: Vec<u8> = (0..32).collect();
        for (data, expected) in [
            (&b"123456789"[..], 0xe306_9283),
            (&[0; 32], 0x8a91_36aa),
            (&[0xff; 32], 0x62a8_ab43),
            (&ascending, 0x46dd_794e),
        ] {
            assert_eq!(CRC_32C.checksum(data), expected);
            assert_eq!(crc32c_bitwise(data), expected);
        }
    }

    #[test]
    fn an_independent_decoder_reads_every_event() {
        let folder = tempfile::tempdir().unwrap();
        let mut sink = TensorBoardSink::create(folder.path(), 1_700_000_000.25).unwrap();
        sink.write(&Record::new(300).with(keys::Q_LOSS, 0.5).with(keys::CODES_USED, 12.0), 1_700_000_001.0).unwrap();
        let file = std::fs::read(sink.path()).unwrap();
        let events: Vec<Vec<Field>> = records(&file).into_iter().map(decode).collect();
        assert_eq!(events.len(), 2);
        assert_eq!(events[0], [Field::Fixed64(1, 1_700_000_000.25f64.to_bits()), Field::Bytes(3, b"brain.Event:2")]);
        let [Field::Fixed64(1, time), Field::Varint(2, 300), Field::Bytes(5, summary)] = events[1][..] else {
            panic!("{:?}", events[1]);
        };
        assert_eq!(f64::from_bits(time), 1_700_000_001.0);
        let scalars: Vec<(String, f32)> = decode(summary)
            .into_iter()
            .map(|field| {
                let Field::Bytes(1, value) = field else { panic!("{field:?}") };
                let [Field::Bytes(1, tag), Field::Fixed32(2, bits)] = decode(value)[..] else { panic!("{value:?}") };
                (String::from_utf8(tag.to_vec()).unwrap(), f32::from_bits(bits))
            })
            .collect();
        assert_eq!(scalars, [("q_loss".to_owned(), 0.5), ("codes_used".to_owned(), 12.0)]);
    }

    #[test]
    fn a_resumed_run_gets_its_own_file_with_a_session_start() {
        let folder = tempfile::tempdir().unwrap();
        let first = TensorBoardSink::create(folder.path(), 5.0).unwrap();
        let second = TensorBoardSink::resume(folder.path(), 400, 5.0).unwrap();
        assert_ne!(first.path(), second.path());
        assert!(first.path() < second.path());
        let file = std::fs::read(second.path()).unwrap();
        let start = decode(records(&file)[1]);
        assert_eq!(start[1..], [Field::Varint(2, 401), Field::Bytes(7, &[8, 1])]);
    }

    #[test]
    fn unknown_names_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut sink = TensorBoardSink::create(folder.path(), 0.0).unwrap();
        let refused = sink.write(&Record::new(0).with("loss", 1.0), 0.0);
        assert!(matches!(refused, Err(MetricsError::UnknownKey { key: "loss", .. })));
    }
}
