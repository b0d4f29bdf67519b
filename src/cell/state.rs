//! Where a cell is, why it stands still, and that in the operator's words.
//!
//! Under `machine`, which leads from state to state.

use std::fmt;

use crate::arm::ScanFile;
use crate::bender::TableId;
use crate::correct::Code;
use crate::tube::CommandTable;

/// Where the cell is.
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// Nothing is measured or written until somebody arms the cell.
    Disarmed,
    /// The machine is being read.
    Reading(Purpose),
    /// A table is in force; the next scan is waited for.
    Ready,
    /// The same, and the last part was good.
    InTolerance,
    /// A scan is being measured.
    Measuring(ScanFile),
    /// The next step is being decided, after this scan (None: for the first piece).
    Deciding(Option<ScanFile>),
    /// A table is on its way.
    Delivering(CommandTable),
    /// A person must look; arming again goes on.
    Held(Hold),
    /// The machine cannot be reached; it is read again by itself, and comes back disarmed.
    Faulted(Box<Fault>),
}

/// Why a person must look.
#[derive(Debug, Clone, PartialEq)]
pub struct Hold {
    /// For machines, as in `benderd correct`'s reasons; none where the cell itself cannot go on.
    pub code: Option<Code>,
    /// For people.
    pub reason: String,
}

/// Why the machine is being read.
#[derive(Debug, Clone, PartialEq)]
pub enum Purpose {
    /// To see who is there, after start or a fault.
    Contact,
    /// Before anything is decided.
    Arming,
    /// To see that the table in force is still ours before a part is judged by it.
    Recall(ScanFile),
    /// To learn what became of a delivery (None: it may not have come as far as the commit).
    Resolve(Option<TableId>),
}

/// A machine that cannot be reached.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    /// What happened.
    pub reason: String,
    /// What to find out at the next contact.
    pub then: Purpose,
}

impl fmt::Display for State {
    /// The state in the operator's words.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            State::Disarmed => f.write_str("disarmed"),
            State::Reading(_) => f.write_str("reading the machine"),
            State::Ready => f.write_str("waiting for a scan"),
            State::InTolerance => f.write_str("in tolerance, waiting for a scan"),
            State::Measuring(_) => f.write_str("measuring"),
            State::Deciding(_) => f.write_str("deciding"),
            State::Delivering(_) => f.write_str("delivering a table"),
            State::Held(hold) => write!(f, "held: {}", hold.reason),
            State::Faulted(fault) => write!(f, "faulted: {}", fault.reason),
        }
    }
}
