//! E57 files (ASTM E2807) by the `e57` crate: all scans of a file, each moved by its pose, merged.
//!
//! Its coordinates are metres by the standard. Points whose state says that they are invalid, or directions
//! only, are skipped and counted.

use std::io::Cursor;

use e57::{CartesianCoordinate, E57Reader, PointCloud, RecordDataType};

use super::raw::{Points, Raw};
use super::{CloudError, Unit};

/// Reads the points of all scans.
pub(super) fn read(file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    let unsound = |e: e57::Error| refusal(file, e.to_string());
    let mut reader = E57Reader::new(Cursor::new(bytes)).map_err(unsound)?;
    let scans = reader.pointclouds();
    let (mut points, mut skipped) = (Vec::new(), 0u64);
    for scan in &scans {
        check(file, scan, bytes.len() as u64)?;
        let mut all = reader.pointcloud_simple(scan).map_err(unsound)?;
        // Not wanted, and limits that are not numbers would not be survived.
        all.normalize_color(false);
        all.normalize_intensity(false);
        all.intensity_to_color(false);
        for point in all {
            match point.map_err(unsound)?.cartesian {
                CartesianCoordinate::Valid { x, y, z } => points.push([x, y, z]),
                _ => skipped += 1,
            }
        }
    }
    let mut raw = Raw { unit: Some(Unit::Metre), ..Raw::new(Points::Double(points)) };
    if scans.len() > 1 {
        raw.notes.push(format!("{} scans merged by their poses", scans.len()));
    }
    if skipped > 0 {
        raw.notes.push(format!("{skipped} points marked as invalid skipped"));
    }
    Ok(raw)
}

/// Refuses what the file cannot hold before anything is allocated for it.
fn check(file: &str, scan: &PointCloud, bytes: u64) -> Result<(), CloudError> {
    if !scan.has_cartesian() && !scan.has_spherical() {
        return Err(refusal(file, "a scan in it has neither Cartesian nor spherical coordinates".to_owned()));
    }
    let bits = scan.prototype.iter().map(|r| bits(&r.data_type)).sum::<u64>();
    if bits == 0 && scan.records > 0 {
        // Such points take no space: any number could be claimed.
        return Err(refusal(file, "a scan in it has no point that differs from another".to_owned()));
    }
    let fit = bytes.saturating_mul(8) / bits.max(1);
    if scan.records > fit {
        let (file, what) = (file.to_owned(), "points".to_owned());
        return Err(CloudError::Truncated { file, what, expected: scan.records, found: fit });
    }
    Ok(())
}

/// Bits that a value takes in the file.
fn bits(kind: &RecordDataType) -> u64 {
    match kind {
        RecordDataType::Single { .. } => 32,
        RecordDataType::Double { .. } => 64,
        RecordDataType::ScaledInteger { min, max, .. } | RecordDataType::Integer { min, max } => {
            u64::from(max.abs_diff(*min).checked_ilog2().map_or(0, |n| n + 1))
        }
    }
}

fn refusal(file: &str, reason: String) -> CloudError {
    CloudError::E57 { file: file.to_owned(), reason }
}
