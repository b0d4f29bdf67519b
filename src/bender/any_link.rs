//! The link that a profile asks for.

use super::contact::RulesError;
use super::direct::DirectLink;
use super::folder::SharedFolder;
use super::link::{ActiveTable, Bender, LinkError};
use super::modbus::ModbusLink;
use super::open::Opener;
use super::profile::Profile;
use super::serial_table::SerialTable;
use super::table_link::TableLink;
use super::transport::{Device, Transport};
use super::wire::{Staged, Status, TableId};

/// A link of any kind.
pub enum Link {
    /// Modbus, whatever it goes over.
    Modbus(Box<ModbusLink>),
    /// Modbus, with rows that are in force as soon as they are written.
    Direct(Box<DirectLink>),
    /// A serial port with a protocol of its own.
    Serial(Box<TableLink<SerialTable>>),
    /// A folder that both reach.
    Folder(Box<TableLink<SharedFolder>>),
}

impl Link {
    /// A link that connects at its first use; `endpoint` is what the profile's transport takes.
    pub fn new(profile: Profile, endpoint: impl Into<String>) -> Result<Link, RulesError> {
        Link::made(profile, endpoint.into(), None)
    }

    /// The same over wires that `opener` makes; the endpoint is their name.
    pub fn over(profile: Profile, endpoint: impl Into<String>, opener: Opener) -> Result<Link, RulesError> {
        Link::made(profile, endpoint.into(), Some(opener))
    }

    fn made(profile: Profile, endpoint: String, opener: Option<Opener>) -> Result<Link, RulesError> {
        Ok(match &profile.transport {
            Transport::ModbusTcp(device)
            | Transport::ModbusRtu(device, ..)
            | Transport::ModbusRtuOverTcp(device, _) => match device.clone() {
                Device::Staged(map) => {
                    Link::Modbus(Box::new(ModbusLink::new(profile, map, endpoint, opener)?))
                }
                Device::Direct(map) => {
                    Link::Direct(Box::new(DirectLink::new(profile, map, endpoint, opener)?))
                }
            },
            Transport::SerialTable(unit, ..) => {
                let protocol = SerialTable::new(&profile, *unit, opener);
                Link::Serial(Box::new(TableLink::new(profile, protocol, endpoint)?))
            }
            Transport::Folder(number) => {
                let protocol = SharedFolder::new(&profile, *number);
                Link::Folder(Box::new(TableLink::new(profile, protocol, endpoint)?))
            }
        })
    }
}

/// The same call to whichever link there is.
macro_rules! each {
    ($link:expr, $inner:ident => $call:expr) => {
        match $link {
            Link::Modbus($inner) => $call,
            Link::Direct($inner) => $call,
            Link::Serial($inner) => $call,
            Link::Folder($inner) => $call,
        }
    };
}

impl Bender for Link {
    fn profile(&self) -> &Profile {
        each!(self, link => link.profile())
    }

    fn endpoint(&self) -> &str {
        each!(self, link => link.endpoint())
    }

    fn reset(&mut self) {
        each!(self, link => link.reset());
    }

    async fn read_status(&mut self) -> Result<Status, LinkError> {
        each!(self, link => link.read_status().await)
    }

    async fn write_staging(&mut self, staged: &Staged) -> Result<(), LinkError> {
        each!(self, link => link.write_staging(staged).await)
    }

    async fn read_staging(&mut self, bytes: usize) -> Result<Vec<u8>, LinkError> {
        each!(self, link => link.read_staging(bytes).await)
    }

    async fn commit(&mut self, id: TableId) -> Result<(), LinkError> {
        each!(self, link => link.commit(id).await)
    }

    async fn read_active(&mut self) -> Result<ActiveTable, LinkError> {
        each!(self, link => link.read_active().await)
    }
}
