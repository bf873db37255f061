//! Pointers of the caller: what can be checked before they become references.

use crate::Status;

/// Memory of `len` values of `T`, checked for null, alignment and length.
pub(crate) struct Extent<T> {
    start: *mut T,
    len: usize,
}

impl<T> Clone for Extent<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Extent<T> {}

impl<T> Extent<T> {
    /// Checks a pointer; with `len` 0 it may be null.
    pub(crate) fn new(start: *const T, len: usize) -> Result<Self, Status> {
        let start = start.cast_mut();
        if len == 0 {
            return Ok(Self { start: core::ptr::NonNull::dangling().as_ptr(), len });
        }
        if start.is_null() {
            return Err(Status::NullPointer);
        }
        if !start.is_aligned() {
            return Err(Status::MisalignedPointer);
        }
        let bytes = len.checked_mul(size_of::<T>()).filter(|bytes| *bytes <= isize::MAX.unsigned_abs());
        let end = bytes.and_then(|bytes| start.addr().checked_add(bytes));
        if end.is_none() { Err(Status::BadLength) } else { Ok(Self { start, len }) }
    }

    /// One value behind a pointer.
    pub(crate) fn one(start: *const T) -> Result<Self, Status> {
        Self::new(start, 1)
    }

    /// First address and first address behind; equal when empty.
    pub(crate) fn span(self) -> (usize, usize) {
        let start = self.start.addr();
        // `new` checked that neither wraps.
        (start, start.wrapping_add(self.len.wrapping_mul(size_of::<T>())))
    }

    /// The values.
    ///
    /// # Safety
    /// The memory holds initialised values and is not written while the reference lives.
    pub(crate) unsafe fn as_slice<'a>(self) -> &'a [T] {
        // SAFETY: `new` checked null, alignment and length; the rest is the caller's.
        unsafe { core::slice::from_raw_parts(self.start, self.len) }
    }

    /// The values, to be changed.
    ///
    /// # Safety
    /// The memory holds initialised values and nothing else reads or writes it while the reference lives.
    pub(crate) unsafe fn as_mut_slice<'a>(self) -> &'a mut [T] {
        // SAFETY: as above.
        unsafe { core::slice::from_raw_parts_mut(self.start, self.len) }
    }

    /// The pointer.
    pub(crate) fn pointer(self) -> *mut T {
        self.start
    }
}

/// No byte is written twice, and none is both written and read.
pub(crate) fn disjoint(written: &[(usize, usize)], read: &[(usize, usize)]) -> Result<(), Status> {
    let meet = |a: &(usize, usize), b: &(usize, usize)| a.0 < a.1 && b.0 < b.1 && a.0 < b.1 && b.0 < a.1;
    let mut rest = written.iter();
    while let Some(one) = rest.next() {
        if rest.as_slice().iter().chain(read).any(|other| meet(one, other)) {
            return Err(Status::OverlappingMemory);
        }
    }
    Ok(())
}
