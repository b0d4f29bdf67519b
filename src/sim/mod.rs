//! Simulated tube, scan arm and bender: stand-ins for the hardware that share nothing with the estimators.

mod forming;

pub use forming::{FormedTube, Plant};
