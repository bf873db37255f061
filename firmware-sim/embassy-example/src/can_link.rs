//! The node's bus on an FDCAN controller: classic and FD frames, both ways.

use core::future::poll_fn;

use embassy_stm32::can::config::TxBufferMode;
use embassy_stm32::can::enums::BusErrorMode;
use embassy_stm32::can::frame::{FdFrame, Header};
use embassy_stm32::can::{
    BufferedCanFd, BufferedFdCanReceiver, BufferedFdCanSender, CanConfigurator, IT0InterruptHandler,
    IT1InterruptHandler, RxFdBuf, TxFdBuf,
};
use embassy_stm32::peripherals::{FDCAN1, PD0, PD1};
use embassy_stm32::{Peri, bind_interrupts, pac};
use gadm_node::frame::Kind;
use gadm_node::{Frame, Link, LinkError};
use static_cell::StaticCell;

/// Bit rate of arbitration, and of all of a classic frame.
const NOMINAL_BIT_S: u32 = 500_000;
/// Bit rate of the data of an FD frame.
const DATA_BIT_S: u32 = 2_000_000;
/// Frames that wait to be sent: more than a node sends in a control period, and the pages of its heartbeat.
const SEND_QUEUE: usize = 32;
/// Frames that wait for the node: more than come while it computes one action.
const RECEIVE_QUEUE: usize = 64;

bind_interrupts!(struct Irqs {
    FDCAN1_IT0 => IT0InterruptHandler<FDCAN1>;
    FDCAN1_IT1 => IT1InterruptHandler<FDCAN1>;
});

/// FDCAN 1 with queues that its interrupt fills and empties.
pub struct CanLink {
    /// Keeps the controller on and tells whether it is off the bus.
    controller: BufferedCanFd<'static, SEND_QUEUE, RECEIVE_QUEUE>,
    receiver: BufferedFdCanReceiver,
    sender: BufferedFdCanSender,
}

impl CanLink {
    /// Joins the bus. It takes every frame; those that are not for the node, the node drops.
    pub fn start(fdcan: Peri<'static, FDCAN1>, receive: Peri<'static, PD0>, transmit: Peri<'static, PD1>) -> Self {
        static SEND: StaticCell<TxFdBuf<SEND_QUEUE>> = StaticCell::new();
        static RECEIVE: StaticCell<RxFdBuf<RECEIVE_QUEUE>> = StaticCell::new();
        let mut configurator = CanConfigurator::new(fdcan, receive, transmit, Irqs);
        configurator.set_bitrate(NOMINAL_BIT_S);
        // The delay of a transceiver is compensated from 1 Mbit/s on.
        configurator.set_fd_data_bitrate(DATA_BIT_S, true);
        // Frames leave in the order of the node, and it is the node that ends a bus-off ([`Link::restart`]).
        let config = configurator.config().set_tx_buffer_mode(TxBufferMode::Fifo).set_automatic_bus_off_recovery(false);
        configurator.set_config(config);
        let controller =
            configurator.into_normal_mode().buffered_fd(SEND.init(TxFdBuf::new()), RECEIVE.init(RxFdBuf::new()));
        Self { receiver: controller.reader(), sender: controller.writer(), controller }
    }

    /// Waits until [`Link::receive`] has something to return.
    pub async fn frame_is_there(&mut self) {
        poll_fn(|context| self.receiver.poll_ready_to_receive(context)).await;
    }

    fn check_bus(&self) -> Result<(), LinkError> {
        match self.controller.properties().bus_error_mode() {
            BusErrorMode::BusOff => Err(LinkError::BusOff),
            BusErrorMode::ErrorActive | BusErrorMode::ErrorPassive => Ok(()),
        }
    }
}

impl Link for CanLink {
    /// What the driver says of a damaged frame on the wire is passed over: the controller sent an error frame, and its
    /// sender repeats it.
    fn receive(&mut self, frame: &mut Frame) -> Result<bool, LinkError> {
        self.check_bus()?;
        while let Ok(received) = self.receiver.try_receive() {
            if let Some(known) = received.ok().and_then(|envelope| from_driver(&envelope.frame)) {
                *frame = known;
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn send(&mut self, frame: &Frame) -> Result<(), LinkError> {
        self.check_bus()?;
        let known = to_driver(frame).ok_or(LinkError::Unsupported)?;
        self.sender.try_write(known).map_err(|_| LinkError::Full)
    }

    /// Source: ST RM0433, FDCAN: the controller sets INIT when it goes bus-off, and waits for 128 times 11 recessive bits
    /// after a program has cleared it.
    fn restart(&mut self) -> Result<(), LinkError> {
        pac::FDCAN1.cccr().modify(|w| w.set_init(false));
        Ok(())
    }
}

/// A frame of the driver as one of the node; `None` for one that no CAN bus carries.
fn from_driver(frame: &FdFrame) -> Option<Frame> {
    let header = frame.header();
    let id = *header.id();
    if header.rtr() {
        Frame::remote(id, usize::from(header.len()))
    } else if header.fdcan() {
        Frame::fd(id, frame.data(), header.bit_rate_switching())
    } else {
        Frame::classic(id, frame.data())
    }
}

/// A frame of the node as one of the driver.
fn to_driver(frame: &Frame) -> Option<FdFrame> {
    let len = u8::try_from(frame.payload().len()).ok()?;
    let header = match frame.kind() {
        Kind::Classic => Header::new(frame.identifier(), len, false),
        Kind::Fd { brs } => Header::new_fd(frame.identifier(), len, false, brs),
        Kind::Remote => return FdFrame::new_remote(frame.identifier(), frame.remote_dlc()?).ok(),
    };
    FdFrame::new(header, frame.payload()).ok()
}
