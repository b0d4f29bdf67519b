//! Which link leads to a machine, and what is known of it: addresses, line, serial port. Read from a profile's file
//! (`profile_transport`).

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use schemars::JsonSchema;
use serde::Deserialize;

use super::can::FrameId;
use super::can_table::CanSettings;
use super::direct::DirectMap;
use super::registers::ModbusMap;
use super::sdo::{CanopenSettings, cob_ids};
use crate::config::{HOST_PORT, is_device, is_host_port, is_interface};

/// Which link leads to the machine.
#[derive(Debug, Clone, PartialEq)]
pub enum Transport {
    /// Modbus TCP. A stream: dropped on any doubt.
    ModbusTcp(Device),
    /// Modbus RTU on a serial port of this computer.
    ModbusRtu(Device, LineSettings, SerialSettings),
    /// Modbus RTU's frames over TCP, as device servers for serial lines pass them on.
    ModbusRtuOverTcp(Device, LineSettings),
    /// The serial table protocol on a serial port, with the machine of this number.
    SerialTable(u8, LineSettings, SerialSettings),
    /// Files in a folder that both reach, for the bender of this number.
    Folder(u16),
    /// Messages on CAN that a database describes.
    Can(CanSettings),
    /// Objects of a dictionary on CANopen.
    Canopen(CanopenSettings),
}

/// What a machine has to itself at an address that others may have, too.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Claim {
    /// The files of this number.
    Files(u16),
    /// Frames of this identifier.
    Frames(FrameId),
}

impl Transport {
    /// Whether an endpoint has the form that this transport takes; the machine is not looked up.
    pub fn takes(&self, endpoint: &str) -> bool {
        match self {
            Transport::ModbusTcp(_) | Transport::ModbusRtuOverTcp(..) => is_host_port(endpoint),
            Transport::ModbusRtu(..) | Transport::SerialTable(..) => is_device(endpoint),
            Transport::Folder(_) => Path::new(endpoint).is_absolute(),
            Transport::Can(_) | Transport::Canopen(_) => is_interface(endpoint),
        }
    }

    /// Whether that form is a file's path.
    pub fn is_path(&self) -> bool {
        self.serial().is_some() || matches!(self, Transport::Folder(_))
    }

    /// That form in words.
    pub fn form(&self) -> &'static str {
        match self {
            Transport::ModbusTcp(_) | Transport::ModbusRtuOverTcp(..) => HOST_PORT,
            Transport::ModbusRtu(..) | Transport::SerialTable(..) => {
                "the path of a serial port, best one that does not change: \"/dev/serial/by-id/...\""
            }
            Transport::Folder(_) => "the path of a folder, from the root: \"/srv/benders\"",
            Transport::Can(_) | Transport::Canopen(_) => {
                "the name of a CAN interface, \"can0\": a letter, then up to 14 letters and digits"
            }
        }
    }

    /// What of its address belongs to this machine, so that another that takes none of it can have the same address: a number in a folder,
    /// identifiers on a bus. None: all of it.
    pub fn claims(&self) -> Option<BTreeSet<Claim>> {
        let ids = |ids: &[FrameId]| Some(ids.iter().copied().map(Claim::Frames).collect());
        match self {
            Transport::Folder(number) => Some(BTreeSet::from([Claim::Files(*number)])),
            Transport::Can(settings) => ids(&settings.contract.ids()),
            Transport::Canopen(settings) => {
                let (request, response) = cob_ids(settings.node);
                ids(&[request, response])
            }
            // One at a time is asked on a line, and a gateway's unit numbers are no proof that there are two machines.
            _ => None,
        }
    }

    /// What is known of the line, where there is one.
    pub fn line(&self) -> Option<&LineSettings> {
        match self {
            Transport::ModbusTcp(_) | Transport::Folder(_) | Transport::Can(_) | Transport::Canopen(_) => {
                None
            }
            Transport::ModbusRtu(_, line, _)
            | Transport::ModbusRtuOverTcp(_, line)
            | Transport::SerialTable(_, line, _) => Some(line),
        }
    }

    /// The place of a byte in the staging area, for people.
    pub fn staging_place(&self, byte: usize) -> String {
        match self.modbus() {
            Some(map) => format!("register {}", usize::from(map.registers.staging) + byte / 2),
            None => format!("byte {byte}"),
        }
    }

    /// What is behind Modbus, where that is spoken.
    pub fn device(&self) -> Option<&Device> {
        match self {
            Transport::ModbusTcp(device)
            | Transport::ModbusRtu(device, ..)
            | Transport::ModbusRtuOverTcp(device, _) => Some(device),
            Transport::SerialTable(..) | Transport::Folder(_) | Transport::Can(_) | Transport::Canopen(_) => {
                None
            }
        }
    }

    /// The map of a machine with a staging area in registers.
    pub fn modbus(&self) -> Option<&ModbusMap> {
        match self.device()? {
            Device::Staged(map) => Some(map),
            Device::Direct(_) => None,
        }
    }

    /// The map of a machine whose rows are written directly.
    pub fn direct(&self) -> Option<&DirectMap> {
        match self.device()? {
            Device::Direct(map) => Some(map),
            Device::Staged(_) => None,
        }
    }

    /// The port's settings, where it is one of this computer's.
    pub fn serial(&self) -> Option<&SerialSettings> {
        match self {
            Transport::ModbusRtu(.., serial) | Transport::SerialTable(.., serial) => Some(serial),
            _ => None,
        }
    }
}

/// What is behind Modbus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Device {
    /// A machine with staging area, commit and status.
    Staged(ModbusMap),
    /// One whose rows are in force as soon as they are written.
    Direct(DirectMap),
}

impl Device {
    /// Unit identifier.
    pub fn unit_id(&self) -> u8 {
        match self {
            Device::Staged(map) => map.unit_id,
            Device::Direct(map) => map.unit_id,
        }
    }
}

/// A line: it cannot be closed, so what is still under way arrives.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LineSettings {
    /// After so long no reply comes any more; nothing is asked for this long after a doubt.
    pub quiet: Duration,
    /// Whether it gives back what is sent.
    pub echo: bool,
}

/// Settings of a serial port. Eight data bits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialSettings {
    /// Bits per second.
    pub baud: u32,
    /// Parity bit.
    pub parity: Parity,
    /// Stop bits, 1 or 2.
    pub stop_bits: u8,
    /// Whether the kernel switches an RS-485 transceiver's direction.
    pub rs485: bool,
}

impl SerialSettings {
    /// Silence that ends a frame: three and a half characters, 1.75 ms above 19200 baud (Modbus over serial line 1.02,
    /// section 2.5.1.1).
    pub fn gap(&self) -> Duration {
        let bits = 9 + u32::from(self.parity != Parity::None) + u32::from(self.stop_bits);
        if self.baud > 19_200 {
            return Duration::from_micros(1750);
        }
        Duration::from_secs_f64(3.5 * f64::from(bits) / f64::from(self.baud))
    }
}

/// Parity bit of a character.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Parity {
    /// No such bit.
    None,
    /// An even number of ones.
    Even,
    /// An odd one.
    Odd,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_ends_with_three_and_a_half_characters_of_silence() {
        let serial = |baud, parity, stop_bits| SerialSettings { baud, parity, stop_bits, rs485: false };
        // 11 bits a character: 3.5 x 11 / 9600.
        assert_eq!(serial(9600, Parity::Even, 1).gap().as_micros(), 4010);
        assert_eq!(serial(9600, Parity::None, 1).gap().as_micros(), 3645);
        assert_eq!(serial(115_200, Parity::Even, 1).gap().as_micros(), 1750);
    }
}
