//! The kernels for Armv7E-M (Cortex-M4 and M7), in assembly.
//!
//! One routine serves every dense layer. Eight columns of four rows, 32 multiply-accumulates, take 27 instructions: three
//! loads of four words, and per word of weights `SMLAD` (raw), `SXTB16` (keep the low bytes) and `SMLAD` (b). A body of
//! eight such units, 64 columns, is entered where the columns that are left need it, so any multiple of 8 columns costs
//! what it must; a stub takes 4 columns when that avoids half a unit of padding. Loops inside a block of rows cost one
//! instruction: the addresses where the body shall continue are pushed beforehand and the body ends with `pop {pc}`.
//!
//! No branch depends on data, so neither does the number of instructions.
#![expect(unsafe_code, reason = "assembly kernels; every block states why it is sound")]

use core::arch::naked_asm;

/// Units of 8 columns that one list of addresses covers.
const LIST_UNITS: usize = 32;

/// What `blocks` needs besides its pointers; the assembly reads the fields by offset.
#[repr(C)]
struct Plan {
    /// One past the last word of the outputs.
    end: *mut u32,
    /// Multipliers and offsets of a modulated layer.
    modulation: *const u8,
    /// Units of 8 columns before the first multiple of 256 from the end, 0..=32.
    units: usize,
    /// One past the last activation that counts.
    x_end: *const u32,
    /// Which way a block ends: 0 hidden of 8 bits, 1 hidden of 10 bits, 2 and 3 the same modulated, 4 linear.
    ending: usize,
    /// Units of 4 columns of padding that are skipped in the stream, 0..=3.
    skip: usize,
    /// 0, or 1 for 4 columns before the units; then `units` is below 9.
    stub: usize,
    /// Units after the first `units`; the assembly only asks whether there are any.
    more: usize,
}

impl Plan {
    fn new(cols: u16, x: &[u32], end: *mut u32, modulation: *const u8, ending: usize) -> Self {
        let quads = usize::from(cols).div_ceil(4);
        // The stub is for narrow layers; wide ones take the last 4 columns with a whole unit, whose padding is zero.
        let quads = if quads <= 2 * 8 + 1 { quads } else { quads.wrapping_add(1) & !1 };
        let units = quads / 2;
        // All lists but the first cover LIST_UNITS.
        let later = units.saturating_sub(1) & !(LIST_UNITS - 1);
        Self {
            end,
            modulation,
            units: units.wrapping_sub(later),
            x_end: x.as_ptr().wrapping_add(quads.wrapping_mul(2)),
            ending,
            skip: quads.wrapping_neg() & 3,
            stub: quads & 1,
            more: later,
        }
    }
}

/// As `dense::layer`, whose checks have passed.
pub(super) fn layer(stream: &[u8], cols: u16, bits: u32, modulation: Option<&[u8]>, x: &[u32], out: &mut [u32]) {
    let words: usize = if bits > 10 { 4 } else { 2 };
    let ends = out.as_mut_ptr_range();
    let len = out.len() & words.wrapping_neg();
    if len == 0 {
        return;
    }
    let hidden = usize::from(bits == 10).wrapping_add(if modulation.is_some() { 2 } else { 0 });
    let plan = Plan::new(
        cols,
        x,
        ends.start.wrapping_add(len),
        modulation.map_or(core::ptr::null(), <[u8]>::as_ptr),
        if bits > 10 { 4 } else { hidden },
    );
    // SAFETY: `dense.rs` checked that `stream` is aligned to 4 and holds a block of `cols` columns for every two words of
    // `out`, every four where the layer is linear; that the blocks end with their multipliers, or that `modulation`, which
    // is aligned to 4 as well, has 32 bytes for each of them; and that `x` has the words of all columns, padding included.
    // The routine reads no further and writes the words from `ends.start` to `plan.end`, which are whole blocks, at least
    // one.
    unsafe { blocks(stream.as_ptr(), x.as_ptr(), ends.start, &raw const plan) }
}

/// Two words of activations (r6, r7 or r8, r9: `$x0`, `$x1`) against the weights in r10, r11, r12, lr.
macro_rules! mac {
    ($x0:literal, $x1:literal) => {
        concat!(
            "smlad r2, r10, ",
            $x0,
            ", r2\n",
            "smlad r4, r11, ",
            $x0,
            ", r4\n",
            "sxtb16 r10, r10\n",
            "sxtb16 r11, r11\n",
            "smlad r2, r12, ",
            $x1,
            ", r2\n",
            "smlad r4, lr, ",
            $x1,
            ", r4\n",
            "smlad r3, r10, ",
            $x0,
            ", r3\n",
            "smlad r5, r11, ",
            $x0,
            ", r5\n",
            "sxtb16 r12, r12\n",
            "sxtb16 lr, lr\n",
            "smlad r3, r12, ",
            $x1,
            ", r3\n",
            "smlad r5, lr, ",
            $x1,
            ", r5\n",
        )
    };
}

/// Eight columns: 27 instructions of 4 bytes.
macro_rules! unit {
    () => {
        concat!(
            "ldmia.w r1!, {{r6-r9}}\n",
            "ldmia.w r0!, {{r10-r12, lr}}\n",
            mac!("r6", "r7"),
            "ldmia.w r0!, {{r10-r12, lr}}\n",
            mac!("r8", "r9"),
        )
    };
}

/// Skips 3, 2, 1 or 0 times 4 columns of padding: entries 2 bytes apart before the label `$label`.
macro_rules! skips {
    ($label:literal) => {
        concat!("adds r0, #16\n", "adds r0, #16\n", "adds r0, #16\n", $label, ":\n")
    };
}

/// `[raw0, b0, raw1, b1]` in r2-r5 to four `SMMLAR` results; `[M x 4] [P x 4]` in r6-r12, lr.
macro_rules! requantise {
    () => {
        "sub r2, r2, r3
         sub r4, r4, r5
         smmlar r2, r2, r6, r10
         smmlar r3, r3, r7, r11
         smmlar r4, r4, r8, r12
         smmlar r5, r5, r9, lr\n"
    };
}

/// Constants of a modulated block.
macro_rules! from_table {
    () => {
        "ldr r1, [sp, #32]
         ldmia.w r1!, {{r6-r12, lr}}
         str r1, [sp, #32]\n"
    };
}

/// Four results to two words of activations.
macro_rules! pack {
    ($bits:literal) => {
        concat!(
            "usat r2, #",
            $bits,
            ", r2, asr #4\n",
            "usat r3, #",
            $bits,
            ", r3, asr #4\n",
            "usat r4, #",
            $bits,
            ", r4, asr #4\n",
            "usat r5, #",
            $bits,
            ", r5, asr #4\n",
            "pkhbt r2, r2, r3, lsl #16\n",
            "pkhbt r3, r4, r5, lsl #16\n",
        )
    };
}

/// Stores by `$store`, and starts the next block or leaves.
macro_rules! next {
    ($store:literal) => {
        concat!(
            "ldmia.w sp, {{r1, r6-r12}}\n",
            $store,
            "\n",
            "str r1, [sp]\n",
            "cmp r1, r6\n",
            "beq 99f\n",
            "push.w {{r7-r12}}\n",
            "ldmia.w r0!, {{r2-r5}}\n",
            "pop {{r1, pc}}\n",
        )
    };
}

/// A layer: blocks of `stream` against `x`, outputs from `out` to `plan.end`.
///
/// Registers: r0 stream, r1 activations, r2-r5 sums `[raw0, b0, raw1, b1]`, r6-r9 activations or M, r10-r12 and lr
/// weights or P. Stack between two blocks, from sp: out, end, x, four addresses of the body, address of the ending,
/// modulation, address behind the last list, end of x, address of the whole body. A block pushes a copy of x and of the
/// five addresses and pops them as it goes, so that sp is here again when its ending runs. Nothing below sp is used.
///
/// # Safety
/// `stream` and `plan.modulation` aligned to 4; as many blocks as outputs need, for the columns of `plan`; `x` up to
/// `plan.x_end` readable; `out` writable up to `plan.end`, at least one block and whole blocks.
#[unsafe(naked)]
unsafe extern "C" fn blocks(stream: *const u8, x: *const u32, out: *mut u32, plan: *const Plan) {
    naked_asm!(
        // Frame and saved registers.
        "push.w {{r4-r11, lr}}",
        "sub sp, #48",
        "str r2, [sp]",
        "ldrd r4, r5, [r3]",      // end, modulation
        "ldrd r6, r12, [r3, #8]", // units, x_end
        "str r4, [sp, #4]",
        "str r1, [sp, #8]",
        "str r5, [sp, #32]",
        "str.w r12, [sp, #40]",
        // The ending: its address less 2 bytes for each 4 columns to skip.
        "ldrd r4, r5, [r3, #16]", // ending, skip
        "adr r2, 20f",
        "ldr.w r12, [r2, r4, lsl #2]",
        "add r12, r2, r12",
        "sub r12, r12, r5, lsl #1",
        "ldrd r4, r5, [r3, #24]", // stub, more
        "str.w r12, [sp, #36]",
        // Four entries of the body, r8 to r11, the last ones first.
        "movs r3, #108",
        "adr.w lr, 10f + 1",
        "sub r1, lr, #864",
        "str r1, [sp, #44]",
        "cmp r6, #8",
        "bhi 2f",
        // At most 64 columns: one entry. The stub comes before it, or a pop that drops the two others.
        "mls r11, r6, r3, lr",
        "add r8, lr, #4",
        "add r8, r8, r4, lsl #2",
        "b 3f",
        // The first entry that is used takes what is no multiple of 64.
        "2:",
        "mov r9, r1",
        "mov r10, r1",
        "mov r11, r1",
        "mov r8, r1",
        "ands r2, r6, #7",
        "it ne",
        "mlsne r8, r2, r3, lr",
        "cmp r6, #24",
        "bhi 3f",
        "cmp r6, #16",
        "itete hi",
        "movhi r9, r8",
        "movls r10, r8",
        "movhi r8, lr",
        "addls r8, lr, #2",
        "3:",
        // More columns than a list covers: the list goes on at 12.
        "cmp r5, #0",
        "beq 1f",
        "adr.w r12, 12f + 1",
        "1:",
        "ldr r7, [sp, #8]",
        "add r6, sp, #8",
        "stmia.w r6, {{r7-r12}}",
        "push.w {{r7-r12}}",
        "ldmia.w r0!, {{r2-r5}}",
        "pop {{r1, pc}}",
        // The body, 64 columns.
        ".balign 4",
        unit!(),
        unit!(),
        unit!(),
        unit!(),
        unit!(),
        unit!(),
        unit!(),
        unit!(),
        "10:",
        "pop {{pc}}",
        "pop {{r6, pc}}",
        "pop {{r6, r7, pc}}",
        "nop",
        // 4 columns, then the last entry of the list.
        "ldmia.w r1!, {{r6, r7}}",
        "ldmia.w r0!, {{r10-r12, lr}}",
        mac!("r6", "r7"),
        "pop {{r6, r7, pc}}",
        // A list is done and columns are left, or not.
        "12:",
        "ldr r6, [sp, #40]",
        "cmp r1, r6",
        "it eq",
        "ldreq pc, [sp, #36]",
        "adr.w r12, 12b + 1",
        "ldr r8, [sp, #44]",
        "mov r9, r8",
        "mov r10, r8",
        "mov r11, r8",
        "push.w {{r8-r12}}",
        "pop {{pc}}",
        // Endings.
        ".balign 4",
        "20:",
        ".word 21f - 20b + 1",
        ".word 22f - 20b + 1",
        ".word 23f - 20b + 1",
        ".word 24f - 20b + 1",
        ".word 25f - 20b + 1",
        skips!("21"),
        "ldmia.w r0!, {{r6-r12, lr}}",
        requantise!(),
        pack!("8"),
        next!("strd r2, r3, [r1], #8"),
        skips!("22"),
        "ldmia.w r0!, {{r6-r12, lr}}",
        requantise!(),
        pack!("10"),
        next!("strd r2, r3, [r1], #8"),
        skips!("23"),
        from_table!(),
        requantise!(),
        pack!("8"),
        next!("strd r2, r3, [r1], #8"),
        skips!("24"),
        from_table!(),
        requantise!(),
        pack!("10"),
        next!("strd r2, r3, [r1], #8"),
        skips!("25"),
        "ldmia.w r0!, {{r6-r12, lr}}",
        requantise!(),
        next!("stmia.w r1!, {{r2-r5}}"),
        "99:",
        "add sp, #48",
        "pop.w {{r4-r11, pc}}",
    )
}

/// Replaces logits (`i32` as words) by `2^-(top - logit)` as Q30; see [`exp2_neg`](super::exp2_neg).
pub fn exp2_below(logits: &mut [u32], top: i32, frac_bits: u32) {
    // A product with 2^(32 - F) splits a number into whole part and fraction; there is no such factor for F = 0.
    let factor = 1u32.wrapping_shl(32u32.wrapping_sub(frac_bits));
    if frac_bits == 0 {
        super::exp2::whole(logits, top);
        return;
    }
    let (pairs, last) = logits.as_chunks_mut::<2>();
    if !pairs.is_empty() {
        let ends = pairs.as_flattened_mut().as_mut_ptr_range();
        // SAFETY: the routine reads and writes the words of the slice, which are at least two and even in number.
        unsafe { exp2_words(ends.start, ends.end, top, factor) }
    }
    if let [last] = last {
        let mut pair = [*last; 2];
        let ends = pair.as_mut_ptr_range();
        // SAFETY: as above, two words.
        unsafe { exp2_words(ends.start, ends.end, top, factor) }
        [*last, _] = pair;
    }
}

/// The exponential of the word at `$at` behind r0, written in its place.
macro_rules! exp2 {
    ($at:literal) => {
        concat!(
            "ldr r4, [r0, #",
            $at,
            "]\n",
            "sub r4, r2, r4\n",
            "umull r4, r11, r4, r3\n",
            "lsrs r4, r4, #1\n",
            "usat r11, #5, r11\n",
            "smmlar r12, r5, r4, r6\n",
            "smmlar r12, r12, r4, r7\n",
            "smmlar r12, r12, r4, r8\n",
            "smmlar r12, r12, r4, r9\n",
            "smmlar r12, r12, r4, r10\n",
            "lsr r12, r12, r11\n",
            "str r12, [r0, #",
            $at,
            "]\n",
        )
    };
}

/// The words from `word` to `end`: the fraction (r4, Q31) goes into the polynomial, the whole part (r11), at most 31,
/// shifts the result.
///
/// # Safety
/// The words must be readable and writable, at least two and even in number.
#[unsafe(naked)]
unsafe extern "C" fn exp2_words(word: *mut u32, end: *mut u32, top: i32, factor: u32) {
    naked_asm!(
        "push.w {{r4-r11, lr}}",
        "adr r5, 2f",
        "ldmia.w r5, {{r5-r10}}",
        "1:",
        exp2!("0"),
        exp2!("4"),
        "adds r0, #8",
        "cmp r0, r1",
        "bne 1b",
        "pop.w {{r4-r11, pc}}",
        ".balign 4",
        "2:",
        ".word {c5}, {c4}, {c3}, {c2}, {c1}, {c0}",
        c0 = const super::exp2::C[0],
        c1 = const super::exp2::C[1],
        c2 = const super::exp2::C[2],
        c3 = const super::exp2::C[3],
        c4 = const super::exp2::C[4],
        c5 = const super::exp2::C[5],
    )
}
