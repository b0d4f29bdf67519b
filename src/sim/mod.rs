//! Simulated tube, scan arm and bender: stand-ins for the hardware that share nothing with the estimators.

pub mod bender;
pub mod bender_server;
pub mod forming;
pub mod population;
pub mod scan;
pub mod scan_file;
