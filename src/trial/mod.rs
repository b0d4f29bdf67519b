//! The whole chain run against the simulators: the demo; and the reconstruction measured on many simulated scans.
//!
//! ```text
//! demo      the daemon's own cell loop, and the person at it
//! shop      what is around the cell: bender, tube, scan arm
//! record    one part, as a table
//! story     what is told before, between and after
//! picture   all parts as one SVG
//! deliveries  many deliveries over a link that fails
//! production  many jobs on simulated benders, beside the best that is possible
//! accuracy  how right and how accurate the reconstruction is
//! ```

pub mod accuracy;
pub mod deliveries;
mod demo;
mod picture;
pub mod production;
mod record;
mod shop;
mod story;

use thiserror::Error;

use crate::arm::ArmError;
use crate::cloud::CloudError;
use crate::journal::JournalError;

pub use demo::{Demo, DemoResult, run};
pub use picture::draw;
pub use record::PartRecord;

/// Why a trial could not go on.
#[derive(Debug, Error)]
pub enum TrialError {
    /// The cell stopped for a person.
    #[error("the cell stopped: {0}")]
    Held(String),
    /// The bender has no table to bend with.
    #[error("the simulated bender holds no table after the cell said that one is in force")]
    NoTable,
    /// The cell's loop is gone.
    #[error("the cell's loop ended by itself")]
    Stopped,
    /// The simulated bender's deadlines make no link.
    #[error("the link to the simulated bender: {0}")]
    Link(#[from] crate::bender::RulesError),
    /// No temporary folder, no socket.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The scan folder.
    #[error(transparent)]
    Arm(#[from] ArmError),
    /// The simulated scan could not be written.
    #[error(transparent)]
    Cloud(#[from] CloudError),
    /// The journal.
    #[error(transparent)]
    Journal(#[from] JournalError),
}
