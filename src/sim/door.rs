//! Where a simulated bender is reached: a socket, a serial line, a folder, a bus, a wire in memory.

use std::io;
use std::path::Path;
use std::time::Duration;

use tokio::io::DuplexStream;
use tokio::net::TcpListener;
use tokio::sync::mpsc::UnboundedReceiver;

use super::frames::Framing;
use super::pty::{Kept, machine_end};
use super::serve::CYCLE;
use crate::bender::can::{CanPort, open_port};
use crate::bender::{FolderPort, Profile, Transport, Wire};

/// A door that is open.
pub enum Door {
    /// A socket and how requests are framed on its connections.
    Socket(Framing, TcpListener),
    /// A line, which people know by this name.
    Line(Speech, Box<dyn Wire>, String),
    /// Wires in memory, one after the other.
    Memory(Speech, UnboundedReceiver<DuplexStream>),
    /// The machine's end of a folder, which people know by this name, and what kind of machine.
    Folder(Box<FolderPort>, String, Box<Profile>),
    /// A place on a bus, which people know by this name; taken anew when it is lost.
    Bus(BusDoor, String, Box<Profile>),
}

/// Takes a place on a bus.
pub type BusDoor = Box<dyn FnMut() -> io::Result<CanPort> + Send>;

/// How long a full bus is waited for.
pub const BUS_PATIENCE: Duration = Duration::from_secs(1);

/// What is spoken on a wire of bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Speech {
    /// Modbus, framed so.
    Modbus(Framing),
    /// The serial table protocol, by the machine of this number.
    SerialTable(u8),
}

impl Speech {
    /// What machines of a transport speak on a wire; none where there is none.
    pub fn of(transport: &Transport) -> Option<Speech> {
        match transport {
            Transport::ModbusTcp(_) => Some(Speech::Modbus(Framing::Tcp)),
            Transport::ModbusRtu(..) | Transport::ModbusRtuOverTcp(..) => Some(Speech::Modbus(Framing::Rtu)),
            Transport::SerialTable(unit, ..) => Some(Speech::SerialTable(*unit)),
            Transport::Folder(_) | Transport::Can(_) | Transport::Canopen(_) => None,
        }
    }
}

impl Door {
    /// Opens where a machine of this profile is reached, and what must be kept meanwhile: a host and port, the path of a serial
    /// port ([`machine_end`]), a folder, a CAN interface. Must be called inside a tokio runtime.
    pub async fn open(profile: &Profile, on: &str) -> io::Result<(Door, Option<Kept>)> {
        let line = |speech, settings| -> io::Result<_> {
            let end = machine_end(Path::new(on), settings)?;
            Ok((Door::Line(speech, Box::new(end.wire), on.to_owned()), end.kept))
        };
        Ok(match &profile.transport {
            Transport::ModbusTcp(_) => (Door::Socket(Framing::Tcp, TcpListener::bind(on).await?), None),
            Transport::ModbusRtuOverTcp(..) => {
                (Door::Socket(Framing::Rtu, TcpListener::bind(on).await?), None)
            }
            Transport::Can(_) | Transport::Canopen(_) => (Door::interface(profile, on)?, None),
            Transport::ModbusRtu(.., settings) => line(Speech::Modbus(Framing::Rtu), settings)?,
            Transport::SerialTable(unit, _, settings) => line(Speech::SerialTable(*unit), settings)?,
            Transport::Folder(number) => (Door::folder(profile, *number, on)?, None),
        })
    }

    /// A CAN interface of this computer.
    fn interface(profile: &Profile, on: &str) -> io::Result<Door> {
        let fd = matches!(&profile.transport, Transport::Can(can) if can.fd);
        let name = on.to_owned();
        let join = move || open_port(&name, None, fd, BUS_PATIENCE);
        drop(join()?); // what is wrong with it shows at once
        Ok(Door::Bus(Box::new(join), on.to_owned(), Box::new(profile.clone())))
    }

    /// The machine's end of a folder.
    pub fn folder(profile: &Profile, number: u16, on: &str) -> io::Result<Door> {
        let port = FolderPort::of_machine(Path::new(on), number, CYCLE, profile.deadlines.request)?;
        Ok(Door::Folder(Box::new(port), on.to_owned(), Box::new(profile.clone())))
    }

    /// What a link is told to reach it.
    pub fn address(&self) -> io::Result<String> {
        Ok(match self {
            Door::Socket(_, listener) => listener.local_addr()?.to_string(),
            Door::Line(_, _, name) | Door::Folder(_, name, _) | Door::Bus(_, name, _) => name.clone(),
            Door::Memory(..) => "in memory".to_owned(),
        })
    }
}
