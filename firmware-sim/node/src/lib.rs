//! A CAN control node that runs one GADM policy: frame codec, lockstep control loop and safety states.
//!
//! The crate has no heap, no clock, no global state and does not panic. Time is an argument of
//! [`ControlNode::poll`]; the bus is whatever implements [`Link`]. The same code is linked into the simulator
//! (`gadm-sim`) and into the firmware, so both put the same frames on the bus.
//!
//! | module | holds |
//! | --- | --- |
//! | [`frame`], [`link`] | one CAN or CAN FD frame; the boundary to a bus |
//! | [`slcan`] | frames as lines of ASCII: UARTs, USB adapters, python-can, the hub |
//! | [`protocol`] | **the** table of messages: identifiers, directions, periods, payload layouts |
//! | [`codec`], [`service`], [`assemble`] | frames to numbers and back, both profiles; parts to complete sets |
//! | [`safety`] | **the** table of states and transitions, and the fault codes |
//! | [`load`] | worst-case time on the wire, and whether a policy fits a bus |
//! | [`timing`] | period jitter and bias |
//! | [`control`] | the node itself |
//! | [`store`], [`slots`], [`transfer`] | where policies lie: one image, or two slots in flash that the bus can fill |
//! | [`reason`], [`settings`] | why an image is not run; what a board must know before it can talk |
//!
//! # Example
//!
//! A frame of the protocol, made and read:
//!
//! ```
//! use gadm_node::service::{Mode, ModeCommand};
//!
//! let frame = Mode { command: ModeCommand::Run, node: 1 }.frame();
//! assert_eq!(frame.payload(), [1, 1]);
//! assert_eq!(Mode::parse(&frame).unwrap().command, ModeCommand::Run);
//! ```
#![no_std]
#![forbid(unsafe_code)]
#![deny(
    clippy::indexing_slicing,
    clippy::expect_used,
    clippy::unwrap_used,
    clippy::panic,
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss
)]
#![cfg_attr(
    test,
    allow(
        clippy::indexing_slicing,
        clippy::expect_used,
        clippy::unwrap_used,
        clippy::panic,
        clippy::cast_possible_truncation,
        clippy::cast_possible_wrap,
        clippy::cast_precision_loss,
        clippy::cast_sign_loss,
        reason = "a test may fail loudly"
    )
)]

#[cfg(test)]
extern crate std;

pub mod assemble;
pub mod codec;
mod coded;
pub mod control;
pub mod frame;
pub mod link;
pub mod load;
mod policy;
pub mod protocol;
pub mod reason;
pub mod safety;
pub mod service;
pub mod settings;
mod shaper;
pub mod slcan;
pub mod slots;
pub mod store;
pub mod timing;
pub mod transfer;
mod watch;

pub use codec::{Flags, Layout, Profile};
pub use control::{ControlNode, Counters, NodeConfig, NodeStatus, TimeSource};
pub use frame::Frame;
pub use link::{Link, LinkError};
pub use protocol::NodeId;
pub use safety::{Event, Fault, State};
