//! One scan file to a measured tube: reading through the cloud's door, then reconstruction.

use std::path::Path;
use std::time::Instant;

use crate::cloud::{Unit, read_scan};
use crate::reconstruct::{Options, reconstruct};
use crate::tube::{MeasuredTube, Nominal};

/// Reads and reconstructs a scan in the nominal's direction of travel. The error is for the operator: it names
/// the file, what is wrong with it and what to do.
pub fn measure(path: &Path, unit: Unit, nominal: Option<&Nominal>) -> Result<MeasuredTube, String> {
    let begin = Instant::now();
    let scan = read_scan(path, unit).map_err(|e| e.to_string())?;
    let found = reconstruct(&scan.cloud, &Options { nominal });
    let mut measured = found.map_err(|e| format!("{}: {e}", path.display()))?.measured;
    measured.scan_sha256 = scan.sha256;
    measured.elapsed_ms = begin.elapsed().as_secs_f64() * 1000.0;
    measured.warnings.extend(scan.notes);
    Ok(measured)
}
