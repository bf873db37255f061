//! Where the node runs: linked in, or elsewhere, behind one trait.

mod in_process;
pub mod pace;
mod paced;
pub mod qemu;
mod remote;
mod serve;

pub use in_process::InProcess;
pub use pace::{Bin, Pace, Quantiles, Timing};
pub use paced::Paced;
pub use remote::{Expected, Remote};
pub use serve::{ServeOptions, serve};

use gadm_node::NodeStatus;

use crate::SimError;

/// A node on the bus, as the virtual-time loop sees it.
pub trait Target {
    /// Name for reports, such as `in-process`.
    fn name(&self) -> &str;

    /// Lets the node handle everything that was sent so far and put its answers on the bus. Returns when it waits for
    /// new frames. `now_us` is the virtual time, microseconds.
    ///
    /// # Errors
    /// Where the node cannot be reached or does not come to rest.
    fn settle(&mut self, now_us: u64) -> Result<(), SimError>;

    /// Takes the node's power away and gives it back: it forgets everything and boots.
    ///
    /// # Errors
    /// Where this target cannot do it.
    fn power_cycle(&mut self) -> Result<(), SimError> {
        let what = format!("target `{}` cannot be power-cycled from here; run in process", self.name());
        Err(SimError::Fault { name: "reset".to_owned(), what })
    }

    /// What the node says of itself beyond its frames; `None` where frames are all there is.
    fn status(&self) -> Option<NodeStatus>;

    /// How well real time was kept; `None` in lockstep.
    fn timing(&self) -> Option<Timing> {
        None
    }
}

impl<T: Target + ?Sized> Target for Box<T> {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn settle(&mut self, now_us: u64) -> Result<(), SimError> {
        (**self).settle(now_us)
    }

    fn power_cycle(&mut self) -> Result<(), SimError> {
        (**self).power_cycle()
    }

    fn status(&self) -> Option<NodeStatus> {
        (**self).status()
    }

    fn timing(&self) -> Option<Timing> {
        (**self).timing()
    }
}
