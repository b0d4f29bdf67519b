//! The closed loop of one bending cell: a scan comes in, a corrected table goes out, when that may be.
//!
//! ```text
//! event, state, machine
//!                  the pure state machine: what may happen when
//! driver           performs what it asks for: scans, measuring, deciding, journal
//! worker           the machine's side of that, one thing at a time
//! intents          deliveries in the journal
//! setup, chain     benderd.toml's cell with everything it names; the pure rooms in a row
//! ```

mod chain;
mod driver;
mod event;
mod intents;
mod journalling;
mod machine;
mod places;
mod setup;
mod state;
mod worker;

pub use chain::{Chain, MeasuredScan, measure, measure_scan};
pub use driver::{Command, Craft, Decided, Driver, Identity, Notice};
pub use event::{Action, Decision, Delivered, Dwell, Event, InForce, Ticket};
pub use intents::JournalledIntents;
pub use machine::{Cell, Part};
pub use setup::{Setup, SetupError};
pub use state::{Fault, Hold, Purpose, State};
