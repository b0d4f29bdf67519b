//! Where a simulated bender is reached: a socket, a serial line, a wire in memory.

use std::io;
use std::path::Path;

use tokio::io::DuplexStream;
use tokio::net::TcpListener;
use tokio::sync::mpsc::UnboundedReceiver;

use super::frames::Framing;
use super::pty::{Kept, machine_end};
use crate::bender::{Transport, Wire};

/// A door that is open.
pub enum Door {
    /// A socket and how requests are framed on its connections.
    Socket(Framing, TcpListener),
    /// A line, which people know by this name.
    Line(Speech, Box<dyn Wire>, String),
    /// Wires in memory, one after the other.
    Memory(Speech, UnboundedReceiver<DuplexStream>),
}

/// What is spoken on a wire of bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Speech {
    /// Modbus, framed so.
    Modbus(Framing),
    /// The serial table protocol, by the machine of this number.
    SerialTable(u8),
}

impl Speech {
    /// What machines of a transport speak.
    pub fn of(transport: &Transport) -> Speech {
        match transport {
            Transport::ModbusTcp(_) => Speech::Modbus(Framing::Tcp),
            Transport::ModbusRtu(..) | Transport::ModbusRtuOverTcp(..) => Speech::Modbus(Framing::Rtu),
            Transport::SerialTable(unit, ..) => Speech::SerialTable(*unit),
        }
    }
}

impl Door {
    /// Opens where machines of a transport are reached, and what must be kept meanwhile: a host and port, or the path of a serial
    /// port ([`machine_end`]). Must be called inside a tokio runtime.
    pub async fn open(transport: &Transport, on: &str) -> io::Result<(Door, Option<Kept>)> {
        Ok(match transport {
            Transport::ModbusTcp(_) => (Door::Socket(Framing::Tcp, TcpListener::bind(on).await?), None),
            Transport::ModbusRtuOverTcp(..) => {
                (Door::Socket(Framing::Rtu, TcpListener::bind(on).await?), None)
            }
            Transport::ModbusRtu(.., settings) | Transport::SerialTable(.., settings) => {
                let end = machine_end(Path::new(on), settings)?;
                (Door::Line(Speech::of(transport), Box::new(end.wire), on.to_owned()), end.kept)
            }
        })
    }

    /// What a link is told to reach it.
    pub fn address(&self) -> io::Result<String> {
        Ok(match self {
            Door::Socket(_, listener) => listener.local_addr()?.to_string(),
            Door::Line(_, _, name) => name.clone(),
            Door::Memory(..) => "in memory".to_owned(),
        })
    }
}
