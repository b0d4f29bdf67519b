//! The simulated bender on a socket: Modbus TCP by tokio-modbus's server, with faults on demand.

use std::future::Future;
use std::io;
use std::net::{Shutdown, SocketAddr};
use std::pin::Pin;
use std::str::FromStr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_modbus::server::Service;
use tokio_modbus::server::tcp::Server;
use tokio_modbus::{ExceptionCode, Request, Response, SlaveRequest};

use super::bender::{MachineEvent, MachineModel, Refusal};

/// Cycle of the simulated controller's program.
const CYCLE: Duration = Duration::from_millis(10);

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
    model: Arc<Mutex<MachineModel>>,
    shared: Arc<Shared>,
    address: SocketAddr,
    tasks: [JoinHandle<()>; 2],
}

impl SimulatedBender {
    /// Serves a machine on a socket that is bound already. Must be called inside a tokio runtime.
    pub fn start(
        listener: TcpListener,
        mut model: MachineModel,
        fault: Option<Fault>,
        mut on_event: impl FnMut(MachineEvent) + Send + 'static,
    ) -> io::Result<SimulatedBender> {
        let address = listener.local_addr()?;
        if let Some(fault) = fault {
            fault.prepare(&mut model);
        }
        let model = Arc::new(Mutex::new(model));
        let ticking = Arc::clone(&model);
        let cycle = tokio::spawn(async move {
            let mut interval = tokio::time::interval(CYCLE);
            loop {
                interval.tick().await;
                let event = lock(&ticking).tick();
                if let Some(event) = event {
                    on_event(event);
                }
            }
        });
        let shared = Arc::new(Shared { model: Arc::clone(&model), fault, mute: Mutex::new(false) });
        let serving = tokio::spawn(serve(listener, Arc::clone(&shared)));
        Ok(SimulatedBender { model, shared, address, tasks: [cycle, serving] })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers again after `silent-after-commit`.
    pub fn unmute(&self) {
        *lock(&self.shared.mute) = false;
    }

    /// Looks at the machine, or acts as its operator.
    pub fn with<R>(&self, action: impl FnOnce(&mut MachineModel) -> R) -> R {
        action(&mut lock(&self.model))
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

#[derive(Debug)]
struct Shared {
    model: Arc<Mutex<MachineModel>>,
    fault: Option<Fault>,
    /// Answers nothing any more.
    mute: Mutex<bool>,
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
        let answer = self.answer(&request);
        let delay = match self.shared.fault {
            Some(Fault::Late { ms }) => Duration::from_millis(ms),
            _ => Duration::ZERO,
        };
        Box::pin(async move {
            tokio::time::sleep(delay).await;
            answer
        })
    }
}

impl Connection {
    fn answer(&self, request: &SlaveRequest) -> Answer {
        let mut model = lock(&self.shared.model);
        let mut mute = lock(&self.shared.mute);
        if *mute || self.shared.fault == Some(Fault::Silent) {
            return Ok(None);
        }
        if self.shared.fault == Some(Fault::Busy) {
            return Err(ExceptionCode::ServerDeviceBusy);
        }
        if request.slave != model.unit_id() {
            return Err(ExceptionCode::GatewayTargetDevice);
        }
        match &request.request {
            Request::ReadHoldingRegisters(address, count) => {
                let words = model.read(*address, *count).map_err(exception)?;
                Ok(Some(Response::ReadHoldingRegisters(words)))
            }
            Request::WriteMultipleRegisters(address, words) => {
                let commits = *address == model.commit_address();
                if commits && self.shared.fault == Some(Fault::DropBeforeApply) {
                    return self.hang_up();
                }
                model.write(*address, words).map_err(exception)?;
                match self.shared.fault {
                    Some(Fault::DropAfterApply) if commits => return self.hang_up(),
                    Some(Fault::SilentAfterCommit) if commits => {
                        *mute = true;
                        return Ok(None);
                    }
                    _ => {}
                }
                let count = u16::try_from(words.len()).map_err(|_| ExceptionCode::IllegalDataValue)?;
                Ok(Some(Response::WriteMultipleRegisters(*address, count)))
            }
            _ => Err(ExceptionCode::IllegalFunction),
        }
    }

    fn hang_up(&self) -> Answer {
        let _ = self.cut.shutdown(Shutdown::Both); // already closed is closed
        Ok(None)
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
