//! `load_trusted` and nothing else of the runtime.
#![no_std]
#![no_main]

use core::hint::black_box;
use cortex_m_rt::entry;
use gadm_runtime::Policy;

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    loop {}
}

#[entry]
fn main() -> ! {
    let image: &'static [u8] = black_box(&[]);
    black_box(&mut [0u32; 512]);
    black_box(black_box(&[0.0f32; 11]));
    black_box(black_box(&mut [0.0f32; 4]));
    black_box(black_box(Policy::load_trusted(image)).is_ok());
    loop {
        cortex_m::asm::nop();
    }
}
