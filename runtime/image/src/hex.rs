//! Intel HEX.
//!
//! Source: Intel, Hexadecimal Object File Format Specification, revision A, 1988: data, end-of-file and extended linear
//! address records.

use ihex::{Reader, ReaderOptions, Record};

use crate::{Format, ImageError, Segment};

/// Data bytes of one record, as most tools write them.
const RECORD: usize = 16;

pub(crate) fn is_hex(content: &[u8]) -> bool {
    let text = content.trim_ascii_start();
    text.first() == Some(&b':') && text.get(1).is_some_and(u8::is_ascii_hexdigit)
}

pub(crate) fn encode(address: u32, bytes: &[u8]) -> Result<Vec<u8>, ImageError> {
    let mut records = Vec::with_capacity(bytes.len() / RECORD + 4);
    let mut upper = None;
    let mut at = address;
    let mut rest = bytes;
    while !rest.is_empty() {
        if upper != Some(at >> 16) {
            upper = Some(at >> 16);
            records.push(Record::ExtendedLinearAddress((at >> 16) as u16));
        }
        // A record may not cross 64 KiB; `address` need not be a multiple of the record's length.
        let room = 0x1_0000 - (at & 0xFFFF) as usize;
        let (value, behind) = rest.split_at(RECORD.min(room).min(rest.len()));
        records.push(Record::Data { offset: at as u16, value: value.to_vec() });
        at = at.wrapping_add(value.len() as u32);
        rest = behind;
    }
    records.push(Record::EndOfFile);
    let text =
        ihex::create_object_file_representation(&records).map_err(|error| damaged("a record".to_owned(), &error))?;
    Ok(text.into_bytes())
}

pub(crate) fn decode(content: &[u8]) -> Result<Vec<Segment>, ImageError> {
    let text = std::str::from_utf8(content).map_err(|error| {
        let line = content[..error.valid_up_to()].split(|byte| *byte == b'\n').count();
        damaged(format!("line {line}"), &"a byte that is no text")
    })?;
    let options = ReaderOptions { stop_after_first_error: true, stop_after_eof: true };
    let (mut segments, mut base, mut ended, mut line) = (Vec::<Segment>::new(), 0u32, false, 0);
    for record in Reader::new_with_options(text, options) {
        line += 1;
        match record.map_err(|error| damaged(format!("record {line}"), &error))? {
            Record::Data { offset, value } => {
                let address = base
                    .checked_add(u32::from(offset))
                    .ok_or_else(|| damaged(format!("record {line}"), &"address beyond 32 bits"))?;
                match segments.last_mut() {
                    Some(last) if u64::from(last.address) + last.bytes.len() as u64 == u64::from(address) => {
                        last.bytes.extend_from_slice(&value);
                    }
                    _ => segments.push(Segment { address, bytes: value }),
                }
            }
            Record::ExtendedLinearAddress(upper) => base = u32::from(upper) << 16,
            Record::ExtendedSegmentAddress(segment) => base = u32::from(segment) << 4,
            Record::StartSegmentAddress { .. } | Record::StartLinearAddress(_) => {}
            Record::EndOfFile => ended = true,
        }
    }
    if ended { Ok(segments) } else { Err(damaged("its end".to_owned(), &"no end-of-file record: the file is cut off")) }
}

fn damaged(place: String, what: &dyn std::fmt::Display) -> ImageError {
    ImageError::Damaged { format: Format::Hex, place, what: what.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_image_is_the_text_of_the_specification() {
        let text = String::from_utf8(encode(0x0806_0000, b"0123456789abcdefXY").unwrap()).unwrap();
        // Checksums by hand: two's complement of the sum of the bytes of each record.
        let expected = ":020000040806EC\n:10000000303132333435363738396162636465668E\n:0200100058593D\n:00000001FF\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn a_record_ends_at_64_kib() {
        let bytes: Vec<u8> = (0..40).collect();
        let content = encode(0x0000_FFF8, &bytes).unwrap();
        assert!(std::str::from_utf8(&content).unwrap().contains(":020000040001F9"));
        assert_eq!(decode(&content).unwrap(), [Segment { address: 0xFFF8, bytes }]);
    }

    #[test]
    fn damage_is_named_with_its_place() {
        let mut content = encode(0, &[7; 64]).unwrap();
        content[40] = b'5';
        let error = decode(&content).unwrap_err().to_string();
        assert!(error.contains("Intel HEX") && error.contains("record 2"), "{error}");
        let whole = encode(0, &[7; 64]).unwrap();
        let error = decode(&whole[..whole.len() - 13]).unwrap_err().to_string();
        assert!(error.contains("cut off"), "{error}");
    }
}
