//! The door: the one way in for scan files. Whatever passes is finite, free of duplicates, in millimetres and
//! of a tube's size; whatever does not is refused with the reason.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use nalgebra::Point3;
use sha2::{Digest, Sha256};

use super::duplicates::repeated;
use super::format::{Format, detect};
use super::raw::{Bounds, Coordinate, Points, Raw};
use super::stream::{BLOCK, Source};
use super::{CloudError, PointCloud, Unit, e57, ply, stl, text};

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
/// truncates the file meanwhile cannot kill the daemon with a bus error. A binary PLY is read, hashed and decoded
/// block by block and never held as a whole.
pub fn read_scan(path: &Path, unit: Unit) -> Result<Scan, CloudError> {
    let file = path.display().to_string();
    let failed = |reason| CloudError::Read { file: file.clone(), reason };
    let handle = File::open(path).map_err(failed)?;
    let size = handle.metadata().map_err(failed)?.len();
    if size > LARGEST_FILE {
        return Err(CloudError::TooLarge { file, bytes: size, allowed: LARGEST_FILE });
    }
    scan(path, Source::new(&file, handle, size, LARGEST_FILE), BLOCK, unit)
}

/// The same for a file's bytes already in memory (an upload); `path` gives its name and extension.
pub fn parse_scan(path: &Path, bytes: &[u8], unit: Unit) -> Result<Scan, CloudError> {
    let file = path.display().to_string();
    scan(path, Source::new(&file, bytes, bytes.len() as u64, LARGEST_FILE), BLOCK, unit)
}

/// Reads `block` bytes at a time where the format allows.
pub(super) fn scan(
    path: &Path,
    mut source: Source<impl Read>,
    block: usize,
    unit: Unit,
) -> Result<Scan, CloudError> {
    let file = source.file;
    let head = source.head()?;
    if head.is_empty() {
        return Err(CloudError::Empty { file: file.to_owned() });
    }
    let format = detect(path, file, &head)?;
    let streamed = if format == Format::Ply { ply::stream(&head, &mut source, block)? } else { None };
    let (raw, digest) = match streamed {
        Some(done) => done,
        None => {
            let bytes = source.rest(head)?;
            let (raw, digest) = rayon::join(|| whole(format, file, &bytes), || Sha256::digest(&bytes));
            (raw?, digest)
        }
    };
    let (cloud, notes) = admit(file, raw, unit)?;
    Ok(Scan { cloud, sha256: digest.iter().map(|b| format!("{b:02x}")).collect(), notes })
}

/// Reads a file that is in memory as a whole.
fn whole(format: Format, file: &str, bytes: &[u8]) -> Result<Raw, CloudError> {
    match format {
        Format::Ply => ply::read(file, bytes),
        Format::E57 => e57::read(file, bytes),
        Format::Stl => stl::read(file, bytes),
        Format::Text => text::read(file, bytes),
    }
}

/// The checks that hold for every format.
fn admit(file: &str, mut raw: Raw, unit: Unit) -> Result<(PointCloud, Vec<String>), CloudError> {
    let mut cloud = match std::mem::take(&mut raw.points) {
        Points::Single(points) => admit_points(file, points, &mut raw, unit)?,
        Points::Double(points) => admit_points(file, points, &mut raw, unit)?,
    };
    cloud.normals = raw.normals.and_then(|n| unit_normals(n, &mut raw.notes));
    Ok((cloud, raw.notes))
}

/// The same for points of either precision; `raw` has the rest.
fn admit_points<T: Coordinate>(
    file: &str,
    mut points: Vec<[T; 3]>,
    raw: &mut Raw,
    unit: Unit,
) -> Result<PointCloud, CloudError> {
    let few = |found| CloudError::TooFew { file: file.to_owned(), found, allowed: FEWEST_POINTS };
    let bounds = Bounds::of(&points).ok_or_else(|| few(0))?;
    check_finite(file, &points, bounds.finite)?;
    let [min, max] = [bounds.min, bounds.max].map(|c| Point3::from(c.map(|v| v.into() + 0.0)));
    let unit = raw.unit.map_or(unit, |own| own.or_given(unit, (max - min).norm(), &mut raw.notes));
    let scale = unit.millimetres();
    let [min, max] = [min * scale, max * scale];
    check_magnitude(file, &points, scale, min.coords.amax().max(max.coords.amax()))?;
    let repeated = repeated(&points);
    if !repeated.is_empty() {
        if !raw.corners {
            raw.notes.push(format!("{} duplicate points removed", repeated.len()));
        }
        remove(&mut points, &repeated);
        raw.normals.iter_mut().for_each(|n| remove(n, &repeated));
    }
    if points.len() < FEWEST_POINTS {
        return Err(few(points.len()));
    }
    unit.check_extent(file, (max - min).norm())?;
    // An origin that does not depend on the order of the points: neither do their offsets.
    let origin = nalgebra::center(&min, &max).map(f64::round);
    Ok(PointCloud::scaled(origin, points, scale))
}

/// Removes the items at the given ascending indices.
fn remove<T: Copy>(items: &mut Vec<T>, indices: &[u32]) {
    let (mut next, mut at) = (indices.iter().peekable(), 0);
    items.retain(|_| {
        at += 1;
        next.next_if_eq(&&(at - 1)).is_none()
    });
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

fn check_finite<T: Coordinate>(file: &str, points: &[[T; 3]], finite: bool) -> Result<(), CloudError> {
    let bad = |p: &[T; 3]| !p.iter().all(|&v| v.into().is_finite());
    let first = if finite { None } else { points.iter().position(bad) };
    let Some(first) = first else { return Ok(()) };
    let count = points.iter().filter(|p| bad(p)).count();
    Err(CloudError::NotFinite { file: file.to_owned(), count, total: points.len(), first })
}

fn check_magnitude<T: Coordinate>(
    file: &str,
    points: &[[T; 3]],
    scale: f64,
    largest: f64,
) -> Result<(), CloudError> {
    let size = |p: &[T; 3]| p.iter().fold(0.0, |a: f64, &v| a.max((v.into() * scale).abs()));
    let bad = |p: &[T; 3]| size(p) > LARGEST_MM;
    let first = if largest <= LARGEST_MM { None } else { points.iter().position(bad) };
    let Some(first) = first else { return Ok(()) };
    Err(CloudError::Absurd {
        file: file.to_owned(),
        count: points.iter().filter(|p| bad(p)).count(),
        first,
        value_mm: size(&points[first]),
        limit_mm: LARGEST_MM,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_others_keep_their_order() {
        let mut items: Vec<u32> = (0..6).collect();
        remove(&mut items, &[0, 2, 5]);
        assert_eq!(items, [1, 3, 4]);
    }
}
