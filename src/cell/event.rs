//! What the cell's state machine is told and what it asks for. Plain values: no I/O, no clock.

use std::time::Duration;

use crate::arm::ScanFile;
use crate::tube::{CommandTable, MeasuredTube};

/// Names one piece of work asked for; its result carries the same. A result whose ticket is not the current one
/// comes from before a disarm or a time-out and is dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(pub u64);

/// The table that a machine holds active, as read from it.
#[derive(Debug, Clone, PartialEq)]
pub struct InForce {
    /// Its revision.
    pub revision: u32,
    /// CRC-32 of its encoded form.
    pub crc: u32,
    /// Its rows.
    pub table: CommandTable,
}

/// Which table a machine holds: enough to know it again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Revision {
    /// Counts up with every table.
    pub number: u32,
    /// CRC-32 of the encoded table.
    pub crc: u32,
}

impl InForce {
    /// Which table this is.
    pub fn revision(&self) -> Revision {
        Revision { number: self.revision, crc: self.crc }
    }
}

impl std::fmt::Display for Revision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "revision {} with CRC {:08x}", self.number, self.crc)
    }
}

/// What the next table shall be, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Decision {
    /// What to do.
    pub verdict: Verdict,
    /// The table to put in force (for `FirstPiece` and `Correct`).
    pub table: CommandTable,
    /// Reasons in words, for the operator.
    pub reasons: String,
}

/// The verdict of one decision.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// No part yet: start with this table.
    FirstPiece,
    /// The part is good: nothing to write.
    InTolerance,
    /// Put this table in force.
    Correct,
    /// The scan cannot be decided on.
    Rescan,
    /// A person must look.
    Hold,
}

/// How a delivery ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Delivered {
    /// Read back as active.
    Applied(InForce),
    /// Refused by the machine or by us; nothing changed there.
    Rejected(String),
    /// The machine must be read before anything else; what it may hold by then, if a commit was sent.
    Unknown(String, Option<Revision>),
}

/// Something that happened.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The driver has started.
    Start,
    /// The operator arms the cell, or goes on after a hold.
    Arm,
    /// The operator disarms the cell.
    Disarm,
    /// Time has passed (at or after [`Cell::wake_at`](super::Cell::wake_at)).
    Tick,
    /// The machine was read.
    MachineRead(Ticket, InForce),
    /// The machine could not be read.
    MachineLost(Ticket, String),
    /// A complete scan is there.
    Scan(ScanFile),
    /// The scan was measured.
    Measured(Ticket, Box<MeasuredTube>),
    /// The scan could not be measured.
    MeasureFailed(Ticket, String),
    /// The next step was decided.
    Decided(Ticket, Box<Decision>),
    /// A delivery ended.
    Delivered(Ticket, Delivered),
}

/// Something to be done by the driver.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Read the machine's active table.
    ReadMachine(Ticket),
    /// Measure this scan.
    Measure(Ticket, ScanFile),
    /// Decide the next step from [`Cell::history`](super::Cell::history).
    Decide(Ticket),
    /// Deliver this table over the one in force.
    Deliver(Ticket, CommandTable),
    /// The scan was used: file it as done.
    FileDone(ScanFile),
    /// The scan was not used: file it as failed with this reason.
    FileFailed(ScanFile, String),
    /// File every scan that is there now as failed with this reason.
    SetAside(&'static str),
}

/// Longest times in a state; each ends in a hold or a fault with its reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dwell {
    /// Reading the machine.
    pub reading: Duration,
    /// Measuring a scan.
    pub measuring: Duration,
    /// Deciding.
    pub deciding: Duration,
    /// Delivering a table.
    pub delivering: Duration,
    /// First wait before a faulted machine is read again; doubles up to `retry_cap`.
    pub retry: Duration,
    /// Longest wait between two attempts.
    pub retry_cap: Duration,
}

impl Default for Dwell {
    fn default() -> Dwell {
        Dwell {
            reading: Duration::from_secs(30),
            measuring: Duration::from_secs(300),
            deciding: Duration::from_secs(30),
            delivering: Duration::from_secs(120),
            retry: Duration::from_secs(1),
            retry_cap: Duration::from_secs(60),
        }
    }
}
