//! Files of the host, by semihosting: for the programs of the tests only.
//!
//! Source: Arm IHI 0060, "Semihosting for AArch32 and AArch64".

use core::arch::asm;

const SYS_OPEN: usize = 0x01;
const SYS_CLOSE: usize = 0x02;
const SYS_WRITE: usize = 0x05;
const SYS_READ: usize = 0x06;
const SYS_EXIT_EXTENDED: usize = 0x20;
const APPLICATION_EXIT: usize = 0x2_0026;

/// Makes a call whose block of arguments is `block`.
fn call(operation: usize, block: &[usize]) -> usize {
    let mut result = operation;
    // SAFETY: the semihosting call reads the block and what its pointers name, which outlive the call, and changes r0
    // and, for a read, the buffer that the caller borrowed mutably for the time.
    unsafe { asm!("bkpt 0xAB", inout("r0") result, in("r1") block.as_ptr(), options(nostack)) }
    result
}

/// A file of the host.
#[derive(Debug)]
pub struct File(usize);

impl File {
    /// Opens a file; `name` ends with a zero byte. `None` where the host refuses.
    #[must_use]
    pub fn open(name: &[u8], write: bool) -> Option<Self> {
        let length = name.len().checked_sub(1)?;
        let mode = if write { 5 } else { 1 }; // "wb", "rb"
        let handle = call(SYS_OPEN, &[name.as_ptr().expose_provenance(), mode, length]);
        (handle != usize::MAX).then_some(Self(handle))
    }

    /// Fills `bytes`; true where the file had that many.
    pub fn read(&mut self, bytes: &mut [u8]) -> bool {
        call(SYS_READ, &[self.0, bytes.as_mut_ptr().expose_provenance(), bytes.len()]) == 0
    }

    /// Writes `bytes`; true where the host took them all.
    pub fn write(&mut self, bytes: &[u8]) -> bool {
        call(SYS_WRITE, &[self.0, bytes.as_ptr().expose_provenance(), bytes.len()]) == 0
    }

    /// Closes the file.
    pub fn close(self) {
        call(SYS_CLOSE, &[self.0]);
    }
}

/// Ends the emulator with an exit status.
pub fn exit(status: usize) -> ! {
    loop {
        call(SYS_EXIT_EXTENDED, &[APPLICATION_EXIT, status]);
    }
}
