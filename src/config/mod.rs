//! TOML files to validated types: every error names file, line, key, what was found and what is allowed.
//!
//! A side door of the house: files come in here, checked values go to the rooms. [`Document`] is the one way
//! in for every TOML file of the project (machine profiles too).

mod at;
mod daemon;
mod document;
mod materials;
mod part;
mod springback;
mod tables;

pub use at::At;
pub use daemon::{
    CellConfig, DaemonConfig, HOST_PORT, Mode, ScanUnit, is_device, is_host_port, is_interface, load_daemon,
    parse_daemon,
};
pub use document::{ConfigError, Document};
pub use materials::Materials;
pub use part::{load_part, parse_part};
pub use springback::{parse_springback, read_springback};
pub use tables::{Table, format_table, parse_table, read_table, write_table};
