//! What the residuals say about the structure: how far the points lie beside the model, station by station. White
//! noise says nothing; a bend that the model lacks shows as a kink.

use nalgebra::{Matrix2, Vector2, Vector3};

use super::model::TubeModel;
use super::moments::Sample;

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

/// Offsets of all stations of the given length along the tube, from points within the cut-off.
pub fn offsets(
    sample: &Sample,
    model: &TubeModel,
    station_mm: f64,
    cutoff_mm: f64,
    sigma_mm: f64,
) -> Vec<Offset> {
    let spine = model.spine();
    let count = (spine.length_mm() / station_mm).ceil().max(1.0) as usize;
    let mut sums = vec![(Matrix2::<f64>::zeros(), Vector2::<f64>::zeros()); count];
    for (p, segment) in sample.points.iter().zip(sample.segments()) {
        let segment = &spine.segments()[*segment as usize];
        let along = segment.closest_along_mm(p);
        let local = segment.frame_at(along).inverse_transform_point(p);
        let distance = local.y.hypot(local.z);
        let residual = distance - model.tube_radius_mm;
        if residual.abs() > cutoff_mm || distance <= 0.0 {
            continue;
        }
        let normal = Vector2::new(local.y, local.z) / distance;
        let station = ((segment.start_mm + along) / station_mm) as usize;
        let (matrix, right) = &mut sums[station.min(count - 1)];
        *matrix += normal * normal.transpose();
        *right += normal * residual;
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
