//! The board's time for a node that is not in lockstep.

use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::{SCB, SYST};

use crate::board::{TIMER_HZ, timer};

/// Ticks of the board's timer in a microsecond.
const TICKS_PER_US: u32 = TIMER_HZ / 1_000_000;

/// Microseconds since it was started. It must be read at least once in [`u32::MAX`] timer ticks.
#[derive(Debug)]
pub struct Clock {
    last: u32,
    ticks: u64,
}

impl Clock {
    /// Starts to count.
    #[must_use]
    pub fn start() -> Self {
        Self { last: timer(), ticks: 0 }
    }

    /// Microseconds.
    pub fn now_us(&mut self) -> u64 {
        let now = timer();
        self.ticks += u64::from(now.wrapping_sub(self.last));
        self.last = now;
        self.ticks / u64::from(TICKS_PER_US)
    }
}

/// Has the core wake up about every millisecond, so that time passes without frames.
pub fn start_wake_ups(core_clock_hz: u32, systick: &mut SYST) {
    systick.set_clock_source(SystClkSource::Core);
    systick.set_reload(core_clock_hz / 1000 - 1);
    systick.clear_current();
    systick.enable_counter();
    systick.enable_interrupt();
}

/// Forgets a wake-up that came, so that the next sleep is one. Interrupts are masked, so it only is pending.
pub fn clear_wake_up() {
    SCB::clear_pendst();
}
