//! Where scans come from: the scan arm's side of the daemon. First on the way of the data.
//!
//! A [`ScanSource`] hands out one complete scan file after the other and files it away when the cell has
//! dealt with it. The one source so far is a [`WatchedFolder`].

mod folder;
mod settle;

use std::future::Future;
use std::path::PathBuf;

use thiserror::Error;

pub use folder::{FolderSettings, WatchedFolder};

/// One complete scan, waiting to be measured.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ScanFile {
    /// Where it lies now.
    pub path: PathBuf,
    /// Its size.
    pub bytes: u64,
}

/// What became of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filing<'a> {
    /// Measured and used.
    Done,
    /// Not used; the reason is kept beside it.
    Failed(&'a str),
}

/// Why a source cannot deliver.
#[derive(Debug, Error)]
pub enum ArmError {
    /// The folder or a file in it cannot be read or moved.
    #[error("{path}: cannot {what}: {source}")]
    Io {
        /// The folder or file.
        path: String,
        /// What was tried.
        what: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
    /// More entries than anyone would leave there on purpose.
    #[error(
        "{path}: more than {limit} entries; empty the folder, or name one that only scans are written to"
    )]
    TooMany {
        /// The folder.
        path: String,
        /// What is allowed.
        limit: usize,
    },
}

/// A source of complete scans.
pub trait ScanSource: Send {
    /// Waits for the next complete scan. May be dropped at any await and called again without losing one.
    /// The same scan comes again until it is filed.
    fn next(&mut self) -> impl Future<Output = Result<ScanFile, ArmError>> + Send;

    /// Files a scan away. Nothing is ever deleted or overwritten.
    fn file(
        &mut self,
        scan: &ScanFile,
        filing: Filing<'_>,
    ) -> impl Future<Output = Result<(), ArmError>> + Send;

    /// Files everything that is there now as failed for this reason, complete or not (but under its final
    /// name): scans of tubes that were bent before the table now in force. Returns how many.
    fn set_aside(&mut self, reason: &str) -> impl Future<Output = Result<usize, ArmError>> + Send;
}
