use std::vec::Vec;

use proptest::prelude::*;

use super::*;
use crate::frame::{extended, standard};

fn line(frame: &Frame) -> Vec<u8> {
    let mut line = [0; MAX_LINE];
    let len = encode(frame, &mut line);
    line[..len].to_vec()
}

fn read_with(mut decoder: Decoder, bytes: &[u8]) -> Vec<Result<Command, Error>> {
    bytes.iter().filter_map(|&b| decoder.push(b)).collect()
}

fn read(bytes: &[u8]) -> Vec<Result<Command, Error>> {
    read_with(Decoder::new(), bytes)
}

#[test]
fn lines_of_known_frames() {
    for (frame, text) in [
        (Frame::classic(standard(0x7FF), &[0xAB; 8]), "t7FF8ABABABABABABABAB\r"),
        (Frame::classic(standard(0), &[]), "t0000\r"),
        (Frame::classic(extended(0x1FFF_FFFF), &[1]), "T1FFFFFFF101\r"),
        (Frame::remote(standard(0x12), 4), "r0124\r"),
        (Frame::remote(extended(0x12), 0), "R000000120\r"),
        (Frame::fd(standard(0x123), &[1; 12], false), "d1239010101010101010101010101\r"),
        (Frame::fd(standard(0x123), &[2], true), "b123102\r"),
        (Frame::fd(extended(0x123), &[], true), "B000001230\r"),
        (Frame::fd(extended(1), &[], false), "D000000010\r"),
    ] {
        let frame = frame.unwrap();
        assert_eq!(line(&frame), text.as_bytes());
        assert_eq!(read(text.as_bytes()), [Ok(Command::Frame(frame))]);
        assert_eq!(read(text.to_lowercase().as_bytes()).len(), 1); // lower case is another letter, never a panic
    }
    let digits = b"t1aB2cDeF\r";
    assert_eq!(read(digits), [Ok(Command::Frame(Frame::classic(standard(0x1AB), &[0xCD, 0xEF]).unwrap()))]);
}

#[test]
fn longest_lines() {
    let classic = Frame::classic(standard(1), &[0; 8]).unwrap();
    let fd = Frame::fd(standard(1), &[0; 64], true).unwrap();
    let long = Frame::fd(extended(1), &[0; 64], true).unwrap();
    assert_eq!([classic, fd, long].map(|f| line(&f).len()), [22, 134, 139]);
    let mut bytes = [0; MAX_LINE];
    assert_eq!(encode_stamped(&long, 61_000, &mut bytes), MAX_LINE);
    assert_eq!(&bytes[138..], b"03E8\r"); // 1000 ms into the minute
    assert_eq!(read_with(Decoder::host(), &bytes), [Ok(Command::Frame(long))]);
    assert_eq!(read(&bytes), [Err(Error::Long)]);
}

#[test]
fn control_letters() {
    for (text, command) in [
        ("O", Command::Open),
        ("L", Command::Listen),
        ("C", Command::Close),
        ("S6", Command::BitRate(6)),
        ("Y5", Command::DataRate(5)),
        ("s031C", Command::BitTiming(3, 0x1C)),
        ("V", Command::Version),
        ("N", Command::Serial),
        ("F", Command::Status),
        ("Z0", Command::Timestamps(false)),
        ("Z1", Command::Timestamps(true)),
        ("", Command::Empty),
        ("\n\n", Command::Empty),
    ] {
        assert_eq!(read(&[text.as_bytes(), b"\r"].concat()), [Ok(command)], "{text}");
    }
    for (text, command) in [
        ("V1013\r", Command::Answer(b'V')),
        ("N?x1Z\r", Command::Answer(b'N')),
        ("F00\r", Command::Answer(b'F')),
        ("z\r", Command::Sent),
        ("Z\r", Command::Sent),
        ("\x07", Command::Refused),
        ("\r", Command::Empty),
    ] {
        assert_eq!(read_with(Decoder::host(), text.as_bytes()), [Ok(command)], "{text}");
    }
}

#[test]
fn a_bad_line_is_named_and_the_next_one_is_read() {
    for (text, error) in [
        ("x", Error::Letter(b'x')),
        ("\u{1}", Error::Letter(1)),
        ("\x07", Error::Letter(BEL)),
        (" O", Error::Letter(b' ')),
        ("t", Error::Short),
        ("t12", Error::Short),
        ("t1232112", Error::Short),
        ("t12321122334", Error::Long),
        ("t1239112233445566778899", Error::Range),
        ("t8000", Error::Range),
        ("T200000000", Error::Range),
        ("r1239", Error::Range),
        ("r12321122", Error::Long),
        ("t12g0", Error::Digit(b'g')),
        ("t1230\x07", Error::Long),
        ("b123900112233", Error::Short),
        ("S", Error::Short),
        ("S44", Error::Long),
        ("SA", Error::Range),
        ("Z2", Error::Range),
        ("O1", Error::Long),
        ("z", Error::Letter(b'z')),
        ("V1013", Error::Long),
    ] {
        let next = Frame::classic(standard(5), &[7]).unwrap();
        let bytes = [text.as_bytes(), b"\r", &line(&next)].concat();
        assert_eq!(read(&bytes), [Err(error), Ok(Command::Frame(next))], "{text}");
    }
    let endless = [&[b't'; 10_000][..], b"\rO\r"].concat();
    assert_eq!(read(&endless), [Err(Error::Overlong), Ok(Command::Open)]);
    let just_too_long = [&[b'0'; MAX_LINE][..], b"\r"].concat();
    assert_eq!(read(&just_too_long), [Err(Error::Overlong)]);
    let longest = [&[b'0'; MAX_LINE - 1][..], b"\r"].concat();
    assert_eq!(read(&longest), [Err(Error::Letter(b'0'))]);
}

#[test]
fn an_adapter_as_python_can_opens_it() {
    let mut adapter = Adapter::new();
    let mut answers = Vec::new();
    let mut frames = Vec::new();
    // Close, bit rate, no data rate, open twice, a frame, a frame of 9 bytes, a bit rate while open, version.
    for read in read(b"C\rS6\r\rO\rO\rt1231AA\rt1239AA\rS8\rV\rL\rt1230\rC\rt1230\r") {
        let handled = adapter.handle(read);
        answers.extend_from_slice(handled.answer);
        frames.extend(handled.frame);
    }
    assert_eq!(answers, b"\r\r\r\r\r\r\x07\x07V1013\r\r\x07\r\x07");
    assert_eq!(frames, [Frame::classic(standard(0x123), &[0xAA]).unwrap()]);
}

#[test]
fn two_adapters_that_hear_each_other_fall_silent() {
    let mut adapter = Adapter::opened();
    for read in read_with(Decoder::host(), b"V1013\r\x07z\rZ\rN1\rF00\r") {
        assert_eq!(adapter.handle(read), Handled { answer: b"", frame: None });
    }
}

fn any_frame() -> impl Strategy<Value = Frame> {
    let data = prop::collection::vec(any::<u8>(), 0..=64);
    (0_u32..0x2000_0000, any::<bool>(), 0..3, any::<bool>(), data).prop_map(|(id, ext, kind, brs, data)| {
        let id = if ext { extended(id) } else { standard((id & 0x7FF) as u16) };
        match kind {
            0 => Frame::classic(id, &data[..data.len().min(8)]),
            1 => Frame::remote(id, data.len().min(8)),
            _ => Frame::fd(id, &data, brs),
        }
        .unwrap()
    })
}

proptest! {
    #[test]
    fn write_and_read_is_identity(frames in prop::collection::vec(any_frame(), 0..8)) {
        let bytes: Vec<u8> = frames.iter().flat_map(line).collect();
        let wanted: Vec<_> = frames.iter().map(|&f| Ok(Command::Frame(f))).collect();
        prop_assert_eq!(read(&bytes), wanted.clone());
        prop_assert_eq!(read_with(Decoder::host(), &bytes), wanted);
    }

    #[test]
    fn hostile_bytes_are_answered_and_what_was_read_is_what_was_written(
        junk in prop::collection::vec(any::<u8>(), 0..400), letters in "[tTrRdDbBSsYZOLCVNFz0-9A-Fa-f\r\x07 ]{0,300}",
        frame in any_frame(),
    ) {
        for decoder in [Decoder::new(), Decoder::host()] {
            for hostile in [&junk[..], letters.as_bytes()] {
                let reads = read_with(decoder.clone(), &[hostile, b"\r", &line(&frame)].concat());
                prop_assert_eq!(reads.last(), Some(&Ok(Command::Frame(frame))));
                let mut adapter = Adapter::opened();
                for read in reads {
                    if let Ok(Command::Frame(f)) = read {
                        prop_assert_eq!(read_with(decoder.clone(), &line(&f)), [Ok(Command::Frame(f))]);
                    }
                    prop_assert!(adapter.handle(read).answer.len() <= 8);
                }
            }
        }
    }
}
