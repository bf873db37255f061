//! Every format written, read back, moved and damaged.
#![allow(clippy::unwrap_used, reason = "tests may panic")]

use gadm_image::{Contents, EncodeOptions, Expected, Format, ImageError, PolicyImage, Segment, decode, verify};
use proptest::prelude::*;

const FILE: &[u8] = include_bytes!("../../tests/data/format-1.bin");

fn policy() -> PolicyImage {
    PolicyImage::check(FILE).unwrap()
}

fn at(address: u32) -> EncodeOptions {
    EncodeOptions { address: Some(address), uf2_family: None }
}

/// A dump of flash: these pieces in erased memory from `start` on.
fn dump(start: u32, len: usize, pieces: &[(u32, &[u8])]) -> Contents {
    let mut bytes = vec![0xFF; len];
    for (address, piece) in pieces {
        let offset = (address - start) as usize;
        bytes[offset..offset + piece.len()].copy_from_slice(piece);
    }
    Contents {
        format: Format::Bin,
        addressed: true,
        segments: vec![Segment { address: start, bytes }],
        uf2_family: None,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn every_format_brings_back_address_and_bytes(block in 0u32..0x0FFF_0000, pick in 0usize..5) {
        let (address, format) = (block * 16, Format::ALL[pick]);
        let content = format.encode(&policy(), &at(address)).unwrap();
        let path = format!("policy.{}", format.extension());
        let contents = decode(&content, Some(path.as_ref()), Some(address)).unwrap();
        prop_assert_eq!(contents.format, format);
        let found = verify(&contents, &Expected { address: Some(address), policy: Some(FILE) }).unwrap();
        prop_assert_eq!((found.address, found.policy.bytes(), found.other_bytes), (address, FILE, 0));
    }

    /// No damage of one byte passes: it is refused, or it changes nothing that a flashing tool would write.
    #[test]
    fn a_changed_byte_never_gives_another_policy(place in 0.0f64..1.0, byte: u8, pick in 0usize..5) {
        let format = Format::ALL[pick];
        let mut content = format.encode(&policy(), &at(0x0806_0000)).unwrap();
        let index = (place * content.len() as f64) as usize;
        content[index] = byte;
        let path = format!("policy.{}", format.extension());
        if let Ok(contents) = decode(&content, Some(path.as_ref()), None)
            && let Ok(found) = verify(&contents, &Expected { address: None, policy: Some(FILE) })
        {
            prop_assert_eq!(found.policy.bytes(), FILE);
        }
    }

    /// Any bytes in any guise are read or refused, never a panic.
    #[test]
    fn arbitrary_bytes_do_not_panic(head in 0usize..5, bytes in proptest::collection::vec(any::<u8>(), 0..700), path in 0usize..5) {
        let heads: [&[u8]; 5] = [b"", b":", b"\x7fELF\x01\x01\x01", b"UF2\x0A\x57\x51\x5D\x9E", b"gadm_policy[GADM_POLICY_SIZE] = {"];
        let content = [heads[head], &bytes].concat();
        let name = format!("x.{}", Format::ALL[path].extension());
        if let Ok(contents) = decode(&content, Some(name.as_ref()), Some(16)) {
            prop_assert!(verify(&contents, &Expected::default()).is_err());
        }
    }
}

#[test]
fn what_is_no_policy_is_not_packed() {
    let mut damaged = FILE.to_vec();
    damaged[200] ^= 1;
    assert!(matches!(PolicyImage::check(&damaged), Err(ImageError::Load(_))));
    assert!(matches!(PolicyImage::check(b"int main(void) { return 0; }"), Err(ImageError::Load(_))));
    assert!(matches!(PolicyImage::check(&[0xFF; 4096]), Err(ImageError::Load(_))));
}

/// The checksums are right, the answers are not: such a policy is not packed either.
#[test]
fn a_policy_that_fails_its_self_test_is_not_packed() {
    // The last self-test vector ends where the provenance section starts: its last word is an action.
    let word = |at: usize| u32::from_le_bytes(FILE[at..at + 4].try_into().unwrap()) as usize;
    let (start, len) = (word(64 + 5 * 8), word(64 + 5 * 8 + 4));
    let mut wrong = FILE.to_vec();
    let vectors = u16::from_le_bytes([FILE[start], FILE[start + 1]]) as usize;
    let last = start + 16 + vectors * (4 * 5 + 4 + 4 * 3) - 4;
    assert!(last < start + len);
    wrong[last] ^= 1;
    gadm_runtime::encode::reseal(&mut wrong);
    let error = PolicyImage::check(&wrong).unwrap_err();
    assert!(matches!(error, ImageError::SelfTest(_)), "{error}");
}

#[test]
fn what_follows_the_policy_is_dropped() {
    let mut slot = FILE.to_vec();
    slot.resize(128 << 10, 0xFF);
    assert_eq!(PolicyImage::check(&slot).unwrap().bytes(), FILE);
}

#[test]
fn policies_in_a_dump_of_flash() {
    let (slot_a, slot_b) = (0x0804_0000, 0x0806_0000);
    let both = dump(0x0800_0000, 1 << 19, &[(0x0800_0000, b"firmware"), (slot_a, FILE), (slot_b, FILE)]);
    assert!(matches!(verify(&both, &Expected::default()), Err(ImageError::ManyPolicies { .. })));
    let found = verify(&both, &Expected { address: Some(slot_b), policy: Some(FILE) }).unwrap();
    assert_eq!((found.address, found.policy.bytes()), (slot_b, FILE));
    let other = Expected { address: Some(0x0808_0000), policy: None };
    let error = verify(&both, &other).unwrap_err().to_string();
    assert!(error.contains("0x08080000") && error.contains("0x08040000, 0x08060000"), "{error}");
    // The first bytes alone, as firmware holds them, are no policy.
    let one = dump(0x0800_0000, 1 << 19, &[(0x0800_1000, &FILE[..8]), (slot_a, FILE)]);
    let found = verify(&one, &Expected::default()).unwrap();
    assert_eq!((found.address, found.other_bytes), (slot_a, 8));
}

#[test]
fn the_reason_is_the_runtimes() {
    let says = |contents: &Contents, word: &str| {
        let error = verify(contents, &Expected::default()).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    };
    says(&dump(0, 4096, &[]), "erased");
    says(&dump(0, 4096, &[(0, &FILE[..1000])]), "cut off");
    let text_mode: Vec<u8> = FILE.iter().copied().filter(|byte| *byte != b'\r').collect();
    says(&decode(&text_mode, None, None).unwrap(), "text-mode transfer");
}

#[test]
fn another_policy_is_told_from_the_expected_one() {
    let mut later = FILE.to_vec();
    later[32..36].copy_from_slice(&9u32.to_le_bytes());
    gadm_runtime::encode::reseal(&mut later);
    let contents = decode(&later, None, None).unwrap();
    let error = verify(&contents, &Expected { address: None, policy: Some(FILE) }).unwrap_err();
    assert!(matches!(error, ImageError::Different { offset: 32, .. }), "{error}");
}

#[test]
fn an_address_is_asked_for_where_the_format_holds_one() {
    let none = EncodeOptions::default();
    for format in Format::ALL {
        let made = format.encode(&policy(), &none);
        assert_eq!(made.is_err(), format.holds_address(), "{format}");
    }
    assert!(matches!(Format::Bin.encode(&policy(), &at(8)), Err(ImageError::Unaligned { .. })));
}
