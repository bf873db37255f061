//! A target in this process, in real time.

use gadm_node::NodeStatus;

use super::Target;
use super::pace::{Pace, Timing};
use crate::SimError;

/// Holds a target back to the time of the wall.
#[derive(Debug)]
pub struct Paced<T> {
    inner: T,
    pace: Pace,
    last_us: Option<u64>,
}

impl<T: Target> Paced<T> {
    /// `inner`, with the periods of `pace`.
    pub fn new(inner: T, pace: Pace) -> Self {
        Self { inner, pace, last_us: None }
    }
}

impl<T: Target> Target for Paced<T> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn settle(&mut self, now_us: u64) -> Result<(), SimError> {
        // The first of several at the same time is what begins the period; the set comes with the last.
        if self.last_us != Some(now_us) {
            self.last_us = Some(now_us);
            self.pace.begin(now_us);
            self.inner.settle(now_us)?;
            self.pace.answered(true);
            return Ok(());
        }
        self.inner.settle(now_us)
    }

    fn power_cycle(&mut self) -> Result<(), SimError> {
        self.inner.power_cycle()
    }

    fn status(&self) -> Option<NodeStatus> {
        self.inner.status()
    }

    fn timing(&self) -> Option<Timing> {
        Some(self.pace.timing())
    }
}
