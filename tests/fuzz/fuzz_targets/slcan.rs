//! Any bytes: the decoder keeps its place, what it reads is what it writes, the adapter answers each line once.
#![no_main]

use gadm_node::slcan::{Adapter, Command, Decoder, MAX_LINE, encode, encode_stamped};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    for mut decoder in [Decoder::new(), Decoder::host()] {
        let mut adapter = Adapter::new();
        let (mut lines, mut said) = (0, 0);
        for &byte in data {
            lines += usize::from(byte == b'\r');
            let Some(read) = decoder.push(byte) else { continue };
            said += usize::from(read != Ok(Command::Refused));
            if let Ok(Command::Frame(frame)) = read {
                let mut line = [0; MAX_LINE];
                let len = encode(&frame, &mut line);
                let mut second = Decoder::new();
                let again = line[..len].iter().find_map(|&b| second.push(b));
                assert_eq!(again, Some(Ok(Command::Frame(frame))));
                let stamped = encode_stamped(&frame, 59_999, &mut line);
                assert!(stamped == len + 4 && line[stamped - 1] == b'\r');
            }
            let open = adapter.is_open();
            let handled = adapter.handle(read);
            assert!(handled.answer.len() <= 8 && (handled.frame.is_none() || open));
        }
        assert_eq!(lines, said);
        // Whatever came before, the line after the next CR is read.
        decoder.push(b'\r');
        assert_eq!(b"O\r".iter().find_map(|&b| decoder.push(b)), Some(Ok(Command::Open)));
    }
});
