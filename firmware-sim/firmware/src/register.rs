//! Volatile access to device registers.

/// A 32-bit register at a fixed address.
#[derive(Clone, Copy, Debug)]
pub struct Register(usize);

impl Register {
    /// The register at `address`.
    ///
    /// # Safety
    /// `address` is that of a device register of 32 bits which may be read and written at any time without effect on
    /// memory that the program uses.
    #[must_use]
    pub const unsafe fn new(address: usize) -> Self {
        Self(address)
    }

    /// Reads it.
    #[must_use]
    pub fn read(self) -> u32 {
        // SAFETY: a device register, by the contract of `new`.
        unsafe { core::ptr::with_exposed_provenance::<u32>(self.0).read_volatile() }
    }

    /// Writes it.
    pub fn write(self, value: u32) {
        // SAFETY: a device register, by the contract of `new`.
        unsafe { core::ptr::with_exposed_provenance_mut::<u32>(self.0).write_volatile(value) }
    }

    /// Sets the bits of `mask`.
    pub fn set(self, mask: u32) {
        self.write(self.read() | mask);
    }
}

/// Names registers by their addresses. The word `unsafe` in front of the list stands for the contract of
/// [`Register::new`], which the caller states in a comment.
macro_rules! registers {
    (unsafe $($name:ident = $address:literal;)*) => {
        $(
            // SAFETY: the caller's, stated where the list is.
            const $name: $crate::register::Register = unsafe { $crate::register::Register::new($address) };
        )*
    };
}
pub(crate) use registers;
