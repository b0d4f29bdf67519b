//! Simulated tube, scan arm and bender: stand-ins for the hardware that share nothing with the estimators.

pub mod bender;
pub mod bender_server;
pub mod direct_registers;
pub mod door;
pub mod faults;
pub mod folder_station;
pub mod forming;
pub mod frames;
pub mod modbus_station;
pub mod population;
pub mod pty;
pub mod registers;
pub mod scan;
pub mod scan_file;
pub mod serial_station;
pub mod serve;
pub mod station;
