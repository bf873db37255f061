//! Netduino Plus 2, an STM32F405RG: `qemu-system-arm -M netduinoplus2`.
//!
//! QEMU has its flash, RAM, USART and timers, but neither clocks nor flash controller nor watchdog; what is written to
//! those is lost there. Nothing of this ran on hardware.
//!
//! Source: ST RM0090 for all registers.

use super::{Span, WATCHDOG_US};
use crate::register::registers;

/// Name of the board, as QEMU spells it.
pub const NAME: &str = "netduinoplus2";
/// The policy slots: flash sectors 7 and 8, 9 and 10.
pub const SLOTS: [Span; 2] =
    [Span { address: 0x0806_0000, len: 0x4_0000 }, Span { address: 0x080A_0000, len: 0x4_0000 }];
/// The settings record: flash sector 11.
pub const SETTINGS: usize = 0x080E_0000;
/// Slots cannot be written by the program.
pub const WRITABLE: bool = false;

/// Frequency of core and devices after reset (HSI), hertz.
pub const CLOCK_HZ: u32 = 16_000_000;
/// Frequency of the watchdog's oscillator (LSI), hertz.
const WATCHDOG_HZ: u32 = 32_000;

// SAFETY: registers of the STM32F405 and of its interrupt controller, by RM0090.
registers! { unsafe
    GPIOA_MODE = 0x4002_0000;
    GPIOA_FUNCTION_HIGH = 0x4002_0024;
    RCC_AHB1_ENABLE = 0x4002_3830;
    RCC_APB1_ENABLE = 0x4002_3840;
    RCC_APB2_ENABLE = 0x4002_3844;
    RCC_STATUS = 0x4002_3874;
    USART_STATUS = 0x4001_1000;
    USART_DATA = 0x4001_1004;
    USART_BAUD = 0x4001_1008;
    USART_CONTROL = 0x4001_100C;
    TIM2_CONTROL = 0x4000_0000;
    TIM2_COUNT = 0x4000_0024;
    TIM2_PRESCALE = 0x4000_0028;
    TIM2_RELOAD = 0x4000_002C;
    IWDG_KEY = 0x4000_3000;
    IWDG_PRESCALE = 0x4000_3004;
    IWDG_RELOAD = 0x4000_3008;
    NVIC_ENABLE_1 = 0xE000_E104;
    NVIC_UNPEND_1 = 0xE000_E284;
}

/// Bit of USART 1, interrupt 37, in the second word of the interrupt controller.
const USART1_IRQ: u32 = 1 << 5;

/// Starts USART 1 on PA9 and PA10 and timer 2. Interrupts stay masked: they only end [`wait`].
pub fn init() {
    cortex_m::interrupt::disable();
    RCC_AHB1_ENABLE.set(1); // GPIO A
    RCC_APB1_ENABLE.set(1); // TIM2
    RCC_APB2_ENABLE.set(1 << 4); // USART1
    GPIOA_MODE.write(GPIOA_MODE.read() & !(0b1111 << 18) | 0b1010 << 18);
    GPIOA_FUNCTION_HIGH.write(GPIOA_FUNCTION_HIGH.read() & !(0xFF << 4) | 0x77 << 4);
    USART_BAUD.write(CLOCK_HZ / 115_200);
    USART_CONTROL.write(0x202C); // on, transmit, receive, receive interrupt
    NVIC_ENABLE_1.write(USART1_IRQ);
    TIM2_RELOAD.write(u32::MAX);
    TIM2_PRESCALE.write(CLOCK_HZ / TIMER_HZ - 1);
    TIM2_CONTROL.write(1);
}

/// A received byte is there.
pub fn uart_ready() -> bool {
    USART_STATUS.read() & 1 << 5 != 0
}

/// A received byte, if there is one.
pub fn uart_read() -> Option<u8> {
    if !uart_ready() {
        return None;
    }
    let [byte, ..] = USART_DATA.read().to_le_bytes();
    NVIC_UNPEND_1.write(USART1_IRQ);
    Some(byte)
}

/// Sends a byte; waits while the transmitter is full.
pub fn uart_write(byte: u8) {
    while USART_STATUS.read() & 1 << 7 == 0 {}
    USART_DATA.write(u32::from(byte));
}

/// Sleeps until a byte is there or a millisecond tick is due.
pub fn wait() {
    cortex_m::asm::wfi();
}

/// Low 32 bits of a timer of [`TIMER_HZ`].
pub fn timer() -> u32 {
    TIM2_COUNT.read()
}

/// Frequency of [`timer`], hertz.
pub const TIMER_HZ: u32 = 1_000_000;

/// Starts the watchdog, which resets the board [`WATCHDOG_US`] after the last [`feed`].
pub fn start_watchdog() {
    IWDG_KEY.write(0x5555);
    IWDG_PRESCALE.write(4); // by 64
    IWDG_RELOAD.write(WATCHDOG_HZ / 64 * (WATCHDOG_US / 1_000_000));
    IWDG_KEY.write(0xCCCC);
}

/// Tells the watchdog that the program is well.
pub fn feed() {
    IWDG_KEY.write(0xAAAA);
}

/// The last restart was the watchdog's or a fault's.
pub fn restarted() -> bool {
    let watchdog = RCC_STATUS.read() & 1 << 29 != 0;
    RCC_STATUS.set(1 << 24); // clear the flags
    super::take_restart_mark() || watchdog
}
