//! What every link to a machine can do, and how it fails.
//!
//! A link keeps no opinion: it reads and writes what the delivery asks for, once, within its deadline. After
//! any doubt (timeout, wrong length, wrong header) it drops the connection and says so.

use std::future::Future;

use thiserror::Error;

use super::profile::Profile;
use super::wire::{Staged, Status, TableId, crc_of};

/// Why a request did not do what was asked. Whether a write was applied is then not known.
#[derive(Debug, Error)]
pub enum LinkError {
    /// No connection.
    #[error("{endpoint}: cannot connect: {why}; check that the machine is on and its address right")]
    Connect {
        /// Where.
        endpoint: String,
        /// What the system said.
        why: String,
    },
    /// It failed a moment ago and is not tried again yet.
    #[error(
        "{endpoint}: not connected ({failures} failures since its last answer), the next attempt is due in {ms} ms"
    )]
    Resting {
        /// Where.
        endpoint: String,
        /// Failures since the last answer.
        failures: u32,
        /// Milliseconds to the next.
        ms: u64,
    },
    /// Something else answered than the machine.
    #[error(
        "{endpoint}: what answers there is not this machine (see the error before); it is left alone for another {ms} ms, or \
         until the cell is armed anew"
    )]
    Foreign {
        /// Where.
        endpoint: String,
        /// Milliseconds to the next look.
        ms: u64,
    },
    /// What a command rests on may no longer be so.
    #[error(
        "{endpoint}: the connection failed after the machine's state was read; {what} was not sent, since what was read may no \
         longer be so"
    )]
    Outdated {
        /// Where.
        endpoint: String,
        /// What was to be done, with the address.
        what: String,
    },
    /// No reply in time.
    #[error(
        "{endpoint}: no answer within {ms} ms when {what}; the connection was dropped, a late answer is not used"
    )]
    Timeout {
        /// Where.
        endpoint: String,
        /// What was asked, with the address.
        what: String,
        /// The deadline.
        ms: u128,
    },
    /// The connection broke or the reply was no Modbus.
    #[error("{endpoint}: the connection failed when {what}: {why}")]
    Broken {
        /// Where.
        endpoint: String,
        /// What was asked, with the address.
        what: String,
        /// What was seen.
        why: String,
    },
    /// The machine refused the request itself.
    #[error("{endpoint}: the machine refused {what}: {exception}")]
    Exception {
        /// Where.
        endpoint: String,
        /// What was asked, with the address.
        what: String,
        /// Modbus exception with its number.
        exception: String,
    },
    /// The machine has no time for the request now.
    #[error("{endpoint}: the machine was busy at {what}")]
    Busy {
        /// Where.
        endpoint: String,
        /// What was asked.
        what: String,
    },
    /// An answer that cannot be right.
    #[error("{endpoint}: {why}")]
    Nonsense {
        /// Where.
        endpoint: String,
        /// What is wrong with it.
        why: String,
    },
}

/// The table in force as one look at the machine shows it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActiveTable {
    /// Status of the same look, read first.
    pub status: Status,
    /// The active payload, as long as its own bend count says.
    pub payload: Vec<u8>,
}

impl ActiveTable {
    /// As long as its payload is the one that the status names; else why not.
    pub(super) fn checked(status: Status, payload: Vec<u8>) -> Result<ActiveTable, String> {
        let crc = crc_of(&payload);
        if crc == status.active.crc {
            return Ok(ActiveTable { status, payload });
        }
        Err(format!(
            "the active rows have CRC {crc:08X}, the machine says {}: caught in a change, or damaged",
            status.active
        ))
    }
}

/// A machine that takes tables by stage, verify, commit.
pub trait Bender: Send {
    /// What kind of machine it is.
    fn profile(&self) -> &Profile;

    /// Where it is, for people.
    fn endpoint(&self) -> &str;

    /// Somebody has looked after the machine: one that was taken for another may be asked again.
    fn reset(&mut self);

    /// The last frames that went either way, one line each, the oldest first; where the link keeps none, none.
    fn last_frames(&self) -> Vec<String> {
        Vec::new()
    }

    /// One look at the machine.
    fn read_status(&mut self) -> impl Future<Output = Result<Status, LinkError>> + Send;

    /// Writes a table to the staging area; the machine does not use it yet.
    fn write_staging(&mut self, staged: &Staged) -> impl Future<Output = Result<(), LinkError>> + Send;

    /// Reads back this many bytes of the staging area.
    fn read_staging(&mut self, bytes: usize) -> impl Future<Output = Result<Vec<u8>, LinkError>> + Send;

    /// Writes the commit word, once, never repeated by the link; not at all when anything failed since the last status was read.
    fn commit(&mut self, id: TableId) -> impl Future<Output = Result<(), LinkError>> + Send;

    /// Reads status and active table.
    fn read_active(&mut self) -> impl Future<Output = Result<ActiveTable, LinkError>> + Send;
}
