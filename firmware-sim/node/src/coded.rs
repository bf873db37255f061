//! What every enumeration that travels as a number has: all its values, the number, the name, and the way back.
//!
//! The derives of strum make the parts; here they get the same names everywhere.

/// Gives an enumeration with `#[repr(u8)]` and the derives `FromRepr`, `IntoStaticStr` and `VariantArray` its
/// number, its name and the list of its values.
macro_rules! coded {
    ($name:ident) => {
        impl $name {
            /// All values, in the order of their numbers.
            pub const ALL: &'static [Self] = <Self as strum::VariantArray>::VARIANTS;

            /// The number on the wire.
            #[must_use]
            pub const fn code(self) -> u8 {
                self as u8
            }

            /// Name in documents, databases and tools.
            #[must_use]
            pub fn name(self) -> &'static str {
                self.into()
            }

            /// The value of a number; `None` where it has no meaning here.
            #[must_use]
            pub const fn from_code(code: u8) -> Option<Self> {
                Self::from_repr(code)
            }
        }
    };
}

pub(crate) use coded;
