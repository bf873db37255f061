//! The node linked into this program.

use gadm_node::{ControlNode, Link, NodeConfig, NodeStatus};

use super::Target;
use crate::SimError;

/// Polls until a target must be at rest: a boot takes three, a set one.
const POLLS: u32 = 10_000;

/// A [`ControlNode`] in this process.
#[derive(Debug)]
pub struct InProcess<'p, L: Link> {
    /// There but for the moment of a power cycle.
    node: Option<ControlNode<'p, L>>,
    status: Option<NodeStatus>,
}

impl<'p, L: Link> InProcess<'p, L> {
    /// A node with the policy in `image` (4-byte aligned) and work memory `scratch`.
    pub fn new(config: NodeConfig, link: L, image: &'p [u8], scratch: &'p mut [u32]) -> Self {
        Self { node: Some(ControlNode::new(config, link, image, scratch)), status: None }
    }
}

impl<L: Link> Target for InProcess<'_, L> {
    fn name(&self) -> &'static str {
        "in-process"
    }

    fn settle(&mut self, now_us: u64) -> Result<(), SimError> {
        for _ in 0..POLLS {
            let Some(node) = &mut self.node else { break };
            let status = node.poll(now_us);
            self.status = Some(status);
            if !status.busy {
                return Ok(());
            }
        }
        Err(SimError::Restless { target: self.name().to_owned(), now_us, polls: POLLS })
    }

    fn power_cycle(&mut self) -> Result<(), SimError> {
        self.node = self.node.take().map(ControlNode::power_cycle);
        self.status = None;
        Ok(())
    }

    fn status(&self) -> Option<NodeStatus> {
        self.status
    }
}
