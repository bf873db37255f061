//! Instructions, from SysTick.
//!
//! With `-icount shift=6` every instruction takes 64 ns of the emulator's time, and SysTick of the mps2 boards counts at
//! 25 MHz: 1.6 ticks an instruction. Counts are exact up to 10 million instructions.

use core::hint::black_box;
use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;

const RELOAD: u32 = 0x00FF_FFFF;

/// The running counter.
pub struct Counter {
    empty: u32,
}

impl Counter {
    /// Starts SysTick and takes an empty reading.
    pub fn start(mut syst: SYST) -> Self {
        syst.set_clock_source(SystClkSource::Core);
        syst.set_reload(RELOAD);
        syst.clear_current();
        syst.enable_counter();
        let mut counter = Self { empty: 0 };
        counter.empty = counter.count(|| ());
        counter
    }

    /// Instructions of `work`, less those of an empty closure.
    #[inline(never)]
    pub fn count<T>(&self, work: impl FnOnce() -> T) -> u32 {
        let start = SYST::get_current();
        black_box(work());
        let ticks = start.wrapping_sub(SYST::get_current()) & RELOAD;
        // 5/8 instruction a tick, rounded.
        ((ticks * 5 + 4) / 8).saturating_sub(self.empty)
    }
}
