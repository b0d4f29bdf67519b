//! The simulated bender on a link: Modbus TCP by tokio-modbus's server, RTU on a line by its own, with faults on demand.

use std::future::Future;
use std::io;
use std::net::Shutdown;
use std::pin::Pin;
use std::str::FromStr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, DuplexStream};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::task::JoinHandle;
use tokio_modbus::server::Service;
use tokio_modbus::server::tcp::Server;
use tokio_modbus::{ExceptionCode, Request, Response, SlaveRequest};

use crate::bender::Wire;

use super::bender::{MachineEvent, MachineModel, Refusal};
use super::faults::{LineFaults, ReplyFault};
use super::frames::{self, Framing, Heard, Listener};

/// Cycle of the simulated controller's program.
const CYCLE: Duration = Duration::from_millis(10);

/// Silence after which a piece of a frame is given up.
const GIVEN_UP: Duration = Duration::from_millis(20);

/// A way to misbehave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Takes connections and answers nothing.
    Silent,
    /// Answers everything this much later.
    Late {
        /// Milliseconds.
        ms: u64,
    },
    /// Has another program loaded.
    OtherProgram,
    /// The loaded program has one bend more.
    OtherBends,
    /// Is in the middle of a part.
    Running,
    /// Flips a bit of what is staged.
    CorruptStaging,
    /// Drops the connection at the commit, which is lost.
    DropBeforeApply,
    /// Drops the connection at the commit, which is taken.
    DropAfterApply,
    /// Takes the commit and answers nothing from then on.
    SilentAfterCommit,
    /// Answers everything with "busy".
    Busy,
    /// Its program stands still.
    Frozen,
}

impl Fault {
    /// What can be asked for, in words.
    pub const NAMES: &str = "silent, late:MS, other-program, other-bends, running, corrupt-staging, \
                             drop-before-apply, drop-after-apply, silent-after-commit, busy, frozen";

    fn prepare(self, model: &mut MachineModel) {
        match self {
            Fault::OtherProgram => model.rename_program("SOMETHING-ELSE"),
            Fault::OtherBends => model.add_bend(),
            Fault::Running => model.set_between_parts(false),
            Fault::CorruptStaging => model.corrupts_staging = true,
            Fault::Frozen => model.frozen = true,
            _ => {} // a fault of the link
        }
    }
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Fault, String> {
        if let Some(ms) = text.strip_prefix("late:") {
            let ms = ms.parse().map_err(|_| format!("late:{ms}: milliseconds must be a whole number"))?;
            return Ok(Fault::Late { ms });
        }
        match text {
            "silent" => Ok(Fault::Silent),
            "other-program" => Ok(Fault::OtherProgram),
            "other-bends" => Ok(Fault::OtherBends),
            "running" => Ok(Fault::Running),
            "corrupt-staging" => Ok(Fault::CorruptStaging),
            "drop-before-apply" => Ok(Fault::DropBeforeApply),
            "drop-after-apply" => Ok(Fault::DropAfterApply),
            "silent-after-commit" => Ok(Fault::SilentAfterCommit),
            "busy" => Ok(Fault::Busy),
            "frozen" => Ok(Fault::Frozen),
            other => Err(format!("unknown fault {other:?}, known are {}", Fault::NAMES)),
        }
    }
}

/// A running simulated bender; stops when dropped.
#[derive(Debug)]
pub struct SimulatedBender {
    shared: Arc<Shared>,
    address: String,
    tasks: [JoinHandle<()>; 2],
}

/// Where a simulated bender is reached.
pub enum Door {
    /// Modbus TCP.
    Tcp(TcpListener),
    /// RTU's frames over TCP.
    RtuOverTcp(TcpListener),
    /// RTU on a line, which people know by this name.
    Line(Box<dyn Wire>, String),
    /// Wires in memory, one after the other.
    Memory(Framing, UnboundedReceiver<DuplexStream>),
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
        let address = match &door {
            Door::Tcp(listener) | Door::RtuOverTcp(listener) => listener.local_addr()?.to_string(),
            Door::Line(_, name) => name.clone(),
            Door::Memory(..) => "in memory".to_owned(),
        };
        let shared = Arc::new(Shared {
            model: Mutex::new(model),
            fault,
            mute: Mutex::new(false),
            line_faults: Mutex::new(None),
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
        let serving = Arc::clone(&shared);
        let serving = match door {
            Door::Tcp(listener) => tokio::spawn(serve(listener, serving)),
            Door::RtuOverTcp(listener) => tokio::spawn(serve_lines(listener, serving)),
            Door::Line(wire, _) => {
                tokio::spawn(async move { serve_wire(wire, Framing::Rtu, &serving).await })
            }
            Door::Memory(framing, mut wires) => tokio::spawn(async move {
                while let Some(wire) = wires.recv().await {
                    serve_wire(wire, framing, &serving).await;
                }
            }),
        };
        Ok(SimulatedBender { shared, address, tasks: [cycle, serving] })
    }

    /// Where it is reached.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// What happens to its answers on a line from now on.
    pub fn set_line_faults(&self, faults: Option<LineFaults>) {
        *lock(&self.shared.line_faults) = faults;
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

async fn serve(listener: TcpListener, shared: Arc<Shared>) {
    let on_connected = |stream: TcpStream, _peer| {
        let shared = Arc::clone(&shared);
        async move {
            let _ = stream.set_nodelay(true); // answers would only be slower without
            // A second handle on the socket, to cut it from inside a request.
            let stream = stream.into_std()?;
            let cut = stream.try_clone()?;
            Ok(Some((Connection { shared, cut }, TcpStream::from_std(stream)?)))
        }
    };
    let on_error = |error: io::Error| tracing::debug!(%error, "a connection ended");
    if let Err(error) = Server::new(listener).serve(&on_connected, on_error).await {
        tracing::error!(%error, "the simulated bender no longer takes connections");
    }
}

/// One connection after the other: a device server has one line.
async fn serve_lines(listener: TcpListener, shared: Arc<Shared>) {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                let _ = stream.set_nodelay(true); // answers would only be slower without
                serve_wire(stream, Framing::Rtu, &shared).await;
            }
            Err(error) => {
                tracing::error!(%error, "the simulated bender no longer takes connections");
                return;
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
        let answer = match shared.reply(heard.unit, &heard.request) {
            Reply::Silence => continue,
            Reply::HangUp => return,
            Reply::Exception(code) => frames::Answer::Exception(code.into()),
            Reply::Words(words) => frames::Answer::Words(words),
            Reply::Written => frames::Answer::Written,
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
    line_faults: Mutex<Option<LineFaults>>,
}

/// What a machine says to a request.
enum Reply {
    Silence,
    /// The connection is cut; a line has none and is silent.
    HangUp,
    Exception(ExceptionCode),
    Words(Vec<u16>),
    Written,
}

impl Shared {
    fn reply(&self, unit: u8, request: &frames::Request) -> Reply {
        let mut model = lock(&self.model);
        let mut mute = lock(&self.mute);
        if *mute || self.fault == Some(Fault::Silent) {
            return Reply::Silence;
        }
        if self.fault == Some(Fault::Busy) {
            return Reply::Exception(ExceptionCode::ServerDeviceBusy);
        }
        if unit != model.unit_id() {
            return Reply::Silence;
        }
        match request {
            frames::Request::Read { address, count } => model
                .read(*address, *count)
                .map_or_else(|refusal| Reply::Exception(exception(refusal)), Reply::Words),
            frames::Request::Write { address, words } => {
                let commits = *address == model.commit_address();
                if commits && self.fault == Some(Fault::DropBeforeApply) {
                    return Reply::HangUp;
                }
                if let Err(refusal) = model.write(*address, words) {
                    return Reply::Exception(exception(refusal));
                }
                match self.fault {
                    Some(Fault::DropAfterApply) if commits => Reply::HangUp,
                    Some(Fault::SilentAfterCommit) if commits => {
                        *mute = true;
                        Reply::Silence
                    }
                    _ => Reply::Written,
                }
            }
            frames::Request::Other { .. } => Reply::Exception(ExceptionCode::IllegalFunction),
        }
    }

    fn delay(&self) -> Duration {
        match self.fault {
            Some(Fault::Late { ms }) => Duration::from_millis(ms),
            _ => Duration::ZERO,
        }
    }

    /// The bytes that arrive of an answer, when they do.
    async fn on_the_wire(&self, framing: Framing, heard: &Heard, answer: &frames::Answer) -> Vec<u8> {
        let bytes = frames::encode(framing, heard, answer);
        let (arriving, ms) = {
            let mut faults = lock(&self.line_faults);
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

struct Connection {
    shared: Arc<Shared>,
    cut: std::net::TcpStream,
}

type Answer = Result<Option<Response>, ExceptionCode>;

impl Service for Connection {
    type Request = SlaveRequest<'static>;
    type Response = Option<Response>;
    type Exception = ExceptionCode;
    type Future = Pin<Box<dyn Future<Output = Answer> + Send>>;

    fn call(&self, request: Self::Request) -> Self::Future {
        let answer = self.answer(request);
        let delay = self.shared.delay();
        Box::pin(async move {
            tokio::time::sleep(delay).await;
            answer
        })
    }
}

impl Connection {
    fn answer(&self, SlaveRequest { slave, request }: SlaveRequest<'_>) -> Answer {
        if slave != lock(&self.shared.model).unit_id() {
            return Err(ExceptionCode::GatewayTargetDevice);
        }
        let request = match request {
            Request::ReadHoldingRegisters(address, count) => frames::Request::Read { address, count },
            Request::WriteMultipleRegisters(address, words) => {
                frames::Request::Write { address, words: words.into_owned() }
            }
            other => frames::Request::Other { function: other.function_code().value() },
        };
        let reply = self.shared.reply(slave, &request);
        Ok(match (reply, request) {
            (Reply::Words(words), _) => Some(Response::ReadHoldingRegisters(words)),
            (Reply::Written, frames::Request::Write { address, words }) => {
                let count = u16::try_from(words.len()).map_err(|_| ExceptionCode::IllegalDataValue)?;
                Some(Response::WriteMultipleRegisters(address, count))
            }
            (Reply::Exception(code), _) => return Err(code),
            (Reply::HangUp, _) => {
                let _ = self.cut.shutdown(Shutdown::Both); // already closed is closed
                None
            }
            (Reply::Silence | Reply::Written, _) => None,
        })
    }
}

fn exception(refusal: Refusal) -> ExceptionCode {
    match refusal {
        Refusal::Address => ExceptionCode::IllegalDataAddress,
        Refusal::Value => ExceptionCode::IllegalDataValue,
    }
}

/// A panic elsewhere leaves registers as they are; the machine keeps answering, as a real one would.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
