//! The interface record: what a policy expects to see and what it drives.

use crate::space::ActionHead;

/// One observation signal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObservationSignal<'a> {
    /// Name, unique in the policy.
    pub name: &'a str,
    /// Unit, empty when the signal has none.
    pub unit: &'a str,
    /// Lower bound of the usual range, in that unit; scales integer bus profiles.
    pub lo: f32,
    /// Upper bound of the usual range, in that unit.
    pub hi: f32,
}

/// One action slot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActionSignal<'a> {
    /// Name, unique in the policy.
    pub name: &'a str,
    /// Unit, empty when the signal has none.
    pub unit: &'a str,
    /// What the slot may hold, with bounds in that unit.
    pub head: ActionHead,
    /// Value that brings the actuator to a safe state, in that unit.
    pub safe: f32,
}
