//! What can be wrong with an image, where, and what to do.

use gadm_runtime::{LoadError, SelfTestError};

use crate::Format;

/// Why no image was made, or why one was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The runtime does not load the file.
    #[error("not a policy that the runtime loads: {0}")]
    Load(LoadError),
    /// The policy fails its own vectors.
    #[error("the policy fails its self-test: {0}")]
    SelfTest(SelfTestError),
    /// The name of an output does not say which format.
    #[error("`{name}`: no format for this ending; use one of .bin, .hex, .uf2, .elf, .h")]
    UnknownFormat {
        /// File name.
        name: String,
    },
    /// The container holds addresses and none was given.
    #[error("a {format} file holds the address in flash: give --address")]
    NoAddress {
        /// Format to write.
        format: Format,
    },
    /// The address is not one where a policy may start.
    #[error("address {address:#010x} is not a multiple of {align}; the next lower one is {lower:#010x}", lower = address - address % align)]
    Unaligned {
        /// Address asked for.
        address: u32,
        /// Multiple needed, in bytes.
        align: u32,
    },
    /// The image does not end within 32-bit addresses.
    #[error("{bytes} bytes at {address:#010x} end beyond 32-bit addresses; choose a lower address")]
    BeyondAddresses {
        /// Address asked for.
        address: u32,
        /// Length of the policy.
        bytes: usize,
    },
    /// The image is not inside of the flash.
    #[error(
        "{bytes} bytes at {address:#010x} are not inside of {what} ({start:#010x} to {end:#010x}, end excluded); {advice}"
    )]
    Outside {
        /// `flash` or `the region`.
        what: &'static str,
        /// Address asked for.
        address: u32,
        /// Length of the policy.
        bytes: usize,
        /// First address.
        start: u32,
        /// First address behind it.
        end: u64,
        /// Addresses where the policy fits.
        advice: String,
    },
    /// The image starts in the middle of an erase block.
    #[error(
        "address {address:#010x} is inside of the erase block {start:#010x} ({block} bytes), and erasing it would destroy \
         what lies before the policy; {advice}"
    )]
    NotOnBlock {
        /// Address asked for.
        address: u32,
        /// Start of the block.
        start: u32,
        /// Its length in bytes.
        block: u32,
        /// Addresses where the policy fits.
        advice: String,
    },
    /// The image would replace what the core starts from.
    #[error("address {address:#010x} is where the core starts from: the policy would replace the firmware; {advice}")]
    Boot {
        /// Address asked for.
        address: u32,
        /// Addresses where the policy fits.
        advice: String,
    },
    /// A last erase block reaches beyond the region.
    #[error(
        "the policy's last erase block ends at {block_end:#010x}, the region at {end:#010x}: erasing would destroy what \
         lies behind it; end the region at an erase block"
    )]
    BlockBeyondRegion {
        /// First address behind the block.
        block_end: u64,
        /// First address behind the region.
        end: u64,
    },
    /// Sizes that describe no flash.
    #[error("{what}: {found} found, {expected} expected")]
    Layout {
        /// Which value.
        what: &'static str,
        /// What was given.
        found: String,
        /// What would do.
        expected: &'static str,
    },
    /// A container is damaged.
    #[error("{format} file damaged at {place}: {what}; write it again")]
    Damaged {
        /// Format that the file seems to have.
        format: Format,
        /// Line, block or offset.
        place: String,
        /// What is wrong.
        what: String,
    },
    /// No policy is in the file.
    #[error(
        "no policy found in {bytes} bytes ({segments} pieces) of this {format} file: nothing in it starts with the first \
         bytes of a policy file; give what `gadm image` wrote or what was read back from flash"
    )]
    NoPolicy {
        /// Format of the file.
        format: Format,
        /// Bytes of content.
        bytes: usize,
        /// Contiguous pieces.
        segments: usize,
    },
    /// More than one policy is in the file.
    #[error("{count} policies in this file, at {addresses}; say with --address which one", count = addresses.split(", ").count())]
    ManyPolicies {
        /// Their addresses.
        addresses: String,
    },
    /// The policy is somewhere else.
    #[error("no policy at {expected:#010x}; found: {found}")]
    OtherAddress {
        /// Address asked for.
        expected: u32,
        /// Addresses of what was found.
        found: String,
    },
    /// The policy is another one.
    #[error(
        "not the policy to compare with: {expected_len} bytes expected, {found_len} found, first difference at byte {offset}; \
         write and flash the image again"
    )]
    Different {
        /// First byte that differs, from the start of the policy.
        offset: usize,
        /// Length expected.
        expected_len: usize,
        /// Length found.
        found_len: usize,
    },
    /// An ELF file could not be made.
    #[error("cannot make the ELF file: {0}")]
    ElfWrite(String),
}
