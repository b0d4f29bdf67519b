//! The simulated bender on its links: takes requests off a wire and answers them, with faults on demand.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio::task::{JoinHandle, JoinSet};

use super::bender::{MachineEvent, MachineModel, Refusal};
use super::door::Door;
use super::faults::{Fault, ReplyFault, WireFaults};
use super::frames::{self, Answer, Framing, Heard, Listener, Request};

/// Cycle of the simulated controller's program.
const CYCLE: Duration = Duration::from_millis(10);

/// Silence after which a piece of a frame is given up.
const GIVEN_UP: Duration = Duration::from_millis(20);

/// Modbus exceptions that are no refusal of the machine's own.
const NO_SUCH_FUNCTION: u8 = 1;
const BUSY: u8 = 6;
const NO_SUCH_UNIT: u8 = 11;

/// A running simulated bender; stops when dropped.
#[derive(Debug)]
pub struct SimulatedBender {
    shared: Arc<Shared>,
    address: String,
    tasks: [JoinHandle<()>; 2],
}

impl SimulatedBender {
    /// Serves a machine at a door that is open already. Must be called inside a tokio runtime.
    pub fn start(
        door: Door,
        mut model: MachineModel,
        fault: Option<Fault>,
        mut on_event: impl FnMut(MachineEvent) + Send + 'static,
    ) -> io::Result<SimulatedBender> {
        if let Some(fault) = fault {
            fault.prepare(&mut model);
        }
        let address = door.address()?;
        let shared = Arc::new(Shared {
            model: Mutex::new(model),
            fault,
            mute: Mutex::new(false),
            wire_faults: Mutex::new(None),
        });
        let ticking = Arc::clone(&shared);
        let cycle = tokio::spawn(async move {
            let mut interval = tokio::time::interval(CYCLE);
            loop {
                interval.tick().await;
                let event = lock(&ticking.model).tick();
                if let Some(event) = event {
                    on_event(event);
                }
            }
        });
        let serving = tokio::spawn(serve(door, Arc::clone(&shared)));
        Ok(SimulatedBender { shared, address, tasks: [cycle, serving] })
    }

    /// Where it is reached.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// What happens to its answers on the wire from now on.
    pub fn set_wire_faults(&self, faults: Option<WireFaults>) {
        *lock(&self.shared.wire_faults) = faults;
    }

    /// Answers again after `silent-after-commit`.
    pub fn unmute(&self) {
        *lock(&self.shared.mute) = false;
    }

    /// Looks at the machine, or acts as its operator.
    pub fn with<R>(&self, action: impl FnOnce(&mut MachineModel) -> R) -> R {
        action(&mut lock(&self.shared.model))
    }
}

impl Drop for SimulatedBender {
    fn drop(&mut self) {
        self.tasks.iter().for_each(JoinHandle::abort);
    }
}

/// All wires that the door lets in.
async fn serve(door: Door, shared: Arc<Shared>) {
    match door {
        Door::Line(wire, _) => serve_wire(wire, Framing::Rtu, &shared).await,
        Door::Memory(framing, mut wires) => {
            while let Some(wire) = wires.recv().await {
                serve_wire(wire, framing, &shared).await;
            }
        }
        Door::Socket(framing, listener) => serve_socket(&listener, framing, &shared).await,
    }
}

/// Over TCP several at once; a device server has one line, and one connection after the other.
async fn serve_socket(listener: &TcpListener, framing: Framing, shared: &Arc<Shared>) {
    let mut connections = JoinSet::new();
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::error!(%error, "the simulated bender no longer takes connections");
                return;
            }
        };
        let _ = stream.set_nodelay(true); // answers would only be slower without
        match framing {
            Framing::Rtu => serve_wire(stream, framing, shared).await,
            Framing::Tcp => {
                let shared = Arc::clone(shared);
                connections.spawn(async move { serve_wire(stream, framing, &shared).await });
            }
        }
    }
}

/// A unit on a wire, until that is closed or the machine hangs up.
async fn serve_wire(mut wire: impl AsyncRead + AsyncWrite + Unpin, framing: Framing, shared: &Shared) {
    let (mut listener, mut bytes) = (Listener::new(framing), [0; 512]);
    loop {
        let read = wire.read(&mut bytes);
        let read = if listener.is_amid() {
            match tokio::time::timeout(GIVEN_UP, read).await {
                Ok(read) => read,
                Err(_) => {
                    listener.silence();
                    continue;
                }
            }
        } else {
            read.await
        };
        let Ok(count @ 1..) = read else { return };
        let Some(heard) = listener.take(&bytes[..count]) else { continue };
        let answer = match shared.reply(framing, &heard) {
            Reply::Silence => continue,
            Reply::HangUp => return,
            Reply::Answer(answer) => answer,
        };
        tokio::time::sleep(shared.delay()).await;
        let arriving = shared.on_the_wire(framing, &heard, &answer).await;
        if wire.write_all(&arriving).await.is_err() || wire.flush().await.is_err() {
            return;
        }
    }
}

/// What all links to one machine share.
#[derive(Debug)]
struct Shared {
    model: Mutex<MachineModel>,
    fault: Option<Fault>,
    /// Answers nothing any more.
    mute: Mutex<bool>,
    wire_faults: Mutex<Option<WireFaults>>,
}

/// What a machine does with a request.
enum Reply {
    Silence,
    /// The connection is cut.
    HangUp,
    Answer(Answer),
}

impl Shared {
    fn reply(&self, framing: Framing, heard: &Heard) -> Reply {
        let mut model = lock(&self.model);
        let mut mute = lock(&self.mute);
        if *mute || self.fault == Some(Fault::Silent) {
            return Reply::Silence;
        }
        if self.fault == Some(Fault::Busy) {
            return Reply::Answer(Answer::Exception(BUSY));
        }
        if heard.unit != model.unit_id() {
            // On a line another unit may be meant; over TCP nobody else could answer.
            let over_tcp = framing == Framing::Tcp;
            return if over_tcp { Reply::Answer(Answer::Exception(NO_SUCH_UNIT)) } else { Reply::Silence };
        }
        match &heard.request {
            Request::Read { address, count } => Reply::Answer(
                model.read(*address, *count).map_or_else(|r| Answer::Exception(exception(r)), Answer::Words),
            ),
            Request::Write { address, words } => {
                let commits = *address == model.commit_address();
                if commits && self.fault == Some(Fault::DropBeforeApply) {
                    return Reply::HangUp;
                }
                if let Err(refusal) = model.write(*address, words) {
                    return Reply::Answer(Answer::Exception(exception(refusal)));
                }
                match self.fault {
                    Some(Fault::DropAfterApply) if commits => Reply::HangUp,
                    Some(Fault::SilentAfterCommit) if commits => {
                        *mute = true;
                        Reply::Silence
                    }
                    _ => Reply::Answer(Answer::Written),
                }
            }
            Request::Other { .. } => Reply::Answer(Answer::Exception(NO_SUCH_FUNCTION)),
        }
    }

    fn delay(&self) -> Duration {
        match self.fault {
            Some(Fault::Late { ms }) => Duration::from_millis(ms),
            _ => Duration::ZERO,
        }
    }

    /// The bytes that arrive of an answer, when they do.
    async fn on_the_wire(&self, framing: Framing, heard: &Heard, answer: &Answer) -> Vec<u8> {
        let bytes = frames::encode(framing, heard, answer);
        let (arriving, ms) = {
            let mut faults = lock(&self.wire_faults);
            let Some(faults) = faults.as_mut() else { return bytes };
            let usual_ms = faults.usual_ms();
            match faults.fault() {
                None => (bytes, usual_ms),
                Some(fault @ ReplyFault::Late { ms }) => (faults.damage(fault, bytes), usual_ms + ms),
                Some(fault) => (faults.damage(fault, bytes), usual_ms),
            }
        };
        tokio::time::sleep(Duration::from_millis(ms)).await;
        arriving
    }
}

fn exception(refusal: Refusal) -> u8 {
    match refusal {
        Refusal::Address => 2,
        Refusal::Value => 3,
    }
}

/// A panic elsewhere leaves registers as they are; the machine keeps answering, as a real one would.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
