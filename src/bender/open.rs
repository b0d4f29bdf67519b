//! Opens what leads to a Modbus machine: a socket, a serial port, or what stands for one.
//!
//! Under `modbus`, which decides when.

use std::io;

use tokio::net::TcpStream;
use tokio_modbus::Slave;
use tokio_modbus::client::{Context, tcp};
use tokio_serial::{DataBits, SerialPortBuilderExt as _, SerialStream, StopBits};

use super::line::{Line, Wire};
use super::profile::Profile;
use super::rs485;
use super::transport::{Parity, SerialSettings, Transport};

/// What leads to the machine, open.
pub enum Connection {
    /// A stream: one client as long as it lives.
    Stream(Context),
    /// A line: a new client for every request, so that nothing of the last one is left in it.
    Line(Line),
}

/// Opens a wire that is no device of this computer: one in memory.
pub type Opener = Box<dyn FnMut() -> io::Result<Box<dyn Wire>> + Send>;

/// Opens what a profile's transport leads over.
pub async fn open(profile: &Profile, endpoint: &str, opener: Option<&mut Opener>) -> io::Result<Connection> {
    let wire: Box<dyn Wire> = match (opener, &profile.transport) {
        (Some(opener), _) => opener()?,
        (None, Transport::ModbusTcp | Transport::ModbusRtuOverTcp(_)) => Box::new(socket(endpoint).await?),
        (None, Transport::ModbusRtu(_, settings)) => Box::new(serial_port(endpoint, settings)?),
    };
    Ok(match profile.transport.line() {
        None => Connection::Stream(tcp::attach_slave(wire, Slave(profile.unit_id))),
        Some(line) => Connection::Line(Line::new(wire, line.echo)),
    })
}

async fn socket(endpoint: &str) -> io::Result<TcpStream> {
    let stream = TcpStream::connect(endpoint).await?;
    // Small requests wait for each other otherwise; a socket that cannot do this still works.
    let _ = stream.set_nodelay(true);
    Ok(stream)
}

/// Opens a serial port for this process alone.
pub fn serial_port(path: &str, settings: &SerialSettings) -> io::Result<SerialStream> {
    let parity = match settings.parity {
        Parity::None => tokio_serial::Parity::None,
        Parity::Even => tokio_serial::Parity::Even,
        Parity::Odd => tokio_serial::Parity::Odd,
    };
    let stop_bits = if settings.stop_bits == 2 { StopBits::Two } else { StopBits::One };
    let builder =
        tokio_serial::new(path, settings.baud).data_bits(DataBits::Eight).parity(parity).stop_bits(stop_bits);
    let port = builder.open_native_async().map_err(|error| explain(error, path))?;
    if settings.rs485 {
        rs485::enable(&port)?;
    }
    Ok(port)
}

/// The library says "no such device" of a port that another process has open.
fn explain(error: tokio_serial::Error, path: &str) -> io::Error {
    let exists = std::path::Path::new(path).exists();
    if exists && matches!(error.kind, tokio_serial::ErrorKind::NoDevice) {
        let why = "another program has it open, or it is no serial port";
        return io::Error::new(io::ErrorKind::ResourceBusy, why);
    }
    io::Error::from(error)
}
