//! Opens what leads to a machine: a socket, a serial port, or what stands for one.
//!
//! Under the links, which decide when.

use std::io;

use tokio_modbus::Slave;
use tokio_modbus::client::{Context, tcp};
use tokio_serial::{DataBits, SerialPortBuilderExt as _, SerialStream, StopBits};

use super::line::{Line, Wire};
use super::profile::Profile;
use super::recording::{Frames, Recorded};
use super::rs485;
use super::socket::Socket;
use super::transport::{Parity, SerialSettings};

/// What leads to the machine, open.
pub enum Connection {
    /// A stream: one client as long as it lives.
    Stream(Context),
    /// A line: a new client for every request, so that nothing of the last one is left in it.
    Line(Line),
}

/// Opens a wire that is no device of this computer: one in memory.
pub type Opener = Box<dyn FnMut() -> io::Result<Box<dyn Wire>> + Send>;

/// Opens the way to a Modbus device.
pub async fn open(
    profile: &Profile,
    unit_id: u8,
    endpoint: &str,
    opener: Option<&mut Opener>,
    frames: &Frames,
) -> io::Result<Connection> {
    let wire = wire(profile, endpoint, opener, frames).await?;
    Ok(match profile.transport.line() {
        None => Connection::Stream(tcp::attach_slave(wire, Slave(unit_id))),
        Some(line) => Connection::Line(Line::new(wire, line.echo)),
    })
}

/// What a profile's transport leads over; what goes over it is kept in `frames` for a while.
pub async fn wire(
    profile: &Profile,
    endpoint: &str,
    opener: Option<&mut Opener>,
    frames: &Frames,
) -> io::Result<Box<dyn Wire>> {
    let wire: Box<dyn Wire> = match (opener, profile.transport.serial()) {
        (Some(opener), _) => opener()?,
        (None, Some(settings)) => Box::new(serial_port(endpoint, settings)?),
        (None, None) => Box::new(Socket::connect(endpoint).await?),
    };
    Ok(Box::new(Recorded::new(wire, frames.clone())))
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
