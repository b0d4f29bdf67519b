//! Which format a scan file has: by its content first, by its extension second.

use std::path::Path;

use super::CloudError;

/// The formats that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    /// Stanford polygon file, ascii or binary.
    Ply,
    /// ASTM E2807, scans with poses.
    E57,
    /// Facets, ascii or binary.
    Stl,
    /// Lines of numbers.
    Text,
}

/// Tells the format of a file by its first bytes.
pub(super) fn detect(path: &Path, file: &str, bytes: &[u8]) -> Result<Format, CloudError> {
    let refuse = |found: String| Err(CloudError::Format { file: file.to_owned(), found });
    if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
        return Ok(Format::Ply);
    }
    if bytes.starts_with(b"ASTM-E57") {
        return Ok(Format::E57);
    }
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match extension.as_deref() {
        Some("xyz" | "asc" | "pts" | "csv" | "txt") => Ok(Format::Text),
        Some("stl") => Ok(Format::Stl),
        Some("e57") => refuse("named .e57 but does not begin with \"ASTM-E57\"".to_owned()),
        Some("ply") => refuse("named .ply but does not begin with the line \"ply\"".to_owned()),
        Some(other) => refuse(format!("files of kind .{other} are not read")),
        None => refuse("no extension, and the content is neither PLY nor E57".to_owned()),
    }
}
