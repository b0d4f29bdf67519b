//! E57 files (ASTM E2807) by the `e57` crate: all scans of a file, each moved by its pose, merged.
//!
//! Its coordinates are metres by the standard. Points whose state says that they are invalid, or directions
//! only, are skipped and counted.

//!
//! A file may lie, and a panic ends the daemon: what the crate believes unseen, or would take too long over, is checked
//! before it is asked ([`xml`], [`packets`]).

mod packets;
mod xml;

use std::io::Cursor;

use e57::{CartesianCoordinate, E57Reader, PointCloud, RecordDataType};

use super::raw::{Points, Raw};
use super::{CloudError, Unit};

/// Values of a point at most: the standard knows some twenty.
const MOST_VALUES: usize = 64;
/// Bits of a point at least, as in the other formats: fewer cannot tell the places on a tube apart.
const FEWEST_BITS: u64 = 24;
/// How far a pose's quaternion may be from length 1: more than any rounding.
const POSE_DOUBT: f64 = 1e-3;

/// Reads the points of all scans.
pub(super) fn read(file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    let refuse = |reason: String| refusal(file, reason);
    let unsound = |e: e57::Error| refuse(e.to_string());
    xml::check(&E57Reader::raw_xml(Cursor::new(bytes)).map_err(unsound)?).map_err(refuse)?;
    let mut reader = E57Reader::new(Cursor::new(bytes)).map_err(unsound)?;
    let mut scans = reader.pointclouds();
    if scans.is_empty() {
        return Err(refuse("there is no scan in it".to_owned()));
    }
    let (mut points, mut skipped, mut left) = (Vec::new(), 0u64, bytes.len() as u64 * 8);
    for scan in &mut scans {
        left -= check(file, scan, left)?;
        sober_pose(scan).map_err(refuse)?;
        let found = packets::held(bytes, scan).map_err(refuse)?;
        if found < scan.records {
            return Err(truncated(file, scan, found));
        }
        points.reserve(scan.records as usize);
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
    if points.is_empty() && skipped > 0 {
        return Err(refuse(format!("all its {skipped} points are marked as invalid")));
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

/// Refuses what the file cannot hold before anything is allocated for it; `left` are the file's bits that no scan before
/// has taken. Returns how many this one takes.
fn check(file: &str, scan: &PointCloud, left: u64) -> Result<u64, CloudError> {
    if !scan.has_cartesian() && !scan.has_spherical() {
        return Err(refusal(file, "a scan in it has neither Cartesian nor spherical coordinates".to_owned()));
    }
    if scan.prototype.len() > MOST_VALUES {
        let found = scan.prototype.len();
        return Err(refusal(
            file,
            format!("its points have {found} values each, at most {MOST_VALUES} are read"),
        ));
    }
    for record in &scan.prototype {
        if let RecordDataType::ScaledInteger { scale, offset, .. } = record.data_type
            && (scale == 0.0 || !scale.is_finite() || !offset.is_finite())
        {
            let what = format!("{:?} has scale {scale} and offset {offset}", record.name);
            return Err(refusal(file, format!("{what}, which give no coordinate")));
        }
    }
    let bits = scan.prototype.iter().map(|r| bits(&r.data_type)).sum::<u64>();
    if bits < FEWEST_BITS && scan.records > 0 {
        // Any number of such points could be claimed.
        let reason =
            format!("its points have {bits} bits each, too few to differ; at least {FEWEST_BITS} are needed");
        return Err(refusal(file, reason));
    }
    let fit = left / bits.max(1);
    if scan.records > fit {
        return Err(truncated(file, scan, fit));
    }
    Ok(scan.records * bits)
}

/// Makes a pose a rotation: one by a quaternion of another length would also stretch the scan.
fn sober_pose(scan: &mut PointCloud) -> Result<(), String> {
    let Some(pose) = &mut scan.transform else { return Ok(()) };
    let q = &mut pose.rotation;
    let length = [q.w, q.x, q.y, q.z].iter().map(|v| v * v).sum::<f64>().sqrt();
    if length.is_nan() || (length - 1.0).abs() > POSE_DOUBT {
        return Err(format!("a pose in it has a quaternion of length {length}, allowed is 1"));
    }
    for v in [&mut q.w, &mut q.x, &mut q.y, &mut q.z] {
        *v /= length;
    }
    Ok(())
}

fn truncated(file: &str, scan: &PointCloud, found: u64) -> CloudError {
    let (file, what) = (file.to_owned(), "points".to_owned());
    CloudError::Truncated { file, what, expected: scan.records, found }
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
