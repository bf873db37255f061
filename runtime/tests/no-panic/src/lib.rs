//! Everything a device calls, with a panic handler that leaves a mark in the library when it is reachable.
#![no_std]

use gadm_runtime::{Policy, Scratch};

unsafe extern "C" {
    safe fn gadm_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    gadm_panic_is_reachable()
}

/// Arguments of [`gadm_entry`].
#[repr(C)]
pub struct Arguments {
    image: &'static [u8],
    observation: &'static [f32],
    quantised: &'static [i16],
    memory: &'static mut [u32],
    action: &'static mut [f32],
}

/// Loads, tests, inspects and runs a policy.
// SAFETY: the name is used once in the library.
#[unsafe(no_mangle)]
#[allow(improper_ctypes_definitions, reason = "never called, only linked")]
pub extern "C" fn gadm_entry(arguments: &mut Arguments) -> usize {
    let load = if arguments.memory.len() % 2 == 0 { Policy::load } else { Policy::load_trusted };
    let Ok(policy) = load(arguments.image) else { return 1 };
    let mut scratch = Scratch::new(arguments.memory);
    if policy.self_test(&mut scratch).is_err() {
        return 2;
    }
    let mut sum = policy.provenance().commit.len() ^ policy.section_sizes().padding;
    sum = policy.observation_signals().fold(sum, |sum, signal| sum ^ signal.name.len() ^ signal.lo.to_bits() as usize);
    sum = policy.action_signals().fold(sum, |sum, signal| sum ^ signal.unit.len() ^ signal.safe.to_bits() as usize);
    sum = policy.trailer().fold(sum, |sum, (kind, data)| sum ^ usize::from(kind) ^ data.len());
    sum = policy.layers().fold(sum, |sum, layer| sum ^ layer.bytes);
    sum = policy.input_quantisers().fold(sum, |sum, quantiser| sum ^ quantiser.quantise(1.0).0 as usize);
    let Ok(first) = policy.act(arguments.observation, &mut scratch, arguments.action) else { return 3 };
    let Ok(second) = policy.act_q(arguments.quantised, &mut scratch, arguments.action) else { return 4 };
    sum ^= usize::from(first.latent) ^ second.allowed.len() ^ second.allowed.iter().count();
    #[cfg(feature = "control")]
    let sum = sum ^ usize::from(arguments.image[sum]);
    sum
}
