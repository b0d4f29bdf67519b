//! The knowledge file: read whole, written whole or not at all. The room's only door to the disk.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use thiserror::Error;

use super::knowledge::VERSION;
use super::{Knowledge, check};

/// Why a knowledge file cannot be used.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The system refused.
    #[error("knowledge file {file}: cannot be read or written")]
    Io {
        /// Path as given.
        file: String,
        /// What the system said.
        source: io::Error,
    },
    /// Not a knowledge file; it is left as it is.
    #[error("{file}: not a knowledge file: {detail}; nothing was changed in it")]
    Syntax {
        /// Path as given.
        file: String,
        /// Line and what was expected.
        detail: String,
    },
}

/// Reads a knowledge file; an absent one is empty knowledge.
pub fn load(path: &Path) -> Result<Knowledge, StoreError> {
    let file = path.display().to_string();
    let text = match fs::read_to_string(path) {
        Ok(text) => text,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Knowledge::default()),
        Err(source) => return Err(StoreError::Io { file, source }),
    };
    let knowledge: Knowledge = serde_json::from_str(&text)
        .map_err(|e| StoreError::Syntax { file: file.clone(), detail: e.to_string() })?;
    let unfit = match knowledge.version {
        VERSION => check::unfit(&knowledge),
        other => Some(format!("version = {other}, allowed is {VERSION}")),
    };
    match unfit {
        None => Ok(knowledge),
        Some(detail) => Err(StoreError::Syntax { file, detail }),
    }
}

/// The same where the file has to be there.
pub fn load_present(path: &Path) -> Result<Knowledge, StoreError> {
    let file = || path.display().to_string();
    fs::metadata(path).map_err(|source| StoreError::Io { file: file(), source })?;
    load(path)
}

/// Writes a knowledge file so that after a power cut there is the old one or the new one: a temporary file in
/// the same directory, flushed to disk, renamed over the old one, the directory flushed too.
pub fn save(path: &Path, knowledge: &Knowledge) -> Result<(), StoreError> {
    let io = |source: io::Error| StoreError::Io { file: path.display().to_string(), source };
    let text = serde_json::to_string_pretty(knowledge).map_err(|e| io(e.into()))?;
    let directory = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let mut temporary = tempfile::NamedTempFile::new_in(directory).map_err(io)?;
    temporary.write_all(text.as_bytes()).map_err(io)?;
    temporary.write_all(b"\n").map_err(io)?;
    temporary.as_file().sync_all().map_err(io)?;
    temporary.persist(path).map_err(|e| io(e.error))?;
    File::open(directory).and_then(|d| d.sync_all()).map_err(io)
}
