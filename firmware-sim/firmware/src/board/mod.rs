//! The boards. Each offers the same functions and constants; a feature of the package chooses one at build time.
//!
//! | board | core | policy slots | watchdog |
//! | --- | --- | --- | --- |
//! | `mps2-an386` | Cortex-M4F | 2 × 512 KiB from 0x0020_0000; the machine has SSRAM there, the program gives it the rules of flash | the board's, emulated |
//! | `mps2-an500` | Cortex-M7 | as above | as above |
//! | `netduinoplus2` (STM32F405) | Cortex-M4F | 2 × 256 KiB from 0x0806_0000, flash sectors 7 + 8 and 9 + 10; to be written by a flashing tool only, since QEMU has no flash controller | IWDG, which QEMU leaves out |

use core::sync::atomic::{AtomicU32, Ordering};

#[cfg(any(feature = "mps2-an386", feature = "mps2-an500"))]
mod mps2;
#[cfg(any(feature = "mps2-an386", feature = "mps2-an500"))]
pub use mps2::*;

#[cfg(feature = "netduinoplus2")]
mod netduinoplus2;
#[cfg(feature = "netduinoplus2")]
pub use netduinoplus2::*;

/// A range of addresses that holds one policy slot.
#[derive(Clone, Copy, Debug)]
pub struct Span {
    /// First address.
    pub address: usize,
    /// Bytes.
    pub len: usize,
}

/// Time within which the main loop must come round, microseconds. The longest thing it does is a self-test.
pub const WATCHDOG_US: u32 = 2_000_000;

/// Survives a restart of the core; its value after power-on is any.
// SAFETY: the name of the section is the one that the linker script of cortex-m-rt leaves alone at start-up; every bit
// pattern is an `AtomicU32`.
#[unsafe(link_section = ".uninit.RESTART_MARK")]
static RESTART_MARK: AtomicU32 = AtomicU32::new(0);

/// In [`RESTART_MARK`]: the watchdog or a fault of the core restarted the program.
const MARK: u32 = 0x5AFE_D069;

/// Leaves the mark and restarts the core, devices included.
pub fn restart_marked() -> ! {
    RESTART_MARK.store(MARK, Ordering::Relaxed);
    cortex_m::peripheral::SCB::sys_reset()
}

/// True, once, where the program was restarted by [`restart_marked`].
pub fn take_restart_mark() -> bool {
    let found = RESTART_MARK.load(Ordering::Relaxed) == MARK;
    RESTART_MARK.store(0, Ordering::Relaxed);
    found
}
