//! One exchange with a machine that keeps objects instead of registers: what is asked, and the protocol's side of it as a pure
//! machine. `table_link` performs what it asks for on a port; serial tables, CAN, CANopen and the shared folder are such protocols.
//!
//! What comes over a port in one piece is the port's matter: some bytes of a line, one CAN frame, one file.

use std::future::Future;
use std::io;

use super::recording::Frames;
use super::wire::TableId;

/// What is asked of the machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ask {
    /// The status image ([`super::status_image`]).
    Status,
    /// Write this image to the staging area, from its beginning; the answer is empty.
    Stage(Vec<u8>),
    /// The staging area's first bytes.
    ReadBack {
        /// How many.
        bytes: usize,
    },
    /// Write the commit word; the answer is empty. Never repeated once it has been sent.
    Commit(TableId),
    /// The payload in force, as long as its bend count says; empty where there is none.
    Recall,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event<P> {
    /// It begins.
    Begun,
    /// A piece arrived.
    Received(P),
    /// The time that the last action gave is over.
    Timeout,
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action<P> {
    /// Send these, one after the other, then wait until then for what arrives.
    Send {
        /// Pieces; none: only wait.
        pieces: Vec<P>,
        /// In the time given with events.
        until_ms: u64,
    },
    /// The answer is complete.
    Done(Vec<u8>),
    /// There is none.
    Failed(Failure),
}

/// Why there is no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// The machine heard the request and refused it: in words, with its code.
    Refused(String),
    /// The machine is busy: it may be asked again.
    Busy,
    /// What came does not fit, or nothing came in time.
    Broken(String),
}

/// One exchange, begun. Every exchange ends: its own limit on repetitions, and the link's deadline.
pub trait Exchange: Send {
    /// What comes over the port.
    type Piece;

    /// One event in, one action out; times in milliseconds of the caller's clock.
    fn on(&mut self, event: Event<Self::Piece>, now_ms: u64) -> Action<Self::Piece>;
}

/// What leads to a machine, open.
pub trait Port: Send {
    /// What comes over it.
    type Piece: Send;

    /// Throws away what has arrived: it is no answer to what is asked next.
    fn discard(&mut self) -> impl Future<Output = io::Result<()>> + Send;

    /// Sends one piece.
    fn send(&mut self, piece: Self::Piece) -> impl Future<Output = io::Result<()>> + Send;

    /// The next piece. A call that is cancelled loses nothing.
    fn receive(&mut self) -> impl Future<Output = io::Result<Self::Piece>> + Send;
}

/// A protocol: how asking becomes pieces.
pub trait Protocol: Send {
    /// What it goes over.
    type Port: Port;

    /// Begins an exchange.
    fn begin(&mut self, ask: &Ask) -> Box<dyn Exchange<Piece = <Self::Port as Port>::Piece>>;

    /// Where its ports put what goes over them.
    fn frames(&self) -> &Frames;

    /// Opens the port.
    fn open(&mut self, endpoint: &str) -> impl Future<Output = io::Result<Self::Port>> + Send;
}
