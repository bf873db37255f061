//! Brings a new policy to a node over its bus: transfer, trial, confirmation. What was cut off goes on where it was.

use std::time::Duration;

use gadm_node::protocol::NodeId;
use gadm_node::reason::Reason;
use gadm_node::service::{
    OP_ACTIVATE, OP_BEGIN, OP_BLOCK, OP_COMMIT, OP_CONFIRM, OP_END, OP_LENGTH, OP_READ, OP_REFUSED, Page, Reply,
    Request, TransferData,
};
use gadm_node::store::Refusal;
use gadm_node::transfer::{BLOCK, checksum, image_checksum};
use gadm_node::{Frame, LinkError};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;

use crate::SimError;
use crate::bus::Bus;
use crate::bus::stream::{deadline, left};

/// How long a node may take for an answer. Erasing a slot takes the longest.
const PATIENCE: Duration = Duration::from_secs(20);

/// How often a block is sent that comes damaged, or to a node that lost its thread.
const ATTEMPTS: u32 = 3;

/// How to bring a policy to a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InstallOptions {
    /// The node.
    pub node: NodeId,
    /// The bytes travel in CAN FD frames, else in classic ones.
    pub fd: bool,
    /// Forget what an earlier transfer left.
    pub anew: bool,
    /// Boot the policy and confirm it; else it is only staged.
    pub activate: bool,
}

/// What was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Installed {
    /// The slot.
    pub slot: u8,
    /// Bytes of the image that were there already.
    pub resumed_at: u32,
    /// Bytes of the image.
    pub bytes: u32,
}

/// Brings the policy in `image` to a node that is READY or has no policy. `progress` gets the bytes that are there.
///
/// # Errors
/// [`SimError::Policy`] where the image is none, [`SimError::Remote`] where the node refuses or does not answer.
pub fn install(
    bus: &mut dyn Bus,
    name: &str,
    options: InstallOptions,
    image: &[u8],
    progress: &mut dyn FnMut(u32),
) -> Result<Installed, SimError> {
    let crc = {
        let aligned = AlignedImage::new(image);
        Policy::load(&aligned).map_err(SimError::Policy)?.header().payload_crc32
    };
    let mut talk = Talk { bus, name, node: options.node, tag: std::process::id() as u16 };
    let bytes = image.len() as u32;
    let begin = |talk: &mut Talk, anew: bool| {
        talk.ask(OP_LENGTH, 0, bytes)?;
        talk.ask(OP_BEGIN, u8::from(anew), image_checksum(image))
    };
    let resumed_at = begin(&mut talk, options.anew)?;
    let mut offset = resumed_at;
    let mut attempts = ATTEMPTS;
    progress(offset);
    while offset < bytes {
        let rest = image.get(offset as usize..).unwrap_or(&[]);
        let block = rest.get(..BLOCK).unwrap_or(rest);
        match talk.block(offset, block, options.fd)? {
            Ok(next) => (offset, attempts) = (next, ATTEMPTS),
            Err((_, Refusal::BlockCrc)) if attempts > 1 => attempts -= 1,
            // Its watchdog restarted it, say. What was written is there still.
            Err((_, Refusal::Order)) if attempts > 1 => (offset, attempts) = (begin(&mut talk, false)?, attempts - 1),
            Err((op, refusal)) => return Err(talk.refused(op, refusal)),
        }
        progress(offset);
    }
    let slot = talk.ask(OP_END, 0, 0)?;
    if options.activate {
        talk.ask(OP_ACTIVATE, 0, 0)?;
        if talk.ask(OP_READ, Page::PolicyCrc.code(), 0)? != crc {
            let [reason, ..] = talk.ask(OP_READ, Page::PolicyError.code(), 0)?.to_le_bytes();
            let meaning = Reason::from_code(reason).map_or("the node does not say why", Reason::meaning);
            return Err(talk.failed(format!("the node went back to the policy before: {meaning}")));
        }
        talk.ask(OP_CONFIRM, 0, 0)?;
    }
    Ok(Installed { slot: slot as u8, resumed_at, bytes })
}

struct Talk<'b> {
    bus: &'b mut dyn Bus,
    name: &'b str,
    node: NodeId,
    tag: u16,
}

impl Talk<'_> {
    fn failed(&self, what: String) -> SimError {
        SimError::Remote { bus: self.name.to_owned(), what }
    }

    fn refused(&self, op: u8, refusal: Refusal) -> SimError {
        let operation = match op {
            OP_LENGTH => "LENGTH",
            OP_BEGIN => "BEGIN",
            OP_BLOCK => "BLOCK",
            OP_COMMIT => "COMMIT",
            OP_END => "END",
            OP_ACTIVATE => "ACTIVATE",
            OP_CONFIRM => "CONFIRM",
            _ => "a request",
        };
        self.failed(format!("node {} refused {operation}: {}", self.node.get(), refusal.meaning()))
    }

    fn send(&mut self, frame: &Frame) -> Result<(), SimError> {
        self.bus.send(frame).map_err(|e| self.failed(e.to_string()))
    }

    /// Sends a block. The offset of the next one, or which operation was refused and why.
    fn block(&mut self, offset: u32, block: &[u8], fd: bool) -> Result<Result<u32, (u8, Refusal)>, SimError> {
        if let Err(refusal) = self.request(OP_BLOCK, 0, offset)? {
            return Ok(Err((OP_BLOCK, refusal)));
        }
        let mut sent = 0;
        let mut index: u8 = 0;
        while sent < block.len() {
            let data = TransferData::new(self.node.get(), index, &block[sent..], fd);
            self.send(&data.frame())?;
            sent += data.len();
            index = index.wrapping_add(1);
        }
        Ok(self.request(OP_COMMIT, 0, checksum(block))?.map_err(|refusal| (OP_COMMIT, refusal)))
    }

    fn ask(&mut self, op: u8, page: u8, value: u32) -> Result<u32, SimError> {
        self.request(op, page, value)?.map_err(|refusal| self.refused(op, refusal))
    }

    fn request(&mut self, op: u8, page: u8, value: u32) -> Result<Result<u32, Refusal>, SimError> {
        self.tag = self.tag.wrapping_add(1);
        let tag = self.tag;
        self.send(&Request { node: self.node.get(), op, page, tag, value }.frame())?;
        self.bus.flush().map_err(|e| self.failed(e.to_string()))?;
        let end = deadline(PATIENCE);
        let mut frame = Frame::empty();
        loop {
            match self.bus.receive(&mut frame) {
                Ok(false) => {
                    let time = left(end).ok_or_else(|| {
                        self.failed(format!(
                            "node {} does not answer; when it is back, the same command goes on where it was",
                            self.node.get()
                        ))
                    })?;
                    self.bus.wait(time).map_err(|e| self.failed(e.to_string()))?;
                }
                Ok(true) => {
                    let reply = Reply::parse(&frame).filter(|r| r.node == self.node.get() && r.tag == tag);
                    match reply {
                        Some(Reply { op: OP_REFUSED, page, .. }) => {
                            return Ok(Err(Refusal::from_code(page).unwrap_or(Refusal::Unknown)));
                        }
                        Some(reply) => return Ok(Ok(reply.value)),
                        None => {}
                    }
                }
                Err(LinkError::BusOff) => {}
                Err(error) => return Err(self.failed(error.to_string())),
            }
        }
    }
}
