//! `load_trusted`, `self_test` and `act` and nothing else of the runtime.
#![no_std]
#![no_main]

use core::hint::black_box;
use cortex_m_rt::entry;
use gadm_runtime::{Policy, Scratch};

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    loop {}
}

#[entry]
fn main() -> ! {
    let image: &'static [u8] = black_box(&[]);
    let mut memory = [0; 512];
    let mut scratch = Scratch::new(black_box(&mut memory));
    let mut action = [0.0; 4];
    if let Ok(policy) = Policy::load_trusted(image) {
        black_box(policy.self_test(&mut scratch).is_ok());
        black_box(policy.act(black_box(&[0.0; 11]), &mut scratch, black_box(&mut action)).is_ok());
    }
    loop {
        cortex_m::asm::nop();
    }
}
