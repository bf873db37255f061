//! C header: the bytes as an array, for firmware that links the policy in.

use std::fmt::Write as _;

use crate::{Format, ImageError, PolicyImage};

const ADDRESS: &str = "#define GADM_POLICY_ADDRESS 0x";
const ARRAY: &str = "gadm_policy[GADM_POLICY_SIZE]";

pub(crate) fn is_c_header(content: &[u8]) -> bool {
    std::str::from_utf8(content).is_ok_and(|text| text.contains(ARRAY))
}

pub(crate) fn encode(policy: &PolicyImage, address: Option<u32>) -> Vec<u8> {
    let (bytes, summary) = (policy.bytes(), policy.summary());
    let mut text = String::with_capacity(6 * bytes.len() + 2048);
    let mut line = |words: std::fmt::Arguments<'_>| {
        text.write_fmt(words).and_then(|()| text.write_char('\n')).expect("a String takes any text");
    };
    line(format_args!("/* Policy for {}, written by `gadm image`. Do not edit. */", comment(&summary.environment)));
    line(format_args!("#ifndef GADM_POLICY_H\n#define GADM_POLICY_H\n"));
    line(format_args!("#define GADM_POLICY_SIZE {}u", bytes.len()));
    line(format_args!("#define GADM_POLICY_CRC32 0x{:08X}u /* of the payload */", summary.payload_crc32));
    line(format_args!("#define GADM_POLICY_SEQUENCE {}u", summary.policy_seq));
    line(format_args!("#define GADM_POLICY_OBSERVATIONS {}u", summary.obs_dim));
    line(format_args!("#define GADM_POLICY_ACTIONS {}u", summary.action_dim));
    line(format_args!("#define GADM_POLICY_SCRATCH_WORDS {}u /* of 32 bits */", summary.scratch_words));
    line(format_args!("#define GADM_POLICY_PERIOD_US {}u", summary.control_period_us));
    if let Some(address) = address {
        line(format_args!("/* The linker script must put the section there. */\n{ADDRESS}{address:08X}u"));
    }
    line(format_args!(
        "\n/* Section of the array; define it before the include, or leave it to the compiler. */\n\
         #if defined(GADM_POLICY_SECTION)\n\
         #define GADM_POLICY_ATTRIBUTES __attribute__((aligned(16), used, section(GADM_POLICY_SECTION)))\n\
         #elif defined(__GNUC__)\n\
         #define GADM_POLICY_ATTRIBUTES __attribute__((aligned(16)))\n\
         #elif defined(__cplusplus)\n\
         #define GADM_POLICY_ATTRIBUTES alignas(16)\n\
         #else\n\
         #define GADM_POLICY_ATTRIBUTES _Alignas(16)\n\
         #endif\n"
    ));
    line(format_args!("GADM_POLICY_ATTRIBUTES static const unsigned char {ARRAY} = {{"));
    for row in bytes.chunks(16) {
        let mut words = String::with_capacity(100);
        for byte in row {
            write!(words, "0x{byte:02X},").expect("as above");
        }
        line(format_args!("{words}"));
    }
    line(format_args!("}};\n\n#endif"));
    text.into_bytes()
}

/// Text that cannot end a comment.
fn comment(text: &str) -> String {
    text.replace("*/", "* /").replace("/*", "/ *").replace('\\', "/")
}

/// Address, if it is there, and bytes.
pub(crate) fn decode(content: &[u8]) -> Result<(Option<u32>, Vec<u8>), ImageError> {
    let damaged = |place: &str, what: &str| ImageError::Damaged {
        format: Format::CHeader,
        place: place.to_owned(),
        what: what.to_owned(),
    };
    let text = std::str::from_utf8(content).map_err(|_| damaged("its start", "not a text"))?;
    let address = match text.split_once(ADDRESS) {
        Some((_, rest)) => {
            let digits = rest.split(['u', '\n', '\r']).next().unwrap_or_default();
            Some(u32::from_str_radix(digits, 16).map_err(|_| damaged("GADM_POLICY_ADDRESS", "not a number"))?)
        }
        None => None,
    };
    let array = text
        .split_once(ARRAY)
        .and_then(|(_, rest)| rest.split_once('{'))
        .and_then(|(_, rest)| rest.split_once('}'))
        .map(|(array, _)| array)
        .ok_or_else(|| damaged("its array", "no complete gadm_policy array"))?;
    let bytes = array.split(',').map(str::trim).filter(|word| !word.is_empty()).enumerate();
    let bytes: Result<Vec<u8>, _> = bytes
        .map(|(index, word)| {
            let digits = word.strip_prefix("0x").unwrap_or("?");
            u8::from_str_radix(digits, 16).map_err(|_| damaged(&format!("array element {index}"), "not a byte"))
        })
        .collect();
    Ok((address, bytes?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_damaged_is_named() {
        let head = "const unsigned char gadm_policy[GADM_POLICY_SIZE] = {";
        let text = |array: &str| format!("{head}{array}");
        assert_eq!(decode(text("0x01,\n0xFF,\n};").as_bytes()).unwrap(), (None, vec![1, 255]));
        for (array, word) in [("0x01, 0x1FF};", "element 1"), ("0x01, 2};", "element 1"), ("0x01,", "no complete")] {
            let error = decode(text(array).as_bytes()).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
