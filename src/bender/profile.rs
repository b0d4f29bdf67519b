//! What one machine is: addresses, scales, limits and deadlines, read from a file in `protocols/`.
//!
//! Code knows no machine; it knows this type. Every field is checked when the file is read
//! (`profile_file`), so the rest of the room may rely on the ranges written here.

use std::time::Duration;

use schemars::JsonSchema;
use serde::Deserialize;

use super::transport::Transport;
use crate::tube::MachineLimits;

/// One machine's description, validated.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Short name, as in `--bender NAME`.
    pub name: String,
    /// One line for people.
    pub description: String,
    /// Which link leads there.
    pub transport: Transport,
    /// Where the machine is: what the transport takes.
    pub endpoint: String,
    /// The constant by which the machine is known.
    pub identification: u32,
    /// Version of the layout of what it keeps.
    pub layout: u16,
    /// How a table is written in integers.
    pub table: TableFormat,
    /// Bits of the state word that must hold before anything is sent.
    pub state_bits: Vec<StateBit>,
    /// What the machine can do.
    pub limits: MachineLimits,
    /// How long to wait for what.
    pub deadlines: Deadlines,
}

/// How the bytes of a 32-bit value lie in two registers, `A` being the most significant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WordOrder {
    /// High word first, the common order.
    Abcd,
    /// Low word first.
    Cdab,
    /// High word first, bytes swapped in each.
    Badc,
    /// Low word first, bytes swapped in each.
    Dcba,
}

impl WordOrder {
    /// The bytes in the order in which they go over the wire; its own inverse.
    pub fn arrange(self, [a, b, c, d]: [u8; 4]) -> [u8; 4] {
        match self {
            WordOrder::Abcd => [a, b, c, d],
            WordOrder::Cdab => [c, d, a, b],
            WordOrder::Badc => [b, a, d, c],
            WordOrder::Dcba => [d, c, b, a],
        }
    }
}

/// How a table is written in integers.
#[derive(Debug, Clone, PartialEq)]
pub struct TableFormat {
    /// Longest name of a program, in bytes; a multiple of 4.
    pub program_bytes: usize,
    /// Order of the four bytes of a 32-bit value.
    pub word_order: WordOrder,
    /// Millimetres per count.
    pub length_resolution_mm: f64,
    /// Degrees per count, for angles and rotations.
    pub angle_resolution_deg: f64,
    /// Whether the machine turns the plane the other way than LRA's right hand.
    pub rotation_reversed: bool,
    /// How lengths are counted.
    pub feed: Sequence,
    /// How rotations are counted.
    pub rotation: Sequence,
    /// What the machine's screen calls length, rotation, angle.
    pub columns: [String; 3],
}

/// How the numbers of a column are counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Sequence {
    /// Each row from the one before.
    #[default]
    Incremental,
    /// All from the first on.
    Cumulative,
}

/// One condition on the state word.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateBit {
    /// Bit number, 0 is the least significant.
    pub bit: u8,
    /// What it says when set.
    pub name: String,
    /// The value without which nothing is sent.
    pub must_be: bool,
}

/// How long to wait for what.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Deadlines {
    /// To open the connection.
    pub connect: Duration,
    /// For one reply.
    pub request: Duration,
    /// For a whole object, where that takes several replies; over Modbus each has its own.
    pub transfer: Duration,
    /// Longest time in which a live machine's heartbeat stands still, milliseconds.
    pub heartbeat_ms: u64,
    /// From the commit to the table being active, milliseconds.
    pub confirm_ms: u64,
    /// Longest time in which a commit that was sent may still arrive, milliseconds.
    pub settle_ms: u64,
    /// Between two looks at the machine, milliseconds.
    pub poll_ms: u64,
}

impl Profile {
    /// Bytes of a payload before its first row: program, count, spare, last length.
    pub fn payload_header_bytes(&self) -> usize {
        self.table.program_bytes + 8
    }

    /// Bytes of one row: length, rotation, angle, four each.
    pub const ROW_BYTES: usize = 12;
}
