//! Use of the stack, measured by painting what lies below it.

const PAINT: u32 = 0xA5C3_5A3C;
/// Words painted: 32 KiB.
const WORDS: usize = 8192;

/// Bytes of stack that `work` used, from the caller of this function down.
#[inline(never)]
pub fn bytes_used(work: impl FnOnce()) -> usize {
    let top = cortex_m::register::msp::read() as usize & !3;
    // The frame of this function may still be pushed below; the few words of `paint` itself are written again.
    let bottom = (top - WORDS * 4) as *mut u32;
    paint(bottom, WORDS - 32);
    work();
    let untouched = clean(bottom, WORDS - 32);
    (WORDS - untouched) * 4
}

#[inline(never)]
fn paint(bottom: *mut u32, words: usize) {
    for index in 0..words {
        // SAFETY: 4 MiB of RAM belong to the stack, which is nearly empty; interrupts are off.
        unsafe { bottom.add(index).write_volatile(PAINT) }
    }
}

#[inline(never)]
fn clean(bottom: *mut u32, words: usize) -> usize {
    // SAFETY: as in `paint`.
    (0..words).take_while(|&index| unsafe { bottom.add(index).read_volatile() } == PAINT).count()
}
