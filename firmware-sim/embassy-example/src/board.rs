//! What is particular to the NUCLEO-H743ZI2: clocks, caches, where the policy lies, why the board started.
//!
//! Source: ST RM0433 (STM32H743), UM2407 (NUCLEO-144 boards with STM32H7).

use embassy_stm32::rcc::{
    AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllDiv, PllMul, PllPreDiv, PllSource, Sysclk, VoltageScale, mux,
};
use embassy_stm32::time::Hertz;
use embassy_stm32::{Config, pac};

/// Bank 2 of the flash: 8 sectors of 128 KiB, of which a policy takes as many as it needs.
const POLICY_ADDRESS: usize = 0x0810_0000;
/// Bytes of bank 2.
const POLICY_LEN: usize = 0x10_0000;

/// 400 MHz for the core, 80 MHz for FDCAN, from the 8 MHz that the debugger's chip puts out (UM2407, section 6.8.1).
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Bypass });
    config.rcc.pll1 = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV1,
        mul: PllMul::MUL100,
        fracn: None,
        divp: Some(PllDiv::DIV2),
        divq: Some(PllDiv::DIV10),
        divr: None,
    });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.ahb_pre = AHBPrescaler::DIV2;
    config.rcc.apb1_pre = APBPrescaler::DIV2;
    config.rcc.apb2_pre = APBPrescaler::DIV2;
    config.rcc.apb3_pre = APBPrescaler::DIV2;
    config.rcc.apb4_pre = APBPrescaler::DIV2;
    config.rcc.voltage_scale = VoltageScale::Scale1;
    config.rcc.mux.fdcansel = mux::Fdcansel::PLL1_Q;
    config
}

/// Turns the caches on: the weights come from flash, in order. Nothing here uses DMA, so no memory needs to be kept out.
pub fn enable_caches() {
    if let Some(mut core) = cortex_m::Peripherals::take() {
        core.SCB.enable_icache();
        core.SCB.enable_dcache(&mut core.CPUID);
    }
}

/// The bytes where a policy may lie.
pub fn policy() -> &'static [u8] {
    // SAFETY: flash that is always there, outside of the program (`build.rs`), and that nothing in this program writes.
    unsafe { core::slice::from_raw_parts(core::ptr::with_exposed_provenance(POLICY_ADDRESS), POLICY_LEN) }
}

/// The watchdog or the program itself restarted the board. Forgets it.
pub fn restarted_by_itself() -> bool {
    let cause = pac::RCC.rsr().read();
    pac::RCC.rsr().modify(|w| w.set_rmvf(true));
    cause.iwdg1rstf() || cause.sftrstf()
}
