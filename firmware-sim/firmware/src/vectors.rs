//! Runs the policy in slot 0 on observations from a file of the host and writes what it decided to another.
//!
//! `vectors.in`: per observation its values, f32 little endian. `vectors.out`: per observation the latent (u16), fallback
//! and clipped (u8 each), the mask (8 words, bit k of word j is latent 32 j + k), the actions (f32). Exit status 0; 2 where
//! the policy does not load or fails its own vectors, 3 for the files, 4 for a step.
#![no_std]
#![no_main]

use cortex_m_rt::entry;
use gadm_firmware::flash::BoardFlash;
use gadm_firmware::semihosting::{File, exit};
use gadm_node::protocol::{MAX_ACTIONS, MAX_OBSERVATIONS};
use gadm_node::slots::Flash;
use gadm_runtime::{Policy, Scratch};

#[entry]
fn main() -> ! {
    static mut SCRATCH: [u32; 4096] = [0; 4096];
    // SAFETY: here only, once.
    let flash = unsafe { BoardFlash::take() };
    let Ok(policy) = Policy::load(flash.image(0)) else { exit(2) };
    let mut scratch = Scratch::new(SCRATCH);
    if policy.self_test(&mut scratch).is_err() {
        exit(2);
    }
    let (Some(mut input), Some(mut output)) = (File::open(b"vectors.in\0", false), File::open(b"vectors.out\0", true))
    else {
        exit(3)
    };
    let (obs_dim, action_dim) = (usize::from(policy.spec().obs_dim), usize::from(policy.spec().action_dim));
    let mut bytes = [[0; 4]; MAX_OBSERVATIONS];
    let (Some(bytes), mut obs) = (bytes.get_mut(..obs_dim), [0.0; MAX_OBSERVATIONS]) else { exit(3) };
    let mut action = [0.0; MAX_ACTIONS];
    let (Some(obs), Some(action)) = (obs.get_mut(..obs_dim), action.get_mut(..action_dim)) else { exit(3) };
    while input.read(bytes.as_flattened_mut()) {
        for (value, bytes) in obs.iter_mut().zip(&*bytes) {
            *value = f32::from_le_bytes(*bytes);
        }
        let Ok(decision) = policy.act(obs, &mut scratch, action) else { exit(4) };
        let mut mask = [[0; 4]; 8];
        for (word, bits) in mask.iter_mut().enumerate() {
            let set = |bit: &u32| u16::try_from(32 * word + *bit as usize).is_ok_and(|k| decision.allowed.contains(k));
            *bits = (0..32).filter(set).fold(0_u32, |bits, bit| bits | 1 << bit).to_le_bytes();
        }
        let [low, high] = decision.latent.to_le_bytes();
        let mut written = output.write(&[low, high, u8::from(decision.fallback), u8::from(decision.clipped)]);
        written &= output.write(mask.as_flattened());
        for value in action.iter() {
            written &= output.write(&value.to_le_bytes());
        }
        if !written {
            exit(3);
        }
    }
    input.close();
    output.close();
    exit(0)
}
