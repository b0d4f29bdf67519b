//! The door: the one way in for scan files. Whatever passes is finite, free of duplicates, in millimetres and
//! of a tube's size; whatever does not is refused with the reason.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use nalgebra::Point3;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::format::{Format, detect};
use super::raw::Raw;
use super::{CloudError, PointCloud, Unit, ply, text};

/// Fewest points that can be a scan of a tube.
const FEWEST_POINTS: usize = 100;
/// Beyond 100 km from the origin, in whatever unit, it is not a coordinate.
const LARGEST_MM: f64 = 1e8;
/// Every point takes 3 bytes or more, so indices fit into 32 bits.
const LARGEST_FILE: u64 = 4 << 30;

/// A scan file that passed the door.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// The points in millimetres, in file order.
    pub cloud: PointCloud,
    /// SHA-256 of the file's bytes, in hex: the scan's identity in the journal.
    pub sha256: String,
    /// What was put right or passed over, for the operator.
    pub notes: Vec<String>,
}

/// Reads a scan file. The format is told by the content first, the extension second.
///
/// The file is read, not mapped: the hash and the points come from the same bytes, and an arm's software that
/// truncates the file meanwhile cannot kill the daemon with a bus error.
pub fn read_scan(path: &Path, unit: Unit) -> Result<Scan, CloudError> {
    parse_scan(path, &read_bytes(path)?, unit)
}

/// The same for a file's bytes already in memory (an upload); `path` gives its name and extension.
pub fn parse_scan(path: &Path, bytes: &[u8], unit: Unit) -> Result<Scan, CloudError> {
    let file = path.display().to_string();
    if bytes.is_empty() {
        return Err(CloudError::Empty { file });
    }
    let format = detect(path, &file, bytes)?;
    let (raw, digest) = rayon::join(
        || match format {
            Format::Ply => ply::read(&file, bytes),
            Format::Text => text::read(&file, bytes),
        },
        || Sha256::digest(bytes),
    );
    let (cloud, notes) = admit(&file, raw?, unit)?;
    Ok(Scan { cloud, sha256: digest.iter().map(|b| format!("{b:02x}")).collect(), notes })
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, CloudError> {
    let file = path.display().to_string();
    let failed = |reason| CloudError::Read { file: file.clone(), reason };
    let mut handle = File::open(path).map_err(failed)?;
    let size = handle.metadata().map_err(failed)?.len();
    let too_large = |bytes| CloudError::TooLarge { file: file.clone(), bytes, allowed: LARGEST_FILE };
    if size > LARGEST_FILE {
        return Err(too_large(size));
    }
    let mut bytes = Vec::with_capacity(size as usize);
    // The file may grow while it is read, and a pipe has no size at all.
    (&mut handle).take(LARGEST_FILE + 1).read_to_end(&mut bytes).map_err(failed)?;
    match bytes.len() as u64 {
        n if n > LARGEST_FILE => Err(too_large(n)),
        _ => Ok(bytes),
    }
}

/// The checks that hold for every format.
fn admit(file: &str, raw: Raw, unit: Unit) -> Result<(PointCloud, Vec<String>), CloudError> {
    let Raw { mut points, mut normals, mut notes } = raw;
    check_finite(file, &points)?;
    let scale = unit.millimetres();
    // Adding 0 turns -0 into 0, so that equal coordinates are equal bits.
    points.iter_mut().for_each(|p| p.coords.apply(|v| *v = *v * scale + 0.0));
    check_magnitude(file, &points)?;
    let keep = first_of_each(&points);
    if keep.len() < points.len() {
        notes.push(format!("{} duplicate points removed", points.len() - keep.len()));
        points = keep.iter().map(|&i| points[i as usize]).collect();
        normals = normals.map(|n| keep.iter().map(|&i| n[i as usize]).collect());
    }
    if points.len() < FEWEST_POINTS {
        let found = points.len();
        return Err(CloudError::TooFew { file: file.to_owned(), found, allowed: FEWEST_POINTS });
    }
    let (min, max) = points.iter().fold((points[0], points[0]), |(a, b), p| (a.inf(p), b.sup(p)));
    unit.check_extent(file, (max - min).norm())?;
    // An origin that does not depend on the order of the points: neither do their offsets.
    let origin = nalgebra::center(&min, &max).map(f64::round);
    let mut cloud = PointCloud::around(origin, &points);
    cloud.normals = normals.and_then(|n| unit_normals(n, &mut notes));
    Ok((cloud, notes))
}

/// Normals of length 1; none at all where some have no direction, since points are used without them too.
fn unit_normals(mut normals: Vec<[f32; 3]>, notes: &mut Vec<String>) -> Option<Vec<[f32; 3]>> {
    let mut bad = 0;
    for normal in &mut normals {
        let length = normal.iter().map(|v| v * v).sum::<f32>().sqrt();
        bad += usize::from(!length.is_normal());
        *normal = normal.map(|v| v / length);
    }
    if bad > 0 {
        notes.push(format!("normals passed over: {bad} have no direction"));
        return None;
    }
    Some(normals)
}

fn check_finite(file: &str, points: &[Point3<f64>]) -> Result<(), CloudError> {
    let bad = |p: &Point3<f64>| !p.iter().all(|v| v.is_finite());
    let Some(first) = points.iter().position(bad) else { return Ok(()) };
    let count = points.iter().filter(|p| bad(p)).count();
    Err(CloudError::NotFinite { file: file.to_owned(), count, total: points.len(), first })
}

fn check_magnitude(file: &str, points: &[Point3<f64>]) -> Result<(), CloudError> {
    let bad = |p: &Point3<f64>| p.coords.amax() > LARGEST_MM;
    let Some(first) = points.iter().position(bad) else { return Ok(()) };
    Err(CloudError::Absurd {
        file: file.to_owned(),
        count: points.iter().filter(|p| bad(p)).count(),
        first,
        value_mm: points[first].coords.amax(),
        limit_mm: LARGEST_MM,
    })
}

/// Indices of the points that differ from every earlier one, ascending.
fn first_of_each(points: &[Point3<f64>]) -> Vec<u32> {
    let mut order: Vec<(u64, u32)> =
        points.par_iter().enumerate().map(|(i, p)| (mixed(p), i as u32)).collect();
    order.par_sort_unstable();
    let mut keep = vec![true; points.len()];
    let mut doubles = 0;
    for alike in order.chunk_by(|a, b| a.0 == b.0).filter(|c| c.len() > 1) {
        // Equal hashes are nearly always equal points: `distinct` stays at one entry.
        let mut distinct: Vec<u32> = Vec::new();
        for &(_, i) in alike {
            if distinct.iter().any(|&d| points[d as usize] == points[i as usize]) {
                keep[i as usize] = false;
                doubles += 1;
            } else {
                distinct.push(i);
            }
        }
    }
    let mut out = Vec::with_capacity(points.len() - doubles);
    out.extend((0..points.len() as u32).filter(|&i| keep[i as usize]));
    out
}

/// A 64-bit mixture of a point's bits (multiply and shift; the constants are odd and have no structure).
fn mixed(p: &Point3<f64>) -> u64 {
    p.iter().fold(0x243f_6a88_85a3_08d3, |h: u64, v| {
        let h = (h ^ v.to_bits()).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        h ^ h >> 29
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn duplicates_go_and_the_first_of_each_stays() {
        let p = |x: f64| Point3::new(x, 0.0, 1.0);
        assert_eq!(first_of_each(&[p(3.0), p(1.0), p(3.0), p(2.0), p(1.0), p(1.0)]), [0, 1, 3]);
        assert_eq!(first_of_each(&[]), [0u32; 0]);
    }
}
