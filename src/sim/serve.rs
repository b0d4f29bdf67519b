//! Puts a station on a port: what arrives is heard, what it answers goes out, with the faults of the wire.

use std::future::Future;
use std::io;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};

use super::bender::MachineModel;
use super::faults::Fault;
use super::reply_fault::{Damaged, ReplyFault};
use super::station::{Controller, Station};
use super::trouble::{Trouble, When, WireFaults};
use crate::bender::can::CanPort;
use crate::bender::{FolderPort, Port};

/// Cycle of the simulated controller's program.
pub const CYCLE: Duration = Duration::from_millis(10);

/// Silence after which a piece of a frame is given up.
const GIVEN_UP: Duration = Duration::from_millis(20);

/// What all links to one machine share.
#[derive(Debug)]
pub struct Shared {
    /// The machine.
    pub model: Mutex<MachineModel>,
    /// A way to misbehave.
    pub fault: Option<Fault>,
    /// Answers nothing any more.
    pub mute: Mutex<bool>,
    /// What happens to answers on the wire.
    pub wire_faults: Mutex<Option<WireFaults>>,
    /// What of that has happened, and was not told yet.
    pub happened: Mutex<Vec<String>>,
}

/// A panic elsewhere leaves the machine as it is; it keeps answering, as a real one would.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A port at the machine's end.
pub trait MachinePort: Port {
    /// Closes the writing side; nothing where there is none.
    fn half_close(&mut self) -> impl Future<Output = io::Result<()>> + Send {
        std::future::ready(Ok(()))
    }

    /// Whether it is a place on a bus, which can be lost.
    fn is_on_bus(&self) -> bool {
        false
    }
}

impl MachinePort for FolderPort {}

impl MachinePort for CanPort {
    fn is_on_bus(&self) -> bool {
        true
    }
}

impl<W: AsyncRead + AsyncWrite + Unpin + Send> MachinePort for WirePort<W> {
    async fn half_close(&mut self) -> io::Result<()> {
        self.0.shutdown().await
    }
}

/// A wire of bytes.
pub struct WirePort<W>(pub W);

impl<W: AsyncRead + AsyncWrite + Unpin + Send> Port for WirePort<W> {
    type Piece = Vec<u8>;

    async fn discard(&mut self) -> io::Result<()> {
        Ok(())
    }

    async fn send(&mut self, piece: Vec<u8>) -> io::Result<()> {
        self.0.write_all(&piece).await?;
        self.0.flush().await
    }

    async fn receive(&mut self) -> io::Result<Vec<u8>> {
        let mut bytes = [0; 512];
        match self.0.read(&mut bytes).await? {
            0 => Err(io::ErrorKind::UnexpectedEof.into()),
            count => Ok(bytes[..count].to_vec()),
        }
    }
}

/// Why a port is no longer served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// It was closed.
    Closed,
    /// The machine hung up; a port that cannot be cut goes on.
    HungUp,
}

/// Until the port is closed or the machine hangs up.
pub async fn serve<P, S>(port: &mut P, station: &mut S, shared: &Shared) -> Ended
where
    P: MachinePort,
    P::Piece: Damaged,
    S: Station<Piece = P::Piece>,
{
    let mut cycle = tokio::time::interval(CYCLE);
    let mut quiet = Duration::ZERO;
    loop {
        let received = tokio::select! {
            received = port.receive() => Some(received),
            _ = cycle.tick() => None,
        };
        match received {
            Some(Ok(piece)) => {
                quiet = Duration::ZERO;
                let (answers, hangs_up) = shared.attend(|controller| station.hear(piece, controller));
                if hangs_up {
                    return Ended::HungUp;
                }
                if shared.answer(port, answers).await.is_err() {
                    return Ended::Closed;
                }
            }
            Some(Err(_)) => return Ended::Closed,
            None => {
                quiet += CYCLE;
                if quiet > GIVEN_UP {
                    station.silence();
                }
                let (pieces, _) = shared.attend(|controller| station.cycle(controller));
                for piece in pieces {
                    // Other errors pass: the bus may be away for a while.
                    let sent = shared.damaged(port, piece, false).await;
                    if sent.is_err_and(|error| error.kind() == io::ErrorKind::NotConnected) {
                        return Ended::Closed;
                    }
                }
            }
        }
    }
}

impl Shared {
    /// Lets a station act; and whether the machine hangs up.
    fn attend<T>(&self, act: impl FnOnce(&mut Controller<'_>) -> T) -> (T, bool) {
        let busy = lock(&self.wire_faults).as_mut().is_some_and(WireFaults::is_busy);
        let (result, hangs_up, committed) = {
            let (mut model, mut mute) = (lock(&self.model), lock(&self.mute));
            let mut controller = Controller {
                model: &mut model,
                fault: self.fault,
                mute: &mut mute,
                busy,
                committed: false,
                hangs_up: false,
            };
            let result = act(&mut controller);
            (result, controller.hangs_up, controller.committed)
        };
        if committed {
            self.pass(When::Commit);
        }
        (result, hangs_up)
    }

    /// What is due now happens at the machine.
    pub fn pass(&self, now: When) {
        let due = lock(&self.wire_faults).as_mut().map(|faults| faults.due(now)).unwrap_or_default();
        for (when, trouble) in due {
            self.strike(when, trouble);
        }
    }

    fn strike(&self, when: When, trouble: Trouble) {
        trouble.strike(&mut lock(&self.model));
        lock(&self.happened).push(format!("{when}: {trouble}"));
    }

    async fn answer<P>(&self, port: &mut P, answers: Vec<P::Piece>) -> io::Result<()>
    where
        P: MachinePort,
        P::Piece: Damaged,
    {
        for answer in answers {
            if let Some(Fault::Late { ms }) = self.fault {
                tokio::time::sleep(Duration::from_millis(ms)).await;
            }
            self.damaged(port, answer, true).await?;
        }
        Ok(())
    }

    /// Sends what arrives of a piece, when it does.
    async fn damaged<P>(&self, port: &mut P, piece: P::Piece, takes_time: bool) -> io::Result<()>
    where
        P: MachinePort,
        P::Piece: Damaged,
    {
        let (arriving, ms, trouble) = self.meet(piece, takes_time);
        if ms > 0 {
            tokio::time::sleep(Duration::from_millis(ms)).await;
        }
        if trouble == Some(Trouble::BusOff) && port.is_on_bus() {
            return Err(io::ErrorKind::NotConnected.into());
        }
        if trouble == Some(Trouble::HalfClose) {
            port.half_close().await?;
        }
        for piece in arriving {
            port.send(piece).await?;
        }
        Ok(())
    }

    /// What arrives of an answer, how much later, and what it met.
    fn meet<P: Damaged>(&self, piece: P, takes_time: bool) -> (Vec<P>, u64, Option<Trouble>) {
        let mut guard = lock(&self.wire_faults);
        let Some(faults) = guard.as_mut() else { return (vec![piece], 0, None) };
        let usual_ms = if takes_time { faults.usual_ms() } else { 0 };
        let (number, Some(trouble)) = faults.answer() else { return (vec![piece], usual_ms, None) };
        let (arriving, late_ms) = match trouble {
            Trouble::Reply(ReplyFault::Late { ms }) => (vec![piece], ms),
            Trouble::Reply(fault) => (piece.damaged(fault, faults), 0),
            Trouble::Cut { bytes } | Trouble::EmergencyStop { bytes } => (piece.cut(bytes), 0),
            Trouble::HalfClose | Trouble::Reboot => (Vec::new(), 0),
            _ => (vec![piece], 0),
        };
        drop(guard);
        self.strike(When::Answer(number), trouble);
        (arriving, usual_ms + late_ms, Some(trouble))
    }
}
