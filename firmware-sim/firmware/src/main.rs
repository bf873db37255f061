//! The node as firmware: SLCAN on the UART, policies in two slots of flash, settings in a record.
//!
//! The main loop does one thing: it has the node handle what came, and sleeps until more comes. Interrupts are masked for
//! good and only end the sleep, so there is no concurrency. The watchdog is fed once a round.
#![no_std]
#![no_main]

use cortex_m_rt::{entry, exception};
use gadm_firmware::board;
use gadm_firmware::clock::{Clock, clear_wake_up, start_wake_ups};
use gadm_firmware::flash::{BoardFlash, settings};
use gadm_firmware::uart_link::{Asked, UartLink};
use gadm_node::settings::read_settings;
use gadm_node::slots::Slots;
use gadm_node::{ControlNode, NodeConfig, Profile, TimeSource};

/// Work memory: enough for every policy of the model index many times over.
const SCRATCH_WORDS: usize = 4096;

#[entry]
fn main() -> ! {
    static mut SCRATCH: [u32; SCRATCH_WORDS] = [0; SCRATCH_WORDS];
    board::init();
    let mut config = read_settings(settings()).unwrap_or(NodeConfig { damaged: true, ..NodeConfig::default() });
    config.restarted = board::restarted();
    let lockstep = config.time == TimeSource::Tick;
    if let (false, Some(mut core)) = (lockstep, cortex_m::Peripherals::take()) {
        start_wake_ups(board::CLOCK_HZ, &mut core.SYST);
    }
    let mut clock = Clock::start();
    let mut link = UartLink::new(config.node);
    // SAFETY: here only, once, and nothing else reads or writes the slots.
    let mut slots = Slots::new(unsafe { BoardFlash::take() });
    board::start_watchdog();
    loop {
        // One life of the node, from power-on or START to the next START.
        let policy_crc = slots.policy_crc();
        let mut node = ControlNode::with_store(config, &mut link, &mut slots, SCRATCH);
        let start = loop {
            board::feed();
            let status = node.poll(clock.now_us());
            if status.busy {
                continue;
            }
            match node.link_mut().take_asked() {
                Some(Asked::Start(tag)) => break tag,
                Some(Asked::Barrier(tag)) => node.link_mut().at_rest(tag),
                Some(Asked::Opened) => node.announce(),
                None => {
                    board::wait();
                    clear_wake_up();
                }
            }
        };
        drop(node);
        // As after power-on, but for the slots' RAM, which a boot begins anew.
        config.restarted = false;
        let mode = u8::from(config.profile == Profile::ClassicI16) | if lockstep { 0 } else { 0x80 };
        link.started(start, mode, policy_crc);
        while !board::uart_ready() {
            board::feed();
            board::wait();
            clear_wake_up();
        }
        #[cfg(feature = "control")]
        if SCRATCH[policy_crc as usize] == 7 {
            panic!("a panic that the linker must find");
        }
    }
}

/// The first time-out of the MPS2 watchdog.
// SAFETY: the exception's handler; it does not return and touches nothing of the program.
#[exception]
unsafe fn NonMaskableInt() {
    board::restart_marked()
}

/// A fault of the core: a defect, so the only safe thing is to begin anew.
// SAFETY: as above.
#[exception]
unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
    board::restart_marked()
}
