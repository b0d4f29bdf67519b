//! Why a scan was refused: what failed, where, what was found, what is allowed, what to do.

use thiserror::Error;

/// A refusal of a scan file. Nothing of a refused file is used.
#[derive(Debug, Error)]
pub enum CloudError {
    /// The system could not read it.
    #[error("{file}: cannot be read: {reason}")]
    Read {
        /// Path as given.
        file: String,
        /// What the system said.
        reason: std::io::Error,
    },
    /// The system could not write it.
    #[error("{file}: cannot be written: {reason}")]
    Write {
        /// Path as given.
        file: String,
        /// What the system said.
        reason: std::io::Error,
    },
    /// Not a format that is read (or written).
    #[error("{file}: {found}; scans are .ply, .e57, .stl, or text as .xyz .asc .pts .csv .txt")]
    Format {
        /// Path as given.
        file: String,
        /// What it seems to be.
        found: String,
    },
    /// Nothing in it.
    #[error("{file}: the file is empty; was the export interrupted? Export the scan again")]
    Empty {
        /// Path as given.
        file: String,
    },
    /// Larger than any tube's scan.
    #[error("{file}: {bytes} bytes; at most {allowed} are read: thin the scan at export")]
    TooLarge {
        /// Path as given.
        file: String,
        /// Its size.
        bytes: u64,
        /// The limit.
        allowed: u64,
    },
    /// A text (or a PLY header) that breaks its format.
    #[error("{file}, line {line}, column {column}: found {found}, allowed is {allowed}")]
    Text {
        /// Path as given.
        file: String,
        /// Line counted from 1.
        line: usize,
        /// Byte in the line counted from 1.
        column: usize,
        /// What stands there.
        found: String,
        /// What may stand there.
        allowed: String,
    },
    /// Binary data that breaks its format.
    #[error("{file}, byte {offset}: found {found}, allowed is {allowed}")]
    Binary {
        /// Path as given.
        file: String,
        /// Byte counted from 0.
        offset: usize,
        /// What stands there.
        found: String,
        /// What may stand there.
        allowed: String,
    },
    /// An E57 file that breaks its format.
    #[error(
        "{file}: not a sound E57 file: {reason}; was the export or the copy interrupted? Export the scan again"
    )]
    E57 {
        /// Path as given.
        file: String,
        /// What the reader found.
        reason: String,
    },
    /// Fewer points than the file announces.
    #[error(
        "{file}: {expected} {what} announced, {found} found before the file ends; \
         was the export or the copy interrupted? Export the scan again"
    )]
    Truncated {
        /// Path as given.
        file: String,
        /// What is counted ("vertices", "points").
        what: String,
        /// Number in the header.
        expected: u64,
        /// Number that is there in full.
        found: u64,
    },
    /// Coordinates that are not numbers.
    #[error(
        "{file}: {count} of {total} points have a coordinate that is not a finite number, the first is point \
         {first} (from 0); export without invalid points"
    )]
    NotFinite {
        /// Path as given.
        file: String,
        /// How many.
        count: usize,
        /// Of how many.
        total: usize,
        /// Index of the first.
        first: usize,
    },
    /// Coordinates no measuring arm can give.
    #[error(
        "{file}: {count} points have a coordinate beyond {limit_mm:e} mm, the first is point {first} (from 0) with \
         {value_mm:e} mm; remove them or check the export"
    )]
    Absurd {
        /// Path as given.
        file: String,
        /// How many.
        count: usize,
        /// Index of the first.
        first: usize,
        /// Its largest coordinate.
        value_mm: f64,
        /// The limit.
        limit_mm: f64,
    },
    /// Too few points to be a scan.
    #[error("{file}: {found} points (duplicates not counted), at least {allowed} are needed; scan again")]
    TooFew {
        /// Path as given.
        file: String,
        /// Number left.
        found: usize,
        /// The limit.
        allowed: usize,
    },
    /// An extent no tube has in this unit.
    #[error("{file}: read as {unit} the extent is {extent_mm:.3} mm, a tube's is 20 mm to 20 m; {advice}")]
    Extent {
        /// Path as given.
        file: String,
        /// The unit given.
        unit: &'static str,
        /// Diagonal of the bounding box.
        extent_mm: f64,
        /// The guess.
        advice: String,
    },
}
