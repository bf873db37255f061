//! What the programs share: the policies, a counter of instructions, a painted stack.
#![no_std]

pub mod counter;
pub mod digest;
pub mod random;
pub mod stack;

/// A policy made by `build.rs`, with observations and the digest of the host's answers.
pub struct Case {
    /// Name, for people.
    pub name: &'static str,
    /// The policy file.
    pub image: &'static [u8],
    observations: &'static [u8],
    /// What [`digest::Digest`] gives for the host's answers.
    pub digest: u64,
}

/// Puts file content at a multiple of 16 bytes.
#[repr(C, align(16))]
struct Aligned<T>(T);

impl Case {
    /// Observation `row`, in the first `width` slots of `into`; `false` behind the last.
    pub fn observation(&self, row: usize, into: &mut [f32]) -> bool {
        let width = into.len();
        let Some(bytes) = self.observations.as_chunks::<4>().0.get(row * width..(row + 1) * width) else {
            return false;
        };
        for (slot, bytes) in into.iter_mut().zip(bytes) {
            *slot = f32::from_le_bytes(*bytes);
        }
        true
    }
}

include!(concat!(env!("OUT_DIR"), "/cases.rs"));

/// All policies.
pub static CASES: [&Case; 9] = [&STEP, &STEP_SHARED, &Q, &Q_CONFIDENCE, &SMALL, &SMALL_SHARED, &TINY, &MIXED, &EQUAL];

/// A panic ends the emulation with a failure.
#[panic_handler]
fn panic(info: &core::panic::PanicInfo) -> ! {
    cortex_m_semihosting::hprintln!("FAILED: {}", info);
    cortex_m_semihosting::debug::exit(cortex_m_semihosting::debug::EXIT_FAILURE);
    loop {}
}
