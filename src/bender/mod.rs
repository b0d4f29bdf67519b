//! The machine: profiles, links, and the stage-verify-commit handshake, the only gate to it.
//!
//! A table comes in from `correct` or the command line as a [`Job`]; [`deliver`] drives the pure state machine
//! [`Delivery`] over a [`Bender`] and answers with an [`Outcome`]. On the way:
//!
//! ```text
//! profile       what one machine is: addresses, scales, limits, deadlines (protocols/*.toml)
//! transport     which link leads there
//! limits        the gate's figures: travel, clamp lengths, row count
//! rows          tables to the machine's whole steps and back; wire: to bytes and back, CRC
//! delivery      stage, verify, commit: events and time in, one action out
//! recall        a correction applies to what was committed last, or not at all
//! driver        performs the actions on a link and a journal
//! contact       when a link connects, asks, keeps silent: events and time in, one action out
//! caller        one machine's connection, under every link
//! any_link      the link that a profile asks for
//!
//! modbus        machines with registers: TCP, RTU, RTU over TCP; modbus_client: one request after the other
//! direct        machines whose rows are in force as soon as they are written
//! registers     where their values are; plan: the requests that makes
//!
//! table_link    machines with objects: one exchange after the other
//! exchange      what is asked, and a protocol's side of it as a pure machine
//! serial_table  such a protocol, on a serial port; serial_frame: its frames
//! folder        another, with files in a folder; folder_text: what is in them; folder_port: how they get there
//! can_table     another, with messages on CAN; sdo: CANopen's; can: frames and buses; dbc: which bits are which value
//! status_image  the status as one row of bytes
//!
//! line          a line under it all: no old reply is taken for a new one
//! ring          the last frames of a link; recording feeds it
//!
//! selftest      whether a real machine is what its profile says, and what to change; selftest_advice: in words
//! ```

mod any_link;
mod caller;
pub mod can;
mod can_table;
mod contact;
mod dbc;
mod delivery;
mod direct;
mod driver;
mod exchange;
mod folder;
mod folder_port;
pub mod folder_text;
mod limits;
mod line;
mod line_port;
mod link;
mod modbus;
mod modbus_client;
mod open;
pub mod plan;
mod profile;
mod profile_can;
mod profile_file;
mod profile_modbus;
mod profile_raw;
mod profile_transport;
mod recall;
mod recording;
mod registers;
mod ring;
mod rows;
mod rs485;
mod sdo;
pub mod selftest;
mod selftest_advice;
mod selftest_endpoint;
mod selftest_judge;
mod serial_frame;
mod serial_table;
mod socket;
mod status_image;
mod table_link;
mod transport;
mod wire;

pub use any_link::Link;
pub use can_table::{CanSettings, CanTable};
pub use contact::RulesError;
pub use dbc::{Database, DbcError};
pub use delivery::{Action, Delivery, Event, Intent, Job, Outcome, gate, prepare};
pub use direct::DirectMap;
pub use driver::{IntentLog, LogError, deliver};
pub use exchange::{
    Action as ExchangeAction, Ask, Event as ExchangeEvent, Exchange, Failure, Port, Protocol,
};
pub use folder::SharedFolder;
pub use folder_port::{FolderPort, Letter};
pub use limits::{Reason, check_limits};
pub use line::Wire;
pub use link::{ActiveTable, Bender, LinkError};
pub use open::{Opener, serial_port};
pub use profile::{Deadlines, Profile, Sequence, StateBit, TableFormat, WordOrder};
pub use profile_file::shipped_profiles;
pub use profile_raw::profile_schema;
pub use recall::{Operation, objections};
pub use recording::Frames;
pub use registers::{Field, ModbusMap, Registers, decode_status, fields, status_span};
pub use ring::{Content, Direction};
pub use sdo::{Canopen, CanopenSettings, Object as SdoObject};
pub use serial_table::{PIECE as SERIAL_PIECE, SerialTable};
pub use status_image::{decode_status_image, status_bytes};
pub use transport::{Device, LineSettings, Parity, SerialSettings, Transport};
pub use wire::{
    Ack, Staged, Status, TableId, check_program, commit_image, crc_of, decode_payload, encode_payload,
    payload_bytes, staging_image,
};
