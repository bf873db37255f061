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

/// As `dense::layer`, whose checks have passed.
#[inline(always)]
pub(super) fn layer(stream: &[u8], cols: u16, bits: u32, modulation: Option<&[u8]>, x: &[u32], out: &mut [u32]) {
    let words: usize = if bits > 10 { 4 } else { 2 };
    let start = out.as_mut_ptr();
    let len = out.len() & words.wrapping_neg();
    if len == 0 {
        return;
    }
    // Which way a block ends: 0 hidden of 8 bits, 1 hidden of 10 bits, 2 and 3 the same modulated, 4 linear.
    let hidden = usize::from(bits == 10).wrapping_add(if modulation.is_some() { 2 } else { 0 });
    let ending = if bits > 10 { 4 } else { hidden };
    let table = modulation.map_or(core::ptr::null(), <[u8]>::as_ptr);
    let end = start.wrapping_add(len);
    // SAFETY: `dense.rs` checked that `stream` is aligned to 4 and holds a block of `cols` columns, at least one, for every
    // two words of `out`, every four where the layer is linear; that the blocks end with their multipliers, or that
    // `modulation`, which is aligned to 4 as well, has 32 bytes for each of them; and that `x` has the words of all columns,
    // padding included. The routine reads no further and writes the words from `start` to `end`, which are whole blocks, at
    // least one.
    unsafe { blocks(stream.as_ptr(), x.as_ptr(), start, end, table, cols.into(), ending) }
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

/// A layer: blocks of `stream` against `x`, outputs from `out` to `end`.
///
/// A list of four addresses covers 32 units of 8 columns: `units` are those before the first multiple of 256 from the end,
/// `more` those after. Narrow layers take 4 columns of their own (`stub`) where that avoids half a unit of padding; wide ones
/// take them with a whole unit, whose padding is zero. `skip` is the padding behind that, in 4 columns.
///
/// Registers: r0 stream, r1 activations, r2-r5 sums `[raw0, b0, raw1, b1]`, r6-r9 activations or M, r10-r12 and lr
/// weights or P. Stack between two blocks, from sp: out, end, x, four addresses of the body, address of the ending,
/// modulation, address behind the last list, end of x, address of the whole body. A block pushes a copy of x and of the
/// five addresses and pops them as it goes, so that sp is here again when its ending runs. Nothing below sp is used.
///
/// # Safety
/// `stream` and `modulation` aligned to 4; as many blocks as outputs need, for `cols` columns, 1 to 65535; `x` readable for
/// the columns rounded up to 16; `out` writable up to `end`, at least one block and whole blocks; `ending` below 5.
#[unsafe(naked)]
unsafe extern "C" fn blocks(
    stream: *const u8,
    x: *const u32,
    out: *mut u32,
    end: *mut u32,
    modulation: *const u8,
    cols: usize,
    ending: usize,
) {
    naked_asm!(
        // Frame and saved registers; the last three arguments lie above them.
        "push.w {{r4-r11, lr}}",
        "sub sp, #48",
        "stmia.w sp, {{r2, r3}}",
        "str r1, [sp, #8]",
        "ldr r2, [sp, #84]", // modulation
        "ldr r4, [sp, #88]", // cols
        "ldr r7, [sp, #92]", // ending
        "str r2, [sp, #32]",
        // 4 columns each (r4), in pairs where they are more than 17.
        "adds r4, #3",
        "lsrs r4, r4, #2",
        "cmp r4, #17",
        "itt hi",
        "addhi r4, #1",
        "bichi r4, r4, #1",
        "add.w r12, r1, r4, lsl #3",
        "str.w r12, [sp, #40]", // end of x
        // Units (r6) and more (r5).
        "lsrs r6, r4, #1",
        "subs r5, r6, #1",
        "it mi",
        "movmi r5, #0",
        "bic r5, r5, #31",
        "subs r6, r6, r5",
        // The ending: its address less 2 bytes for each 4 columns to skip.
        "rsbs r3, r4, #0",
        "and r3, r3, #3",
        "and r4, r4, #1", // stub
        "adr r2, 20f",
        "ldr.w r12, [r2, r7, lsl #2]",
        "add r12, r2, r12",
        "sub r12, r12, r3, lsl #1",
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
        skips!("23"),
        from_table!(),
        "b 31f",
        skips!("21"),
        "ldmia.w r0!, {{r6-r12, lr}}",
        "31:",
        requantise!(),
        pack!("8"),
        "b 33f",
        skips!("24"),
        from_table!(),
        "b 32f",
        skips!("22"),
        "ldmia.w r0!, {{r6-r12, lr}}",
        "32:",
        requantise!(),
        pack!("10"),
        "33:",
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
    // SAFETY: the routine reads and writes the words of the slice.
    unsafe { exp2_words(logits.as_mut_ptr(), logits.len(), top, frac_bits) }
}

/// `len` words from `word` on. A product of twice the difference with `2^(31 - F)` splits it into the whole part (r11) and
/// the fraction (r4, then Q31); the fraction goes into the polynomial, the whole part, at most 31, shifts the result.
///
/// # Safety
/// The words must be readable and writable.
#[unsafe(naked)]
unsafe extern "C" fn exp2_words(word: *mut u32, len: usize, top: i32, frac_bits: u32) {
    naked_asm!(
        "push.w {{r4-r11, lr}}",
        "add.w r1, r0, r1, lsl #2",
        "lsls r2, r2, #1",
        "rsb r3, r3, #31",
        "movs r4, #1",
        "lsl.w r3, r4, r3",
        "adr r5, 2f",
        "ldmia.w r5, {{r5-r10}}",
        "1:",
        "cmp r0, r1",
        "it eq",
        "popeq.w {{r4-r11, pc}}",
        "ldr r4, [r0]",
        "sub r4, r2, r4, lsl #1",
        "umull r4, r11, r4, r3",
        "lsrs r4, r4, #1",
        "usat r11, #5, r11",
        "smmlar r12, r5, r4, r6",
        "smmlar r12, r12, r4, r7",
        "smmlar r12, r12, r4, r8",
        "smmlar r12, r12, r4, r9",
        "smmlar r12, r12, r4, r10",
        "lsr r12, r12, r11",
        "str r12, [r0], #4",
        "b 1b",
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
