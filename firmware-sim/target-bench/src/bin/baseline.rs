//! What `footprint` is without the runtime: the caller's data and nothing that uses it.
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
    let image: &'static [u8] = black_box(&[]);
    black_box(image.len());
    black_box(&mut [0u32; 512]);
    black_box(black_box(&[0.0f32; 11]));
    black_box(black_box(&mut [0.0f32; 4]));
    loop {
        cortex_m::asm::nop();
    }
}
