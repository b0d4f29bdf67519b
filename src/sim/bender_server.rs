//! The simulated bender on its links: its program cycle, and a station for whoever comes through its door.

use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::Instant;

use super::bender::{MachineEvent, MachineModel};
use super::can_station::CanStation;
use super::door::{Door, Speech};
use super::faults::Fault;
use super::folder_station::FolderStation;
use super::frames::Framing;
use super::modbus_station::ModbusStation;
use super::sdo_server::SdoServer;
use super::serial_station::SerialStation;
use super::serve::{CYCLE, Ended, Shared, WirePort, lock, serve};
use super::trouble::{When, WireFaults};
use crate::bender::Transport;

/// A bus that was lost is tried again after this.
const REJOIN: Duration = Duration::from_millis(100);

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
            happened: Mutex::new(Vec::new()),
        });
        let ticking = Arc::clone(&shared);
        let cycle = tokio::spawn(async move {
            let (mut interval, begun) = (tokio::time::interval(CYCLE), Instant::now());
            loop {
                interval.tick().await;
                let event = lock(&ticking.model).tick();
                if matches!(event, Some(MachineEvent::TakenOver { .. })) {
                    ticking.pass(When::TakenOver);
                }
                ticking.pass(When::Ms(begun.elapsed().as_millis() as u64));
                let happened = std::mem::take(&mut *lock(&ticking.happened));
                event
                    .into_iter()
                    .chain(happened.into_iter().map(MachineEvent::Trouble))
                    .for_each(&mut on_event);
            }
        });
        let serving = tokio::spawn(serve_door(door, Arc::clone(&shared)));
        Ok(SimulatedBender { shared, address, tasks: [cycle, serving] })
    }

    /// Where it is reached.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// What happens to it and to its answers on the wire from now on.
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

/// All wires that the door lets in. A line and a folder cannot be cut: they are served on.
async fn serve_door(door: Door, shared: Arc<Shared>) {
    match door {
        Door::Line(speech, mut wire, _) => {
            while serve_wire(&mut wire, speech, &shared).await == Ended::HungUp {}
        }
        Door::Folder(mut port, _, profile) => {
            let mut station = FolderStation::new(*profile);
            while serve(&mut *port, &mut station, &shared).await == Ended::HungUp {}
        }
        Door::Bus(mut join, _, profile) => loop {
            match (join(), &profile.transport) {
                (Ok(mut port), Transport::Canopen(settings)) => {
                    serve(&mut port, &mut SdoServer::new(settings.clone()), &shared).await;
                }
                (Ok(mut port), _) => {
                    serve(&mut port, &mut CanStation::new(), &shared).await;
                }
                (Err(_), _) => {} // away; it may come back
            }
            tokio::time::sleep(REJOIN).await;
        },
        Door::Memory(speech, mut wires) => {
            while let Some(mut wire) = wires.recv().await {
                serve_wire(&mut wire, speech, &shared).await;
            }
        }
        Door::Socket(framing, listener) => serve_socket(&listener, framing, &shared).await,
    }
}

/// Over TCP several at once; a device server has one line, and one connection after the other.
async fn serve_socket(listener: &TcpListener, framing: Framing, shared: &Arc<Shared>) {
    let mut connections = JoinSet::new();
    loop {
        let mut stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::error!(%error, "the simulated bender no longer takes connections");
                return;
            }
        };
        let _ = stream.set_nodelay(true); // answers would only be slower without
        match framing {
            Framing::Rtu => {
                serve_wire(&mut stream, Speech::Modbus(framing), shared).await;
            }
            Framing::Tcp => {
                let shared = Arc::clone(shared);
                connections
                    .spawn(async move { serve_wire(&mut stream, Speech::Modbus(framing), &shared).await });
            }
        }
    }
}

async fn serve_wire(
    wire: &mut (impl AsyncRead + AsyncWrite + Unpin + Send),
    speech: Speech,
    shared: &Shared,
) -> Ended {
    let mut port = WirePort(wire);
    match speech {
        Speech::Modbus(framing) => serve(&mut port, &mut ModbusStation::new(framing), shared).await,
        Speech::SerialTable(unit) => serve(&mut port, &mut SerialStation::new(unit), shared).await,
    }
}
