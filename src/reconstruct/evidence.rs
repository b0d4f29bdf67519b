//! What the residuals say about the structure: how far the points lie beside the model, station by station. White
//! noise says nothing; a bend that the model lacks shows as a kink.

use nalgebra::{Matrix2, Vector2, Vector3};

use super::model::TubeModel;
use super::moments::Sample;
use super::radius::median;
use crate::tube::Spine;

/// Sideways offset of the data at one place of the tube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Offset {
    /// Arc length of the place.
    pub at_mm: f64,
    /// Offset in space, across the tube.
    pub offset: Vector3<f64>,
    /// Its square over its variance: about 2 where nothing is wrong.
    pub chi2: f64,
}

/// Sectors around the tube that make patches with the stations along it.
const SECTORS: usize = 8;

/// Fewest points of a patch that tell its mean.
const MIN_PATCH: usize = 5;

/// Median of a squared standard normal variable.
const MEDIAN_CHI2: f64 = 0.4549;

/// A point as its place on the tube sees it.
struct Seen {
    station: usize,
    /// Unit normal across the tube: y, z of the spine's frame.
    normal: Vector2<f64>,
    residual_mm: f64,
}

/// All points within the cut-off, by station.
fn seen<'a>(
    sample: &'a Sample,
    model: &TubeModel,
    spine: &'a Spine,
    station_mm: f64,
    cutoff_mm: f64,
) -> impl Iterator<Item = Seen> + 'a {
    let radius = model.tube_radius_mm;
    sample.points.iter().zip(sample.segments()).filter_map(move |(p, segment)| {
        let segment = &spine.segments()[*segment as usize];
        let along = segment.closest_along_mm(p);
        let local = segment.frame_at(along).inverse_transform_point(p);
        let distance = local.y.hypot(local.z);
        let residual_mm = distance - radius;
        let station = ((segment.start_mm + along) / station_mm) as usize;
        let normal = Vector2::new(local.y, local.z) / distance.max(1e-12);
        (residual_mm.abs() <= cutoff_mm).then_some(Seen { station, normal, residual_mm })
    })
}

/// By how much the residuals of a patch hang together: 1 for independent noise; n when a patch's mean varies n times
/// more than its points' scatter explains, as it does where the tube is not quite round or straight or passes of the
/// scanner disagree. A median, so that a local misfit does not count.
pub fn correlation(
    sample: &Sample,
    model: &TubeModel,
    station_mm: f64,
    cutoff_mm: f64,
    sigma_mm: f64,
) -> f64 {
    let spine = model.spine();
    let count = (spine.length_mm() / station_mm) as usize + 1;
    let mut patches = vec![(0usize, 0.0f64); count * SECTORS];
    for point in seen(sample, model, &spine, station_mm, cutoff_mm) {
        let turn = point.normal.y.atan2(point.normal.x) / std::f64::consts::TAU + 0.5;
        let sector = ((turn * SECTORS as f64) as usize).min(SECTORS - 1);
        let (n, sum) = &mut patches[point.station.min(count - 1) * SECTORS + sector];
        *n += 1;
        *sum += point.residual_mm;
    }
    let filled = patches.iter().filter(|(n, _)| *n >= MIN_PATCH);
    let mut chi2: Vec<f64> = filled.map(|(n, sum)| sum * sum / (*n as f64 * sigma_mm * sigma_mm)).collect();
    median(&mut chi2).map_or(1.0, |m| (m / MEDIAN_CHI2).max(1.0))
}

/// Offsets of all stations of the given length along the tube, from points within the cut-off.
pub fn offsets(
    sample: &Sample,
    model: &TubeModel,
    station_mm: f64,
    cutoff_mm: f64,
    sigma_mm: f64,
) -> Vec<Offset> {
    let spine = model.spine();
    let count = (spine.length_mm() / station_mm) as usize + 1;
    let mut sums = vec![(Matrix2::<f64>::zeros(), Vector2::<f64>::zeros()); count];
    for point in seen(sample, model, &spine, station_mm, cutoff_mm) {
        let (matrix, right) = &mut sums[point.station.min(count - 1)];
        *matrix += point.normal * point.normal.transpose();
        *right += point.normal * point.residual_mm;
    }
    let offset = |(k, (matrix, right)): (usize, &(Matrix2<f64>, Vector2<f64>))| {
        // A narrow strip knows its offset across the strip only.
        let inverse = (matrix + Matrix2::identity() * (1e-3 * matrix.trace() + 1e-9)).try_inverse()?;
        let solved = inverse * right;
        let at_mm = (k as f64 + 0.5) * station_mm;
        let offset = spine.frame_at(at_mm).rotation * Vector3::new(0.0, solved.x, solved.y);
        Some(Offset { at_mm, offset, chi2: right.dot(&solved) / (sigma_mm * sigma_mm) })
    };
    sums.iter().enumerate().filter_map(offset).collect()
}
