//! What the programs of this package share: boards, the bus on a UART, flash.
//!
//! | module | holds |
//! | --- | --- |
//! | [`board`] | one file per board: UART, watchdog, timer, memory map |
//! | [`uart_link`] | the bus as SLCAN lines on the UART |
//! | [`flash`], [`clock`] | policy slots and settings; time |
//! | [`register`] | volatile access to device registers |
//! | [`panic`] | the link-time proof that nothing panics |
//! | [`semihosting`] | files of the host, for the programs of the tests |
#![no_std]
#![deny(unsafe_op_in_unsafe_fn, clippy::undocumented_unsafe_blocks, missing_docs)]

pub mod board;
pub mod clock;
pub mod flash;
pub mod panic;
pub mod register;
pub mod semihosting;
pub mod uart_link;
