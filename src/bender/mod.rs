//! The machine: profiles, links, and the stage-verify-commit handshake, the only gate to it.
//!
//! A table comes in from `correct` or the command line as a [`Job`]; [`deliver`] drives the pure state machine
//! [`Delivery`] over a [`Bender`] and answers with an [`Outcome`]. On the way:
//!
//! ```text
//! profile   what one machine is: addresses, scales, limits, deadlines (protocols/*.toml)
//! transport which link leads there
//! limits    the gate's figures: travel, clamp lengths, row count
//! wire      tables to bytes and back, CRC, status word by word
//! delivery  stage, verify, commit: events and time in, one action out
//! driver    performs the actions on a link and a journal
//! contact   when a link connects, asks, keeps silent: events and time in, one action out
//! modbus    the Modbus link: TCP, RTU, RTU over TCP
//! plan      the requests that a profile asks for
//! line      a line under it: no old reply is taken for a new one
//! ```

mod contact;
mod delivery;
mod driver;
mod limits;
mod line;
mod link;
mod modbus;
mod open;
pub mod plan;
mod profile;
mod profile_file;
mod profile_transport;
mod rs485;
mod transport;
mod wire;

pub use contact::RulesError;
pub use delivery::{Action, Delivery, Event, Intent, Job, Outcome, gate, prepare};
pub use driver::{IntentLog, LogError, deliver};
pub use limits::{Reason, check_limits};
pub use line::Wire;
pub use link::{ActiveTable, Bender, LinkError};
pub use modbus::ModbusLink;
pub use open::{Opener, serial_port};
pub use profile::{Deadlines, ModbusFormat, Profile, Registers, StateBit, TableFormat, WordOrder};
pub use profile_file::shipped_profiles;
pub use transport::{LineSettings, Parity, SerialSettings, Transport};
pub use wire::{
    Ack, Staged, Status, TableId, check_program, commit_image, crc_of, decode_payload, decode_status,
    encode_payload, payload_bytes, staging_image, status_span,
};
