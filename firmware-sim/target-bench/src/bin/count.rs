//! Instructions, stack and sizes, one `key value...` line each; `.ci/bench-target.py` makes a table of them.
#![no_std]
#![no_main]

use core::hint::black_box;
use core::ptr::addr_of_mut;
use cortex_m_rt::entry;
use cortex_m_semihosting::{debug, hprintln};
use gadm_runtime::kernels::{self, portable};
use gadm_runtime::{Policy, Scratch};
use gadm_target_bench::counter::Counter;
use gadm_target_bench::random::{Random, bytes, constants, fill};
use gadm_target_bench::stack::bytes_used;
use gadm_target_bench::{CASES, Case, STEP};

const STREAM: usize = 60_000;
static mut WORDS: [u32; STREAM] = [0; STREAM];

type Layer = fn(&[u8], u16, u32, &[u32], &mut [u32]);
type Linear = fn(&[u8], u16, &[u32], &mut [u32]);
type Modulated = fn(&[u8], u16, u32, &[u8], &[u32], &mut [u32]);

struct Kernels {
    name: &'static str,
    hidden: Layer,
    linear: Linear,
    modulated: Modulated,
}

/// A network as the peers in the table were counted: its layers, one after the other, with requantisation.
fn network(counter: &Counter, words: &mut [u32], kernels: &Kernels, name: &str, widths: &[u16], modulated: bool) {
    let mut random = Random(77);
    let (table, words) = words.split_at_mut(2048);
    for table in table.as_chunks_mut::<8>().0 {
        constants(table, &mut random);
    }
    let mut total = 0;
    let mut weights = 0;
    let mut x = [3u32; 128];
    for (index, pair) in widths.windows(2).enumerate() {
        let (cols, rows) = (pair[0], usize::from(pair[1]));
        let table_now = modulated && index == 0;
        let used = fill(words, &mut random, rows, cols, table_now, 35, 1000);
        let stream = black_box(bytes(&words[..used]));
        let mut out = [0u32; 256];
        let from = &x[..usize::from(cols).next_multiple_of(16) / 2];
        total += if index + 2 == widths.len() {
            counter.count(|| (kernels.linear)(stream, cols, from, &mut out[..rows.next_multiple_of(4)]))
        } else if table_now {
            let table = bytes(table);
            counter.count(|| (kernels.modulated)(stream, cols, 10, table, from, &mut out[..rows / 2]))
        } else {
            counter.count(|| (kernels.hidden)(stream, cols, 10, from, &mut out[..rows / 2]))
        };
        x.copy_from_slice(&out[..128]);
        weights += used * 4;
    }
    hprintln!("{}.{} {} {} {}", kernels.name, name, total, total, weights);
}

/// Fewest and most instructions of a step over all observations, bytes of the file's networks, scratch memory.
fn step(counter: &Counter, case: &Case) {
    let policy = Policy::load(case.image).expect("a policy that the host has loaded");
    let mut memory = [0; 1024];
    let words = policy.spec().scratch_words;
    let mut scratch = Scratch::new(&mut memory[..words]);
    let mut obs = [0.0; 16];
    let obs = &mut obs[..usize::from(policy.spec().obs_dim)];
    let mut action = [0.0; 4];
    let (mut least, mut most, mut row) = (u32::MAX, 0, 0);
    while case.observation(row, obs) {
        let count = counter.count(|| policy.act(black_box(obs), &mut scratch, &mut action).is_ok());
        least = least.min(count);
        most = most.max(count);
        row += 1;
    }
    let weights: usize = policy.layers().map(|layer| layer.bytes).sum();
    hprintln!("act.{} {} {} {}", case.name, least, most, weights);
    hprintln!("scratch.{} {}", case.name, words * 4);
    // The counter holds ten million; the larger files take more.
    if case.image.len() < 100_000 {
        let load = counter.count(|| _ = black_box(Policy::load(black_box(case.image))));
        hprintln!("load.{} {}", case.name, load);
        let load = counter.count(|| _ = black_box(Policy::load_trusted(black_box(case.image))));
        hprintln!("load_trusted.{} {}", case.name, load);
    }
}

fn stack() {
    let mut memory = [0; 1024];
    let mut action = [0.0; 4];
    let mut obs = [0.0; 11];
    STEP.observation(0, &mut obs);
    let mut scratch = Scratch::new(&mut memory);
    let load = bytes_used(|| _ = black_box(Policy::load(black_box(STEP.image))));
    let policy = Policy::load(STEP.image).expect("a policy that the host has loaded");
    let act = bytes_used(|| _ = black_box(policy.act(&obs, &mut scratch, &mut action)));
    let self_test = bytes_used(|| _ = black_box(policy.self_test(&mut scratch)));
    hprintln!("stack.load {}\nstack.act {}\nstack.self_test {}", load, act, self_test);
}

#[entry]
fn main() -> ! {
    let peripherals = cortex_m::Peripherals::take().expect("taken once");
    let counter = Counter::start(peripherals.SYST);
    // SAFETY: the only reference to the buffer, made once.
    let words = unsafe { &mut *addr_of_mut!(WORDS) };
    let assembly = Kernels {
        name: "net",
        hidden: kernels::hidden_layer,
        linear: kernels::linear_layer,
        modulated: kernels::modulated_layer,
    };
    let reference = Kernels {
        name: "portable",
        hidden: portable::hidden_layer,
        linear: portable::linear_layer,
        modulated: portable::modulated_layer,
    };
    for kernels in [&assembly, &reference] {
        network(&counter, words, kernels, "q", &[11, 256, 256, 128, 64], false);
        network(&counter, words, kernels, "confidence", &[11, 256, 256, 64], false);
        network(&counter, words, kernels, "decoder", &[11, 256, 256, 256, 153], true);
        network(&counter, words, kernels, "decoder_plain", &[11, 256, 256, 256, 153], false);
        network(&counter, words, kernels, "q_tail", &[256, 128, 64], false);
        network(&counter, words, kernels, "small", &[10, 128, 128, 64, 16], false);
        network(&counter, words, kernels, "tiny", &[13, 64, 64, 4], false);
    }
    for case in CASES {
        step(&counter, case);
    }
    stack();
    debug::exit(debug::EXIT_SUCCESS);
    loop {}
}
