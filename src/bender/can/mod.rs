//! CAN: frames, the bus under them (an interface of this computer, or one in memory), and the port that protocols use.
//!
//! `can_table` and `sdo` ask over a [`CanPort`]; `sim` answers over one.

mod bus;
mod frame;
mod memory;
mod socket;
#[cfg(test)]
mod tests;
mod watched;

pub use bus::{Bus, BusOpener, CanPort, open_port};
pub use frame::{Condition, Frame, FrameId, Heard};
pub use memory::{MemoryBus, MemoryNode};
pub use socket::Socket;
