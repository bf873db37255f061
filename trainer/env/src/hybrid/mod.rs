//! Tasks whose actions mix a discrete choice with continuous parameters.

pub(crate) mod field;
pub(crate) mod hard_move;
pub(crate) mod moving;
