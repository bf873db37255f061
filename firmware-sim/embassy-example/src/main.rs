//! The policy node on a NUCLEO-H743ZI2 (STM32H743ZI, Cortex-M7 at 400 MHz) over CAN FD, with Embassy.
//!
//! **Compiled and linked by `make test`, never run on hardware.** The board has no CAN transceiver: one with CAN FD goes to
//! PD0 (receive) and PD1 (transmit) of FDCAN 1.
//!
//! The policy is not linked in. It lies in bank 2 of the flash and is flashed by itself:
//!
//! ```text
//! gadm image policy.bin --address 0x08100000 --chip stm32h743 -o policy.hex
//! ```
//!
//! What is not a policy, or fails its own vectors, is not run: the node then stays in NO_POLICY and says why in its
//! heartbeat. Time is that of the board, so that silence alone leads to the safe action of the policy file. A watchdog
//! restarts a program that hangs, as a panic and a fault do; meanwhile the plant, which hears nothing, makes its actuators
//! safe by itself.
#![no_std]
#![no_main]

mod board;
mod can_link;

use cortex_m::peripheral::SCB;
use cortex_m_rt::exception;
use embassy_executor::Spawner;
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_time::{Duration, Instant, with_timeout};
use gadm_node::{ControlNode, NodeConfig, Profile, TimeSource};
use static_cell::ConstStaticCell;

use crate::can_link::CanLink;

/// Time within which the main loop must come round, microseconds. The longest thing it does is a self-test.
const WATCHDOG_US: u32 = 2_000_000;
/// Without a frame, the node looks at its clock this often.
const IDLE: Duration = Duration::from_millis(1);

/// Work memory: enough for every policy of the model index many times over.
static SCRATCH: ConstStaticCell<[u32; 4096]> = ConstStaticCell::new([0; 4096]);

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    // One task is all there is: the node never waits, so nothing need run beside it.
    let _ = spawner;
    let p = embassy_stm32::init(board::clocks());
    board::enable_caches();
    let config = NodeConfig {
        // `ClassicI16` sends classic frames only; the controller takes both kinds either way.
        profile: Profile::FdF32,
        time: TimeSource::Local,
        restarted: board::restarted_by_itself(),
        ..NodeConfig::default()
    };
    let link = CanLink::start(p.FDCAN1, p.PD0, p.PD1);
    let mut node = ControlNode::new(config, link, board::policy(), SCRATCH.take());
    let mut watchdog = IndependentWatchdog::new(p.IWDG1, WATCHDOG_US);
    watchdog.unleash();
    loop {
        watchdog.pet();
        if !node.poll(Instant::now().as_micros()).busy {
            // A frame or the time-out: both have the node look again.
            let _ = with_timeout(IDLE, node.link_mut().frame_is_there()).await;
        }
    }
}

/// A panic (of a driver: runtime and node have none) restarts the board; the node says so in its heartbeat.
#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    SCB::sys_reset()
}

/// A fault of the core: a defect, so the only safe thing is to begin anew.
// SAFETY: the exception's handler; it does not return and touches nothing of the program.
#[exception]
unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
    SCB::sys_reset()
}
