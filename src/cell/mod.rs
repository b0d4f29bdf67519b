//! The closed loop of one bending cell: a scan comes in, a corrected table goes out, when that may be.
//!
//! [`Cell`] is the pure state machine; its driver performs what it asks for.

mod event;
mod machine;

pub use event::{Action, Decision, Delivered, Dwell, Event, InForce, Ticket, Verdict};
pub use machine::{Cell, Fault, Part, Purpose, State};
