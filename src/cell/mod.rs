//! The closed loop of one bending cell.

mod intents;

pub use intents::JournalledIntents;
