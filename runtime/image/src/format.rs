//! The containers by name, and what is read out of one.

use std::fmt;
use std::path::Path;

use crate::{ADDRESS_ALIGN, ImageError, PolicyImage, c_header, elf, hex, uf2};

/// How a policy is packed for a flashing tool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// The bytes alone, without an address.
    Bin,
    /// Intel HEX with 32-bit addresses.
    Hex,
    /// UF2, for boot loaders that show a drive.
    Uf2,
    /// Executable ELF for Arm with one loadable segment.
    Elf,
    /// C header with the bytes as an array.
    CHeader,
}

impl Format {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Bin, Self::Hex, Self::Uf2, Self::Elf, Self::CHeader];

    /// The ending of its files, without the dot.
    #[must_use]
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Bin => "bin",
            Self::Hex => "hex",
            Self::Uf2 => "uf2",
            Self::Elf => "elf",
            Self::CHeader => "h",
        }
    }

    /// Format that the ending of `path` stands for.
    ///
    /// # Errors
    /// [`ImageError::UnknownFormat`] for another ending.
    pub fn of_path(path: &Path) -> Result<Self, ImageError> {
        let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        let found = Self::ALL.into_iter().find(|format| format.extension() == ending);
        found.ok_or_else(|| ImageError::UnknownFormat { name: path.display().to_string() })
    }

    /// Whether its files say where the bytes belong; a C header need not.
    #[must_use]
    pub const fn holds_address(self) -> bool {
        matches!(self, Self::Hex | Self::Uf2 | Self::Elf)
    }

    /// Packs a policy.
    ///
    /// # Errors
    /// A missing or unsuitable address.
    pub fn encode(self, policy: &PolicyImage, options: &EncodeOptions) -> Result<Vec<u8>, ImageError> {
        let bytes = policy.bytes();
        if let Some(address) = options.address {
            check_address(address, bytes.len())?;
        }
        let address = options.address.ok_or(ImageError::NoAddress { format: self });
        match self {
            Self::Bin => Ok(bytes.to_vec()),
            Self::Hex => hex::encode(address?, bytes),
            Self::Uf2 => Ok(uf2::encode(address?, bytes, options.uf2_family)),
            Self::Elf => elf::encode(address?, bytes),
            Self::CHeader => Ok(c_header::encode(policy, options.address)),
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bin => "raw binary",
            Self::Hex => "Intel HEX",
            Self::Uf2 => "UF2",
            Self::Elf => "ELF",
            Self::CHeader => "C header",
        })
    }
}

/// An address where a policy of `bytes` bytes can lie, whatever the chip.
pub(crate) fn check_address(address: u32, bytes: usize) -> Result<(), ImageError> {
    if !address.is_multiple_of(ADDRESS_ALIGN) {
        return Err(ImageError::Unaligned { address, align: ADDRESS_ALIGN });
    }
    // The last 256 bytes are left free: a UF2 block may not wrap.
    if u64::from(address) + bytes as u64 > u64::from(u32::MAX) - 255 {
        return Err(ImageError::BeyondAddresses { address, bytes });
    }
    Ok(())
}

/// What a container needs beside the bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EncodeOptions {
    /// Address of the policy's first byte in flash; all but raw binaries and C headers need it.
    pub address: Option<u32>,
    /// Family number of the chip in a UF2 file; without it, boot loaders that ask for one refuse the file.
    pub uf2_family: Option<u32>,
}

/// Bytes that lie next to each other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Address of the first one.
    pub address: u32,
    /// The bytes.
    pub bytes: Vec<u8>,
}

/// What was read out of a container.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Contents {
    /// The container.
    pub format: Format,
    /// Whether the addresses come from the container or from the caller; if not, they count from 0.
    pub addressed: bool,
    /// Its pieces, by rising address; no two touch or overlap.
    pub segments: Vec<Segment>,
    /// Family number of a UF2 file.
    pub uf2_family: Option<u32>,
}

/// Reads a container. Which one is seen from the content; `path` only helps to tell a C header from a raw binary.
/// `base` is the address of the first byte of a container that holds none.
///
/// # Errors
/// [`ImageError::Damaged`] with the line, block or offset.
pub fn decode(content: &[u8], path: Option<&Path>, base: Option<u32>) -> Result<Contents, ImageError> {
    let format = recognise(content, path);
    let mut uf2_family = None;
    let mut addressed = true;
    let pieces = match format {
        Format::Hex => hex::decode(content)?,
        Format::Uf2 => {
            let (pieces, family) = uf2::decode(content)?;
            uf2_family = family;
            pieces
        }
        Format::Elf => elf::decode(content)?,
        Format::CHeader => {
            let (own, bytes) = c_header::decode(content)?;
            addressed = own.or(base).is_some();
            vec![Segment { address: own.or(base).unwrap_or(0), bytes }]
        }
        Format::Bin => {
            addressed = base.is_some();
            vec![Segment { address: base.unwrap_or(0), bytes: content.to_vec() }]
        }
    };
    Ok(Contents { format, addressed, segments: join(format, pieces)?, uf2_family })
}

fn recognise(content: &[u8], path: Option<&Path>) -> Format {
    let named = path.and_then(|path| Format::of_path(path).ok());
    if uf2::is_uf2(content) {
        Format::Uf2
    } else if content.starts_with(b"\x7fELF") {
        Format::Elf
    } else if hex::is_hex(content) {
        Format::Hex
    } else if named == Some(Format::CHeader) || c_header::is_c_header(content) {
        Format::CHeader
    } else {
        Format::Bin
    }
}

/// Sorts pieces and joins those that touch.
fn join(format: Format, mut pieces: Vec<Segment>) -> Result<Vec<Segment>, ImageError> {
    pieces.retain(|piece| !piece.bytes.is_empty());
    pieces.sort_by_key(|piece| piece.address);
    let mut joined: Vec<Segment> = Vec::new();
    for piece in pieces {
        let start = u64::from(piece.address);
        if start + piece.bytes.len() as u64 > 1 << 32 {
            let place = format!("address {:#010x}", piece.address);
            return Err(ImageError::Damaged { format, place, what: "it ends beyond 32-bit addresses".to_owned() });
        }
        match joined.last_mut() {
            Some(last) if start < u64::from(last.address) + last.bytes.len() as u64 => {
                let place = format!("address {:#010x}", piece.address);
                return Err(ImageError::Damaged { format, place, what: "two pieces overlap".to_owned() });
            }
            Some(last) if start == u64::from(last.address) + last.bytes.len() as u64 => {
                last.bytes.extend_from_slice(&piece.bytes);
            }
            _ => joined.push(piece),
        }
    }
    Ok(joined)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endings_name_formats() {
        assert_eq!(Format::of_path(Path::new("a/policy.HEX")).unwrap(), Format::Hex);
        assert_eq!(Format::of_path(Path::new("policy.h")).unwrap(), Format::CHeader);
        let error = Format::of_path(Path::new("policy.txt")).unwrap_err().to_string();
        assert!(error.contains("policy.txt") && error.contains(".uf2"), "{error}");
    }

    #[test]
    fn pieces_that_touch_are_joined_and_those_that_overlap_are_refused() {
        let piece = |address, len| Segment { address, bytes: vec![1; len] };
        let joined = join(Format::Hex, vec![piece(32, 16), piece(0, 16), piece(16, 16), piece(64, 1)]).unwrap();
        assert_eq!(joined, [piece(0, 48), piece(64, 1)]);
        let error = join(Format::Hex, vec![piece(0, 17), piece(16, 1)]).unwrap_err().to_string();
        assert!(error.contains("0x00000010") && error.contains("overlap"), "{error}");
    }

    #[test]
    fn addresses_of_a_policy() {
        assert!(check_address(0x0806_0000, 1 << 20).is_ok());
        assert!(matches!(check_address(0x0806_0008, 16), Err(ImageError::Unaligned { .. })));
        assert!(matches!(check_address(0xFFFF_F000, 0x1000), Err(ImageError::BeyondAddresses { .. })));
    }
}
