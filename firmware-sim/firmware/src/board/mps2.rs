//! Arm MPS2 with FPGA image AN386 (Cortex-M4F) or AN500 (Cortex-M7): `qemu-system-arm -M mps2-an386`, `-M mps2-an500`.
//!
//! Source: Arm DAI 0386 and DAI 0500 for the memory map, Arm DDI 0479 for UART, dual timer and watchdog.

use super::{Span, WATCHDOG_US};
use crate::register::registers;

/// Name of the board, as QEMU spells it.
pub const NAME: &str = if cfg!(feature = "mps2-an500") { "mps2-an500" } else { "mps2-an386" };
/// The policy slots.
pub const SLOTS: [Span; 2] =
    [Span { address: 0x0020_0000, len: 0x8_0000 }, Span { address: 0x0028_0000, len: 0x8_0000 }];
/// The settings record.
pub const SETTINGS: usize = 0x0030_0000;
/// Slots can be written by the program.
pub const WRITABLE: bool = true;

/// Frequency of core and devices, hertz.
pub const CLOCK_HZ: u32 = 25_000_000;

// SAFETY: registers of CMSDK UART 0, dual timer and watchdog and of the interrupt controller, by the sources above.
registers! { unsafe
    UART_DATA = 0x4000_4000;
    UART_STATE = 0x4000_4004;
    UART_CONTROL = 0x4000_4008;
    UART_CLEAR = 0x4000_400C;
    UART_DIVISOR = 0x4000_4010;
    TIMER_VALUE = 0x4000_2004;
    TIMER_CONTROL = 0x4000_2008;
    WATCHDOG_LOAD = 0x4000_8000;
    WATCHDOG_CONTROL = 0x4000_8008;
    WATCHDOG_CLEAR = 0x4000_800C;
    WATCHDOG_LOCK = 0x4000_8C00;
    NVIC_ENABLE = 0xE000_E100;
    NVIC_UNPEND = 0xE000_E280;
}

/// Starts UART and timer. Interrupts stay masked: they only end [`wait`].
pub fn init() {
    cortex_m::interrupt::disable();
    UART_DIVISOR.write(CLOCK_HZ / 115_200);
    UART_CONTROL.write(0b1011); // transmit, receive, receive interrupt
    NVIC_ENABLE.write(1); // UART 0 receive
    TIMER_CONTROL.write(0b1000_0010); // on, free-running, 32 bits
}

/// A received byte is there.
pub fn uart_ready() -> bool {
    UART_STATE.read() & 2 != 0
}

/// A received byte, if there is one.
pub fn uart_read() -> Option<u8> {
    if !uart_ready() {
        return None;
    }
    let [byte, ..] = UART_DATA.read().to_le_bytes();
    UART_CLEAR.write(2);
    NVIC_UNPEND.write(1);
    Some(byte)
}

/// Sends a byte; waits while the transmitter is full.
pub fn uart_write(byte: u8) {
    while UART_STATE.read() & 1 != 0 {}
    UART_DATA.write(u32::from(byte));
}

/// Sleeps until a byte is there or a millisecond tick is due.
pub fn wait() {
    cortex_m::asm::wfi();
}

/// Low 32 bits of a timer of [`TIMER_HZ`].
pub fn timer() -> u32 {
    !TIMER_VALUE.read()
}

/// Frequency of [`timer`], hertz.
pub const TIMER_HZ: u32 = CLOCK_HZ;

/// Starts the watchdog: [`WATCHDOG_US`] after the last [`feed`] it raises the non-maskable interrupt, after as much
/// time again it resets the board.
pub fn start_watchdog() {
    WATCHDOG_LOCK.write(0x1ACC_E551);
    WATCHDOG_LOAD.write(CLOCK_HZ / 1_000_000 * WATCHDOG_US);
    WATCHDOG_CONTROL.write(0b11);
}

/// Tells the watchdog that the program is well.
pub fn feed() {
    WATCHDOG_CLEAR.write(1);
}

/// The last restart was the watchdog's or a fault's.
pub fn restarted() -> bool {
    super::take_restart_mark()
}
