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
    /// RTU on a line, which people know by this name.
    Line(Box<dyn Wire>, String),
    /// Wires in memory, one after the other.
    Memory(Framing, UnboundedReceiver<DuplexStream>),
}

impl Door {
    /// Opens where machines of a transport are reached, and what must be kept meanwhile: a host and port, or the path of a serial
    /// port ([`machine_end`]). Must be called inside a tokio runtime.
    pub async fn open(transport: &Transport, on: &str) -> io::Result<(Door, Option<Kept>)> {
        Ok(match transport {
            Transport::ModbusTcp => (Door::Socket(Framing::Tcp, TcpListener::bind(on).await?), None),
            Transport::ModbusRtuOverTcp(_) => {
                (Door::Socket(Framing::Rtu, TcpListener::bind(on).await?), None)
            }
            Transport::ModbusRtu(_, settings) => {
                let end = machine_end(Path::new(on), settings)?;
                (Door::Line(Box::new(end.wire), on.to_owned()), end.kept)
            }
        })
    }

    /// What a link is told to reach it.
    pub fn address(&self) -> io::Result<String> {
        Ok(match self {
            Door::Socket(_, listener) => listener.local_addr()?.to_string(),
            Door::Line(_, name) => name.clone(),
            Door::Memory(..) => "in memory".to_owned(),
        })
    }
}
