//! C interface of the runtime: load a policy, ask for its needs, test it, run it.
//!
//! Everything is in memory of the caller. Pointers are checked as far as a library can: null, alignment, lengths beyond
//! the address space, and overlap of what is read with what is written give a status. What it cannot check stands in the
//! header beside each function. The header `include/gadm.h` is made from this crate; a test compares them.
#![no_std]

mod functions;
mod memory;
mod status;
mod types;

pub use functions::*;
pub use status::Status;
pub use types::*;

#[cfg(feature = "prove")]
unsafe extern "C" {
    /// Defined nowhere: a library that names it can reach a panic.
    safe fn gadm_panic_is_reachable() -> !;
}

/// Nothing in the library panics (`tests/no-panic.sh` proves it for the release build), so this is never reached there.
#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    #[cfg(feature = "prove")]
    gadm_panic_is_reachable();
    #[cfg(not(feature = "prove"))]
    loop {
        core::hint::spin_loop();
    }
}
