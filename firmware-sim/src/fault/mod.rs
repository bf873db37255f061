//! Faults: what can go wrong on the bus, in the node, at sensors and actuators and with the plant; each drawn from the
//! seed of the run, so that a faulty run is as repeatable as a clean one, and each counted: a fault test whose count is
//! zero has tested nothing.
//!
//! The list is [`CATALOGUE`]; scenarios name faults as [`Fault`] describes.

pub mod actuator;
pub mod bus;
mod catalogue;
pub mod frame;
mod inject;
mod link;
pub mod node;
pub mod plant;
pub mod sensor;
mod spec;
mod watch;

pub use catalogue::{CATALOGUE, Row};
pub use inject::{Injector, Span};
pub use link::FaultyLink;
pub use spec::{Fault, Kind, Participant, Window, explain, parse};
pub use watch::{Signs, Watch};
