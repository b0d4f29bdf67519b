//! What the cell's state machine is told and what it asks for. Plain values: no I/O, no clock.

use std::time::Duration;

use crate::arm::ScanFile;
use crate::bender::{Operation, TableId};
use crate::correct::{Answer, Code};
use crate::inspect::Inspection;
use crate::tube::{CommandTable, MeasuredTube};

/// Names one piece of work asked for; its result carries the same. A result whose ticket is not the current one
/// comes from before a disarm or a time-out and is dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(pub u64);

/// The table that a machine holds active, as read from it.
#[derive(Debug, Clone, PartialEq)]
pub struct InForce {
    /// Which table it is.
    pub id: TableId,
    /// Name of the program that is loaded.
    pub program: String,
    /// The table's rows; none before the first delivery.
    pub table: CommandTable,
}

/// What `correct` answered, and the inspection that a person wants to see with it.
#[derive(Debug, Clone, PartialEq)]
pub struct Decision {
    /// Verdict, table and reasons.
    pub answer: Answer,
    /// The last part against its nominal; none for a first piece.
    pub inspection: Option<Box<Inspection>>,
}

impl Decision {
    /// The first reason's code: why it is held.
    pub fn code(&self) -> Option<Code> {
        self.answer.reasons.first().map(|reason| reason.code)
    }

    /// The reasons in one line, for the operator.
    pub fn reasons(&self) -> String {
        self.answer.reasons.iter().map(|r| r.text.as_str()).collect::<Vec<_>>().join("; ")
    }
}

/// How a delivery ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Delivered {
    /// Read back as active.
    Applied(TableId),
    /// Refused by the machine or by us; nothing changed there.
    Rejected(String),
    /// Something failed on the way; nothing changed there.
    NotApplied(String),
    /// The machine must be read before anything else; what it may hold by then, if a commit was sent.
    Unknown(String, Option<TableId>),
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
    /// Scans cannot be filed away: the next one could be an old one.
    FilingFailed(String),
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
    /// Deliver this table over the one in force, if that is still this one.
    Deliver(Ticket, CommandTable, TableId, Operation),
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
