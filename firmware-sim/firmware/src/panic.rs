//! The proof that no panic is reachable, made by the linker.
//!
//! The panic handler calls a function that exists nowhere. Link-time optimisation drops the handler where nothing can
//! panic; where something can, the program does not link, and the linker names the function that can.

unsafe extern "C" {
    safe fn gadm_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    gadm_panic_is_reachable()
}
