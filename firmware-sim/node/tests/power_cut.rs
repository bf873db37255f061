//! Policies that come over the bus: whatever happens to the power, a confirmed policy that passes its own vectors runs.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

mod support;

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;

use gadm_node::service::{
    Mode, ModeCommand, OP_ACTIVATE, OP_BEGIN, OP_BLOCK, OP_COMMIT, OP_CONFIRM, OP_END, OP_LENGTH, OP_READ, OP_REFUSED,
    Page, Reply, Request, TransferData,
};
use gadm_node::slots::{Flash, FlashError, MARKS_LEN, SlotState, Slots, TRIAL_US};
use gadm_node::store::Refusal;
use gadm_node::transfer::{BLOCK, image_checksum};
use gadm_node::{ControlNode, Fault, NodeConfig, NodeStatus, State, TimeSource};
use gadm_runtime::Policy;
use support::{T, TestLink, Wire, leak, policy_version};

const SECTOR: usize = 2048;
const SECTORS: usize = 2;
const SLOT: usize = SECTOR * SECTORS;
/// Words of a mark's unit behind the two that matter; they stay erased.
const REST_OF_A_MARK: usize = 6;

/// Flash that forgets nothing but its power: erasing sets the bits of a sector, programming only clears bits, and when the
/// power goes the word (or sector) being written keeps some of its old bits and some of its new ones.
struct Cells {
    slots: [Vec<u8>; 2],
    /// Words and sectors that are still written before the power goes.
    left: Option<usize>,
    dead: bool,
    written: usize,
    chance: u64,
    known: HashMap<Vec<u8>, &'static [u8]>,
}

impl Cells {
    /// True where the power holds for one more; else this one is torn.
    fn spend(&mut self) -> bool {
        match &mut self.left {
            Some(0) => {
                self.dead = true;
                false
            }
            left => {
                *left = left.map(|n| n - 1);
                self.written += 1;
                true
            }
        }
    }

    fn random(&mut self) -> u8 {
        self.chance ^= self.chance << 13;
        self.chance ^= self.chance >> 7;
        self.chance ^= self.chance << 17;
        self.chance.to_le_bytes()[3]
    }
}

#[derive(Clone)]
struct Model(Rc<RefCell<Cells>>);

impl Model {
    /// A policy in slot 0 as a flashing tool leaves it, slot 1 erased.
    fn flashed(policy: &[u8]) -> Self {
        let mut first = policy.to_vec();
        first.resize(SLOT, 0xFF);
        Self::with([first, vec![0xFF; SLOT]])
    }

    fn with(slots: [Vec<u8>; 2]) -> Self {
        let cells = Cells { slots, left: None, dead: false, written: 0, chance: 0x9E37_79B9, known: HashMap::new() };
        Self(Rc::new(RefCell::new(cells)))
    }

    fn copy(&self) -> [Vec<u8>; 2] {
        self.0.borrow().slots.clone()
    }

    fn cut_after(&self, words: usize) {
        self.0.borrow_mut().left = Some(words);
    }

    fn written(&self) -> usize {
        self.0.borrow().written
    }

    fn power_on(&self) {
        let mut cells = self.0.borrow_mut();
        (cells.left, cells.dead, cells.written) = (None, false, 0);
    }
}

impl Flash<'static> for Model {
    fn slot_len(&self) -> usize {
        SLOT
    }

    fn sectors(&self) -> usize {
        SECTORS
    }

    fn image(&self, slot: usize) -> &'static [u8] {
        let cells = &mut *self.0.borrow_mut();
        let bytes = &cells.slots[slot];
        if !cells.known.contains_key(bytes) {
            cells.known.insert(bytes.clone(), leak(bytes));
        }
        cells.known[bytes]
    }

    fn program(&mut self, slot: usize, offset: usize, bytes: &[u8]) -> Result<(), FlashError> {
        let cells = &mut *self.0.borrow_mut();
        assert!(offset.is_multiple_of(32) && bytes.len().is_multiple_of(32), "whole units");
        for (i, word) in bytes.chunks(4).enumerate() {
            if cells.dead {
                return Err(FlashError);
            }
            let whole = cells.spend();
            for (j, &byte) in word.iter().enumerate() {
                let kept = if whole { 0 } else { cells.random() };
                cells.slots[slot][offset + 4 * i + j] &= byte | kept;
            }
        }
        if cells.dead { Err(FlashError) } else { Ok(()) }
    }

    fn erase(&mut self, slot: usize, sector: usize) -> Result<(), FlashError> {
        let cells = &mut *self.0.borrow_mut();
        if cells.dead {
            return Err(FlashError);
        }
        let whole = cells.spend();
        for at in sector * SECTOR..(sector + 1) * SECTOR {
            cells.slots[slot][at] |= if whole { 0xFF } else { cells.random() };
        }
        if whole { Ok(()) } else { Err(FlashError) }
    }
}

/// A board: a node with two slots.
struct Board {
    node: ControlNode<'static, TestLink, Slots<Model>>,
    wire: Rc<RefCell<Wire>>,
    flash: Model,
    status: NodeStatus,
    now_us: u64,
    fd: bool,
}

impl Board {
    fn power_on(flash: &Model) -> Self {
        flash.power_on();
        let link = TestLink::default();
        let wire = Rc::clone(&link.0);
        let config = NodeConfig { time: TimeSource::Local, ..NodeConfig::default() };
        let scratch = Box::leak(vec![0; 512].into_boxed_slice());
        let mut node = ControlNode::with_store(config, link, Slots::new(flash.clone()), scratch);
        let status = node.poll(0);
        let mut board = Self { node, wire, flash: flash.clone(), status, now_us: 0, fd: true };
        board.settle();
        board
    }

    fn settle(&mut self) {
        for _ in 0..50 {
            self.status = self.node.poll(self.now_us);
            if !self.status.busy {
                return;
            }
        }
        panic!("the node does not come to rest: {:?}", self.status);
    }

    /// The reply to a request; `None` where the power is gone.
    fn ask(&mut self, op: u8, page: u8, value: u32) -> Option<Reply> {
        if self.flash.0.borrow().dead {
            return None;
        }
        self.wire.borrow_mut().tx.clear();
        self.wire.borrow_mut().rx.push_back(Request { node: 1, op, page, tag: 7, value }.frame());
        self.settle();
        let replies: Vec<_> = self.wire.borrow().tx.iter().filter_map(Reply::parse).collect();
        assert_eq!(replies.len(), 1);
        if self.flash.0.borrow().dead { None } else { Some(replies[0]) }
    }

    fn page(&mut self, page: Page) -> u32 {
        self.ask(OP_READ, page.code(), 0).unwrap().value
    }

    /// The answer's value, or why it was refused.
    fn do_(&mut self, op: u8, value: u32) -> Option<Result<u32, Refusal>> {
        let reply = self.ask(op, 0, value)?;
        Some(if reply.op == OP_REFUSED { Err(Refusal::from_code(reply.page).unwrap()) } else { Ok(reply.value) })
    }

    fn send_block(&mut self, image: &[u8], offset: u32) -> Option<Result<u32, Refusal>> {
        assert_eq!(self.do_(OP_BLOCK, offset)?, Ok(offset));
        let rest = &image[offset as usize..];
        let block = &rest[..rest.len().min(BLOCK)];
        let mut sent = 0;
        for index in 0.. {
            let data = TransferData::new(1, index, &block[sent..], self.fd);
            self.wire.borrow_mut().rx.push_back(data.frame());
            sent += data.len();
            if sent == block.len() {
                break;
            }
        }
        self.do_(OP_COMMIT, crc(block))
    }

    /// LENGTH to END. Returns the offset at which it went on; `None` where the power went.
    fn transfer(&mut self, image: &[u8]) -> Option<Result<u32, Refusal>> {
        let len = image.len() as u32;
        let begin = match self.do_(OP_LENGTH, len)? {
            Ok(_) => self.do_(OP_BEGIN, image_checksum(image))?,
            refused => refused,
        };
        let from = match begin {
            Ok(from) => from,
            refused => return Some(refused),
        };
        let mut offset = from;
        while offset < len {
            offset = self.send_block(image, offset)?.unwrap();
        }
        Some(self.do_(OP_END, 0)?.map(|_| from))
    }

    fn install(&mut self, image: &[u8]) -> Option<u32> {
        let from = self.transfer(image)?.unwrap();
        self.do_(OP_ACTIVATE, 0)?.unwrap();
        assert_eq!((self.status.state, self.page(Page::PolicyCrc)), (State::Ready, payload_crc(image)), "on trial");
        self.do_(OP_CONFIRM, 0)?.unwrap();
        Some(from)
    }

    fn states(&mut self) -> [SlotState; 2] {
        let [a, b, ..] = self.page(Page::Slots).to_le_bytes();
        [a, b].map(|code| SlotState::from_code(code).unwrap())
    }

    fn slot(&mut self) -> usize {
        self.page(Page::Slot) as usize
    }
}

fn crc(bytes: &[u8]) -> u32 {
    crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(bytes)
}

fn payload_crc(image: &[u8]) -> u32 {
    Policy::load(leak(image)).unwrap().header().payload_crc32
}

fn version(n: u32) -> Vec<u8> {
    policy_version(T as u32, n, 1.0 - n as f32 * 0.125)
}

/// A policy that was refused as too old is exported again with a higher sequence number, and nothing else changes.
#[test]
fn images_that_differ_in_the_header_only_are_not_taken_for_each_other() {
    let with_sequence = |n| policy_version(T as u32, n, 0.25);
    let flash = Model::flashed(&with_sequence(5));
    let mut board = Board::power_on(&flash);
    assert_eq!(crc(&with_sequence(4)), crc(&with_sequence(6)), "the header's own CRC hides what is before it");
    assert_eq!(board.transfer(&with_sequence(4)).unwrap(), Err(Refusal::Older));
    assert_eq!(board.transfer(&with_sequence(6)).unwrap(), Ok(0), "from its beginning");
}

/// Cuts the power after every written word of an installation of `new` on `slots`, where `old` runs.
fn cut_everywhere(slots: &[Vec<u8>; 2], old: &[u8], new: &[u8]) {
    let whole = Model::with(slots.clone());
    Board::power_on(&whole).install(new).unwrap();
    let words = whole.written();
    assert!(words > new.len() / 4, "every word of the image, and the marks");
    let (mut resumed, mut old_ran, mut new_ran) = (0, 0, 0);
    for cut in 0..=words {
        let flash = Model::with(slots.clone());
        flash.0.borrow_mut().chance += cut as u64;
        let mut board = Board::power_on(&flash);
        flash.cut_after(cut);
        let done = board.install(new).is_some();
        assert_eq!(done, cut == words, "cut {cut} of {words}");

        let mut board = Board::power_on(&flash);
        assert_eq!(board.status.state, State::Ready, "cut {cut} of {words}");
        // A policy whose erasure was cut off may be reported as one that should have run.
        assert!(matches!(board.status.fault, Fault::None | Fault::SlotFallback), "cut {cut}: {:?}", board.status.fault);
        let (slot, runs) = (board.slot(), board.page(Page::PolicyCrc));
        let state = board.states()[slot];
        assert!(matches!(state, SlotState::Confirmed | SlotState::Flashed), "cut {cut}: {state:?} runs");
        if runs == payload_crc(new) {
            assert_eq!(state, SlotState::Confirmed);
            assert!(cut >= words - REST_OF_A_MARK, "only the last mark makes the new policy boot, not cut {cut}");
            new_ran += 1;
            continue;
        }
        assert_eq!(runs, payload_crc(old), "cut {cut}");
        old_ran += 1;

        // And the way forward is open: the same transfer again ends with the new policy.
        let from = board.install(new).unwrap();
        resumed += usize::from(from > 0);
        let mut board = Board::power_on(&flash);
        assert_eq!((board.status.state, board.page(Page::PolicyCrc)), (State::Ready, payload_crc(new)), "cut {cut}");
    }
    assert_eq!((old_ran, new_ran), (words - REST_OF_A_MARK, REST_OF_A_MARK + 1));
    assert!(resumed > words / 2, "{resumed} of {words} transfers went on where they were cut");
}

#[test]
fn at_any_cut_of_a_first_installation_a_confirmed_policy_runs() {
    let (old, new) = (version(0), version(1));
    cut_everywhere(&Model::flashed(&old).copy(), &old, &new);
}

#[test]
fn at_any_cut_of_an_installation_over_an_older_policy_a_confirmed_policy_runs() {
    let (old, new) = (version(1), version(2));
    let flash = Model::flashed(&version(0));
    let mut board = Board::power_on(&flash);
    board.install(&old).unwrap();
    assert_eq!(board.states(), [SlotState::Flashed, SlotState::Confirmed]);
    cut_everywhere(&flash.copy(), &old, &new);
}

#[test]
fn a_revoked_policy_does_not_come_back_when_its_erasure_is_cut() {
    let flash = Model::flashed(&version(0));
    let mut board = Board::power_on(&flash);
    board.transfer(&version(9)).unwrap().unwrap();
    board.do_(OP_ACTIVATE, 0).unwrap().unwrap();
    board.now_us += TRIAL_US + 1;
    board.settle();
    assert_eq!(board.states(), [SlotState::Flashed, SlotState::Revoked]);
    let slots = flash.copy();
    for cut in 0..40 {
        let flash = Model::with(slots.clone());
        let mut board = Board::power_on(&flash);
        flash.cut_after(cut);
        board.transfer(&version(1));
        let mut board = Board::power_on(&flash);
        assert_eq!(board.page(Page::PolicyCrc), payload_crc(&version(0)), "cut {cut}");
    }
}

#[test]
fn a_trial_that_is_not_confirmed_ends_with_time_with_reset_and_with_power() {
    for how in 0..3 {
        let flash = Model::flashed(&version(0));
        let mut board = Board::power_on(&flash);
        board.transfer(&version(1)).unwrap().unwrap();
        assert_eq!(board.states(), [SlotState::Flashed, SlotState::Staged]);
        assert_eq!(board.page(Page::PolicyCrc), payload_crc(&version(0)), "staged is not running");
        board.do_(OP_ACTIVATE, 0).unwrap().unwrap();
        assert_eq!(board.states(), [SlotState::Flashed, SlotState::Trial]);
        assert_eq!(board.page(Page::PolicyCrc), payload_crc(&version(1)));
        match how {
            0 => {
                board.now_us += TRIAL_US + 1;
                board.settle();
                assert_eq!(board.states()[1], SlotState::Revoked);
                assert_eq!(board.status.fault, Fault::SlotFallback, "and it is said");
                assert_eq!(board.page(Page::PolicyError).to_le_bytes()[..2], [15, 1]);
                assert_eq!(board.do_(OP_ACTIVATE, 0), Some(Err(Refusal::Order)));
            }
            1 => {
                board.wire.borrow_mut().rx.push_back(Mode { command: ModeCommand::Reset, node: 1 }.frame());
                board.settle();
            }
            _ => board = Board::power_on(&flash),
        }
        assert_eq!((board.status.state, board.page(Page::PolicyCrc)), (State::Ready, payload_crc(&version(0))));
        assert_eq!(board.do_(OP_CONFIRM, 0), Some(Err(Refusal::Order)));
        if how > 0 {
            // It may be tried again without another transfer.
            assert_eq!(board.do_(OP_ACTIVATE, 0), Some(Ok(1)));
            assert_eq!(board.do_(OP_CONFIRM, 0), Some(Ok(1)));
            assert_eq!(Board::power_on(&flash).page(Page::PolicyCrc), payload_crc(&version(1)));
        }
    }
}

/// The policy with another latent in its first self-test vector, and checksums that are right again.
fn failing(mut image: Vec<u8>) -> Vec<u8> {
    let u32_at = |image: &[u8], at: usize| u32::from_le_bytes(image[at..at + 4].try_into().unwrap()) as usize;
    let tests = u32_at(&image, 64 + 5 * 8);
    let latent = tests + 16 + 4 * 5; // after the five observations of the first vector
    assert!(image[latent] < 4, "a latent of the test policy");
    image[latent] ^= 1;
    let payload = u32_at(&image, 16);
    let sum = crc(&image[64..64 + payload]);
    image[20..24].copy_from_slice(&sum.to_le_bytes());
    let sum = crc(&image[..60]);
    image[60..64].copy_from_slice(&sum.to_le_bytes());
    assert!(Policy::load(leak(&image)).is_ok());
    image
}

#[test]
fn what_is_no_good_is_refused_with_the_reason_and_changes_nothing() {
    let flash = Model::flashed(&version(5));
    let mut board = Board::power_on(&flash);
    let good = version(6);
    assert_eq!(board.do_(OP_LENGTH, 3), Some(Err(Refusal::Length)));
    assert_eq!(board.do_(OP_LENGTH, (SLOT - MARKS_LEN + 16) as u32), Some(Err(Refusal::Length)));
    assert_eq!(board.do_(OP_BEGIN, 1), Some(Err(Refusal::Order)));
    assert_eq!(board.do_(OP_END, 0), Some(Err(Refusal::Order)));
    assert_eq!(board.do_(OP_ACTIVATE, 0), Some(Err(Refusal::Order)));
    assert_eq!(board.do_(99, 0), Some(Err(Refusal::Unknown)));
    assert_eq!(board.transfer(&version(4)), Some(Err(Refusal::Older)));
    assert_eq!(board.transfer(&failing(good.clone())), Some(Err(Refusal::SelfTest)));
    let mut spoilt = good.clone();
    spoilt[300] ^= 1;
    assert_eq!(board.transfer(&spoilt), Some(Err(Refusal::Load)));
    // Damage on the way: the block's CRC finds it, and the block may come again.
    board.do_(OP_LENGTH, good.len() as u32).unwrap().unwrap();
    assert_eq!(board.do_(OP_BEGIN, crc(&good)), Some(Ok(0)));
    assert_eq!(board.do_(OP_BLOCK, 256), Some(Err(Refusal::Offset)));
    assert_eq!(
        board.send_block(&spoilt[256..], 0).map(|r| r.is_ok()),
        Some(true),
        "a block of other bytes, as announced"
    );
    assert_eq!(board.do_(OP_BEGIN, crc(&good)), Some(Ok(0)), "its last block may be torn");
    // Wrong bytes are there now: END finds them, and only starting over helps.
    let mut board = Board::power_on(&flash);
    board.do_(OP_LENGTH, good.len() as u32).unwrap().unwrap();
    assert_eq!(board.do_(OP_BEGIN, crc(&good)), Some(Ok(0)));
    assert_eq!(board.send_block(&good, 0), Some(Err(Refusal::Flash)), "set bits do not come back");
    board.do_(OP_LENGTH, good.len() as u32).unwrap().unwrap();
    assert_eq!(board.ask(OP_BEGIN, 1, crc(&good)).map(|r| (r.op, r.value)), Some((OP_BEGIN, 0)));
    board.fd = false;
    board.install(&good).unwrap();
    assert_eq!(board.page(Page::PolicyCrc), payload_crc(&good));
    // In control nothing of this is allowed.
    board.wire.borrow_mut().rx.push_back(Mode { command: ModeCommand::Run, node: 1 }.frame());
    board.settle();
    assert_eq!(board.status.state, State::Run);
    assert_eq!(board.do_(OP_LENGTH, good.len() as u32), Some(Err(Refusal::State)));
}

#[test]
fn the_other_slot_runs_where_the_better_one_is_damaged() {
    let flash = Model::flashed(&version(0));
    Board::power_on(&flash).install(&version(1)).unwrap();
    flash.0.borrow_mut().slots[1][200] ^= 4;
    let mut board = Board::power_on(&flash);
    assert_eq!((board.status.state, board.status.fault), (State::Ready, Fault::SlotFallback));
    assert_eq!(board.page(Page::PolicyCrc), payload_crc(&version(0)));
    assert_eq!(board.page(Page::PolicyError).to_le_bytes()[..2], [7, 1], "checksum, slot 1");

    let mut failing = failing(version(1));
    failing.resize(SLOT, 0xFF);
    flash.0.borrow_mut().slots[1] = failing;
    let mut board = Board::power_on(&flash);
    assert_eq!((board.status.state, board.status.fault), (State::Ready, Fault::SlotFallback));
    assert_eq!(board.page(Page::PolicyCrc), payload_crc(&version(0)));
    assert_eq!(board.page(Page::PolicyError).to_le_bytes()[..2], [14, 1], "self-test, slot 1");

    flash.0.borrow_mut().slots[0].fill(0xFF);
    let mut board = Board::power_on(&flash);
    assert_eq!((board.status.state, board.status.fault), (State::NoPolicy, Fault::PolicySelfTest));
    assert_eq!(board.page(Page::PolicyError).to_le_bytes()[..2], [14, 1]);
    // A board without a policy takes one.
    board.install(&version(0)).unwrap();
    assert_eq!(board.status.state, State::Ready);
}
