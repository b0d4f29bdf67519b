//! What a bus can do, and a [`CanPort`] on it: sends with patience when the bus has no room, turns the bus's conditions into errors
//! and log lines.
//!
//! Under the protocols; on an interface of this computer (`socket`) or in memory (`memory`).

use std::future::poll_fn;
use std::io;
use std::task::{Context, Poll, Waker};

use tokio::time::{Duration, Instant, sleep};

use super::frame::{Condition, Frame, Heard, Storm};
use super::socket::Socket;
use crate::bender::caller::millis;
use crate::bender::exchange::Port;
use crate::bender::recording::Frames;
use crate::bender::ring::{Content, Direction};

/// After so long a frame that found no room is tried again; a frame takes about a quarter of it on a bus of 500 kbit/s.
const ROOM_AGAIN: Duration = Duration::from_millis(1);

/// Frames thrown away before a request, at most: a socket's queue holds far less.
const MOST_STALE: usize = 100_000;

/// A node's place on a bus. One task uses it.
pub trait Bus: Send {
    /// Sends one frame. No room is an error ([`has_no_room`]), not a wait.
    fn poll_send(&mut self, cx: &mut Context<'_>, frame: &Frame) -> Poll<io::Result<()>>;

    /// The next that is heard.
    fn poll_receive(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<Heard>>;
}

/// Takes a place on a bus that is none of this computer's: one in memory. Told the endpoint.
pub type BusOpener = Box<dyn FnMut(&str) -> io::Result<Box<dyn Bus>> + Send>;

/// Whether a frame was not sent since the queue is full: worth trying again.
pub fn has_no_room(error: &io::Error) -> bool {
    error.raw_os_error() == Some(libc::ENOBUFS) || error.kind() == io::ErrorKind::WouldBlock
}

/// A place on a bus for a protocol.
pub struct CanPort {
    bus: Box<dyn Bus>,
    interface: String,
    /// How long a frame waits for room.
    patience: Duration,
    storm: Storm,
    since: Instant,
    frames: Frames,
}

/// Opens a port on the interface `endpoint`, or where `opener` says. With `fd` the interface must carry CAN FD.
pub fn open_port(
    endpoint: &str,
    opener: Option<&mut BusOpener>,
    fd: bool,
    patience: Duration,
) -> io::Result<CanPort> {
    let bus: Box<dyn Bus> = match opener {
        Some(opener) => opener(endpoint)?,
        None => Box::new(Socket::open(endpoint, fd)?),
    };
    Ok(CanPort::new(bus, endpoint, patience))
}

impl CanPort {
    /// A port; `patience` is the longest that a frame waits for room.
    pub fn new(bus: Box<dyn Bus>, interface: &str, patience: Duration) -> CanPort {
        let (storm, since) = (Storm::default(), Instant::now());
        CanPort { bus, interface: interface.to_owned(), patience, storm, since, frames: Frames::default() }
    }

    /// What goes by is kept in `frames` for a while.
    pub fn recorded(self, frames: Frames) -> CanPort {
        CanPort { frames, ..self }
    }

    /// What a condition means for who uses the port.
    fn weigh(&mut self, condition: Condition) -> io::Result<()> {
        let interface = &self.interface;
        match condition {
            Condition::BusOff => {
                let why = format!(
                    "{interface} is bus-off: too many errors; check bit rate, cable and the 120 ohm at both ends. It comes back \
                     by itself where `ip link set {interface} type can restart-ms 100` was set, else by `ip link set \
                     {interface} down` and `up`"
                );
                return Err(io::Error::new(io::ErrorKind::NetworkDown, why));
            }
            Condition::Restarted => tracing::info!(interface, "on the bus again after bus-off"),
            Condition::ErrorPassive => {
                if let Some(count) = self.storm.note(millis(self.since.elapsed())) {
                    tracing::warn!(
                        interface,
                        count,
                        "the CAN controller is error-passive; check bit rate and cable"
                    );
                }
            }
            Condition::Noise(classes) => {
                if let Some(count) = self.storm.note(millis(self.since.elapsed())) {
                    tracing::warn!(
                        interface,
                        count,
                        classes = format!("{classes:X}"),
                        "errors on the CAN bus"
                    );
                }
            }
        }
        Ok(())
    }
}

impl Port for CanPort {
    type Piece = Frame;

    async fn discard(&mut self) -> io::Result<()> {
        let (mut cx, mut off) = (Context::from_waker(Waker::noop()), false);
        for _ in 0..MOST_STALE {
            match self.bus.poll_receive(&mut cx) {
                Poll::Pending if off => return self.weigh(Condition::BusOff),
                Poll::Pending => return Ok(()),
                Poll::Ready(Err(error)) => return Err(error),
                Poll::Ready(Ok(Heard::Frame(_))) => {}
                Poll::Ready(Ok(Heard::Condition(Condition::BusOff))) => off = true,
                Poll::Ready(Ok(Heard::Condition(condition))) => {
                    off &= condition != Condition::Restarted;
                    self.weigh(condition)?;
                }
            }
        }
        let why =
            format!("{MOST_STALE} frames are waiting and more come: the bus is faster than this computer");
        Err(io::Error::new(io::ErrorKind::InvalidData, why))
    }

    async fn send(&mut self, piece: Frame) -> io::Result<()> {
        let until = Instant::now() + self.patience;
        self.frames.add(Direction::Sent, Content::Text(piece.to_string()));
        loop {
            match poll_fn(|cx| self.bus.poll_send(cx, &piece)).await {
                Err(error) if has_no_room(&error) && Instant::now() < until => sleep(ROOM_AGAIN).await,
                Err(error) if has_no_room(&error) => {
                    let why = format!(
                        "{} took no frame for {} ms: nobody acknowledges what is sent; check that the machine is on and on this \
                         bus, the bit rate, the 120 ohm at both ends",
                        self.interface,
                        self.patience.as_millis()
                    );
                    return Err(io::Error::new(io::ErrorKind::TimedOut, why));
                }
                sent => return sent,
            }
        }
    }

    async fn receive(&mut self) -> io::Result<Frame> {
        loop {
            match poll_fn(|cx| self.bus.poll_receive(cx)).await? {
                Heard::Frame(frame) => {
                    self.frames.add(Direction::Received, Content::Text(frame.to_string()));
                    return Ok(frame);
                }
                Heard::Condition(condition) => self.weigh(condition)?,
            }
        }
    }
}
