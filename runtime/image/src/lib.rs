//! Policy files as flash images.
//!
//! A policy is one file that lies in flash by itself, beside the firmware and not in it. This crate puts it into the
//! containers that flashing tools take ([`Format`]), checks the place against the erase blocks of the chip ([`Layout`],
//! [`chip`]), and reads any of the containers back: it finds the policy in them, loads it with the runtime and runs its
//! self-test ([`verify`]). It writes no file and talks to no device.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use gadm_image::{EncodeOptions, Expected, Format, Layout, PolicyImage, chip, decode, verify};
//!
//! # let file = include_bytes!("../../tests/data/format-1.bin");
//! let policy = PolicyImage::check(file)?;
//! let place = Layout::of_chip(chip("stm32f405").expect("in the table")).place(0x0806_0000, policy.bytes().len())?;
//! assert_eq!(place.blocks.len(), 1);
//! let hex = Format::Hex.encode(&policy, &EncodeOptions { address: Some(0x0806_0000), uf2_family: None })?;
//! let found = verify(&decode(&hex, None, None)?, &Expected { address: Some(0x0806_0000), policy: Some(file) })?;
//! assert_eq!(found.address, 0x0806_0000);
//! # Ok(())
//! # }
//! ```

mod c_header;
mod chip;
mod elf;
mod error;
mod format;
mod hex;
mod layout;
mod lines;
mod policy;
mod uf2;
mod verify;

pub use chip::{CHIPS, Chip, chip};
pub use error::ImageError;
pub use format::{Contents, EncodeOptions, Format, Segment, decode};
pub use layout::{Bank, Block, Layout, Placement};
pub use lines::{FlashJob, Line, flashing_lines};
pub use policy::{PolicyImage, Summary};
pub use verify::{Expected, Found, verify};

/// Value of an erased byte of flash on every chip of the table; fills what a container pads.
pub const ERASED: u8 = 0xFF;
/// A policy starts at a multiple of this in flash: its sections are laid out for it, and every erase block allows it.
pub const ADDRESS_ALIGN: u32 = 16;
