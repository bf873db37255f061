//! Bit equality on the target: assembly against portable kernels for every shape, and steps against the host's answers.
#![no_std]
#![no_main]

use core::ptr::addr_of_mut;
use cortex_m_rt::entry;
use cortex_m_semihosting::{debug, hprintln};
use gadm_runtime::kernels::{self, portable};
use gadm_runtime::{Policy, Scratch};
use gadm_target_bench::digest::Digest;
use gadm_target_bench::random::{Random, bytes, constants, fill};
use gadm_target_bench::{CASES, Case};

const STREAM: usize = 200_000;
static mut WORDS: [u32; STREAM] = [0; STREAM];

/// Kernels under one name each.
struct Bench<'m> {
    stream: &'m mut [u32],
    random: Random,
    cases: u32,
    wraps: u32,
}

/// One past the outputs; a kernel must not touch it.
const GUARD: u32 = 0xDEAD_BEEF;

impl Bench<'_> {
    /// A random layer of this shape with `x` in `lo..=lo + span`, by all kernels.
    fn shape(&mut self, rows: usize, cols: u16, lo: i32, span: u32, largest: i32, start: i32) {
        let mut x = [0u32; 520];
        let x = &mut x[..usize::from(cols).next_multiple_of(16) / 2];
        for word in x.iter_mut() {
            // The padding holds rubbish, which must not count.
            let mut value = || (lo + self.random.below(span + 1).cast_signed()) as u16;
            *word = u32::from(value()) | u32::from(value()) << 16;
        }
        let padded = rows.next_multiple_of(4);
        let (mut found, mut expected) = ([GUARD; 1028], [GUARD; 1028]);

        let used = fill(self.stream, &mut self.random, rows, cols, false, largest, start);
        let stream = bytes(&self.stream[..used]);
        for bits in [8, 10] {
            kernels::hidden_layer(stream, cols, bits, x, &mut found[..padded / 2]);
            portable::hidden_layer(stream, cols, bits, x, &mut expected[..padded / 2]);
            assert!(found == expected, "hidden {bits} bits, {rows} x {cols}");
        }
        kernels::linear_layer(stream, cols, x, &mut found[..padded]);
        portable::linear_layer(stream, cols, x, &mut expected[..padded]);
        assert!(found == expected, "linear, {rows} x {cols}");
        self.wraps += self.wrapping_blocks(used, rows, cols, x);

        let used = fill(self.stream, &mut self.random, rows, cols, true, largest, start);
        let (stream, table) = self.stream.split_at_mut(used);
        let table = &mut table[..padded * 2];
        for table in table.as_chunks_mut::<8>().0 {
            constants(table, &mut self.random);
        }
        let (stream, table) = (bytes(stream), bytes(table));
        for bits in [8, 10] {
            kernels::modulated_layer(stream, cols, bits, table, x, &mut found[..padded / 2]);
            portable::modulated_layer(stream, cols, bits, table, x, &mut expected[..padded / 2]);
            assert!(found == expected, "modulated {bits} bits, {rows} x {cols}");
        }
        self.cases += 5;
    }

    /// Blocks of a layer in which a raw accumulator leaves 32 bits on the way.
    fn wrapping_blocks(&self, used: usize, rows: usize, cols: u16, x: &[u32]) -> u32 {
        let blocks = rows.div_ceil(4);
        let wraps = |block: &[u32]| {
            (0..2).any(|pair| {
                let (raw, b) = (block[2 * pair].cast_signed(), block[2 * pair + 1].cast_signed());
                let mut raw = i64::from(raw.wrapping_sub(b)) + i64::from(b);
                let mut leaves = i32::try_from(raw).is_err();
                for col in 0..usize::from(cols) {
                    let half = |word: u32| i64::from((word >> (16 * (col % 2))) as u16 as i16);
                    raw += half(block[4 + col / 2 * 2 + pair]) * half(x[col / 2]);
                    leaves |= i32::try_from(raw).is_err();
                }
                leaves
            })
        };
        self.stream[..used].chunks_exact(used / blocks).filter(|block| wraps(block)).count() as u32
    }
}

fn exponentials(random: &mut Random) -> u32 {
    let mut cases = 0;
    for frac_bits in 0..=24 {
        for len in 1..=64 {
            let (mut found, mut expected) = ([GUARD; 65], [GUARD; 65]);
            let range = [1 << 12, 1 << 20, 1 << 26, (1 << 30) - 1][len % 4];
            for word in &mut found[..len] {
                *word = random.within(range).cast_unsigned();
            }
            let top = found[..len].iter().map(|word| word.cast_signed()).max().unwrap_or(0);
            expected[..len].copy_from_slice(&found[..len]);
            kernels::exp2_below(&mut found[..len], top, frac_bits);
            portable::exp2_below(&mut expected[..len], top, frac_bits);
            assert!(found == expected, "exponential, {len} values, {frac_bits} fraction bits");
            cases += 1;
        }
    }
    cases
}

fn steps(case: &Case) {
    let policy = Policy::load(case.image).expect("a policy that the host has loaded");
    let mut memory = [0x5555_5555; 1024];
    let mut scratch = Scratch::new(&mut memory);
    policy.self_test(&mut scratch).expect("the file's own vectors");
    let mut obs = [0.0; 16];
    let obs = &mut obs[..usize::from(policy.spec().obs_dim)];
    let mut action = [0.0; 4];
    let action = &mut action[..usize::from(policy.spec().action_dim)];
    let mut digest = Digest::default();
    let mut row = 0;
    while case.observation(row, obs) {
        let decision = policy.act(obs, &mut scratch, action).expect("a finite observation");
        digest.step(&decision, action);
        row += 1;
    }
    let trusted = Policy::load_trusted(case.image).expect("a proven file");
    assert_eq!(trusted.spec(), policy.spec());
    trusted.self_test(&mut scratch).expect("the file's own vectors");
    assert_eq!(digest.value(), case.digest, "policy {}: {row} steps differ from the host's", case.name);
    hprintln!("ok: policy {}: self-test, and {} steps equal to the host's", case.name, row);
}

#[entry]
fn main() -> ! {
    // SAFETY: the only reference to the buffer, made once.
    let stream = unsafe { &mut *addr_of_mut!(WORDS) };
    let mut bench = Bench { stream, random: Random(0x1234_5678), cases: 0, wraps: 0 };
    for rows in 1..=17 {
        for cols in 1..=17 {
            bench.shape(rows, cols, -2048, 4095, 127, 100_000);
        }
    }
    hprintln!("ok: kernels: 1..=17 rows by 1..=17 columns, 12-bit inputs: {} layers", bench.cases);
    let before = bench.cases;
    for cols in 18..=300 {
        bench.shape(1 + usize::from(cols) % 9, cols, 0, 1023, 127 * 64 / i32::from(cols), 10_000);
    }
    for cols in [384, 500, 511, 512, 513, 640, 768, 769, 1000, 1023, 1024] {
        bench.shape(6, cols, 0, 255, 31, 10_000);
    }
    hprintln!("ok: kernels: every width up to 300 and to the limit of 1024 columns: {} layers", bench.cases - before);
    let before = bench.cases;
    for bits in 8..=12 {
        for cols in [3, 11, 16, 64, 130, 256] {
            bench.shape(8, cols, -(1 << (bits - 1)), (1 << bits) - 1, 127, 10_000);
            bench.shape(8, cols, 0, (1 << (bits - 2)) - 1, 127, 10_000);
        }
    }
    for rows in [128, 256, 1024] {
        bench.shape(rows, 64, 0, 255, 127, 10_000);
    }
    hprintln!("ok: kernels: inputs of 8 to 12 bits, up to 1024 rows: {} layers", bench.cases - before);
    let before = bench.wraps;
    for cols in [4, 16, 60, 200] {
        bench.shape(64, cols, 0, 255, 127, 8_000_000);
    }
    let wraps = bench.wraps - before;
    assert!(wraps >= 16, "only {wraps} raw accumulators wrapped");
    hprintln!("ok: kernels: {} blocks whose raw accumulator wraps", wraps);
    hprintln!("ok: kernels: {} lists of exponentials", exponentials(&mut bench.random));
    for case in CASES {
        steps(case);
    }
    debug::exit(debug::EXIT_SUCCESS);
    loop {}
}
