//! The whole chain run against the simulators: demo and campaigns.

mod picture;
mod record;

pub use picture::draw;
pub use record::PartRecord;
