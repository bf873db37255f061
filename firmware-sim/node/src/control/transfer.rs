//! Requests of a host: pages, and a new policy.

use super::boot::load;
use super::{ControlNode, State};
use crate::link::Link;
use crate::reason::Reason;
use crate::safety::{Event, Fault};
use crate::service::{
    OP_ACTIVATE, OP_BEGIN, OP_BLOCK, OP_COMMIT, OP_CONFIRM, OP_END, OP_LENGTH, OP_READ, OP_REFUSED, Page, Reply,
    Request,
};
use crate::store::{Operation, Refusal, Store};

impl<'p, L: Link, S: Store<'p>> ControlNode<'p, L, S> {
    pub(super) fn answer(&mut self, request: Request) {
        let node = self.config.node.get();
        let Request { op, page, tag, .. } = request;
        let (reply, activated) = if op == OP_READ {
            let value = Page::from_code(page).map(|known| self.value(known));
            (value.map_or((OP_REFUSED, page, u32::from(op)), |value| (op, page, value)), false)
        } else {
            match self.transfer(request) {
                Ok(value) => ((op, page, value), op == OP_ACTIVATE),
                Err(refusal) => ((OP_REFUSED, refusal.code(), u32::from(op)), false),
            }
        };
        let (op, page, value) = reply;
        self.send(&Reply { node, op, page, tag, value }.frame());
        if activated {
            self.fire(Event::ResetRequest, Fault::None);
        }
    }

    fn transfer(&mut self, request: Request) -> Result<u32, Refusal> {
        let value = request.value;
        let operation = match request.op {
            OP_LENGTH => Operation::Length(value),
            OP_BEGIN => Operation::Begin(value, request.page == 1),
            OP_BLOCK => Operation::Block(value),
            OP_COMMIT => Operation::Commit(value),
            OP_END => Operation::End,
            OP_ACTIVATE => Operation::Activate,
            OP_CONFIRM => Operation::Confirm,
            _ => return Err(Refusal::Unknown),
        };
        let idle = matches!(self.state, State::Ready | State::NoPolicy);
        if !idle && operation != Operation::Confirm {
            return Err(Refusal::State);
        }
        let (config, scratch) = (self.config, &mut self.scratch);
        let done = self.store.operate(operation, &mut |image| {
            let (policy, _) = load(image, &config).map_err(|(_, reason)| match reason {
                Reason::Layout => Refusal::Layout,
                _ => Refusal::Load,
            })?;
            policy.self_test(scratch).map_err(|_| Refusal::SelfTest)
        });
        if done.is_ok() && operation == Operation::Confirm {
            self.trial = false;
        }
        done
    }
}
