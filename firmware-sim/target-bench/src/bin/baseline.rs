//! What `footprint` is without the runtime.
#![no_std]
#![no_main]

use core::hint::black_box;
use cortex_m_rt::entry;

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    loop {}
}

#[entry]
fn main() -> ! {
    black_box(&mut [0u32; 512]);
    loop {
        cortex_m::asm::nop();
    }
}
