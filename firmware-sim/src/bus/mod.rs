//! The bus in process, its trace, its load, and what can go wrong on it.

pub mod fault;
pub mod load;
pub mod loopback;
pub mod trace;
