//! What the points tell of the tube when how each pass lies is not known better than they tell.
//!
//! Under `realign`, for the sigmas of `finish`.

use nalgebra::{Cholesky, DMatrix, Matrix3, Matrix6, Vector3};

use super::super::fit::Fit;
use super::super::model::{Parameter, TubeModel};
use super::super::moments::Pass;
use super::super::normal::equations;
use super::super::whole::{ScanPass, Whole};
use super::middle;

/// All passes together are held where they are so many times as firmly as all points hold the tube.
const FIRMLY: f64 = 100.0;

/// The information on a tube's values without what motions of the passes may be mistaken for. A pass moves as the pose does:
/// its points' own share of the normal equations tells both.
pub fn information(whole: &Whole, fit: &Fit) -> DMatrix<f64> {
    let (model, parameters) = (&fit.model, &fit.parameters);
    let sums = whole.by_pass(model, fit.cutoff_mm);
    let segments = sums.first().map_or(0, |s| s.moments.len());
    let variance = Pass::total(segments, sums.iter().cloned()).variance_mm2(parameters.len());
    let axis = |(at, p): (usize, &Parameter)| match p {
        Parameter::Pose(k) => Some((at, *k)),
        _ => None,
    };
    let pose: Vec<(usize, usize)> = parameters.iter().enumerate().filter_map(axis).collect();
    let firmness = firmness(whole.passes(), model, fit.sigma_mm) * variance;
    let axes = pose.len();
    let mut normal = DMatrix::zeros(parameters.len(), parameters.len());
    let mut mixed = DMatrix::zeros(parameters.len(), axes * sums.len());
    let mut own = DMatrix::zeros(axes * sums.len(), axes * sums.len());
    let mut stays = DMatrix::zeros(axes, axes * sums.len());
    for (pass, sum) in sums.iter().enumerate() {
        let (square, _) = equations(&sum.moments, model, parameters);
        let felt = DMatrix::from_fn(parameters.len(), axes, |i, j| square[(i, pose[j].0)]);
        let moved = DMatrix::from_fn(axes, axes, |i, j| felt[(pose[i].0, j)]);
        let held = DMatrix::from_fn(axes, axes, |i, j| firmness[(pose[i].1, pose[j].1)]);
        let at = axes * pass;
        mixed.view_mut((0, at), felt.shape()).copy_from(&felt);
        own.view_mut((at, at), moved.shape()).copy_from(&(&moved + held));
        stays.view_mut((0, at), moved.shape()).copy_from(&moved);
        normal += square;
    }
    // All passes together stay where they are: that is where the tube's place is told.
    let together = DMatrix::from_fn(axes, axes, |i, j| normal[(pose[i].0, pose[j].0)]);
    if let Some(together) = Cholesky::new(together) {
        own += stays.transpose() * together.solve(&stays) * FIRMLY;
    }
    let lost = Cholesky::new(own).map(|own| &mixed * own.solve(&mixed.transpose()));
    lost.map_or(normal.clone(), |lost| normal - lost) / variance
}

/// How firmly a pass is held where it lies, for shifts and turns of the tube's pose: by how far the passes were moved.
fn firmness(passes: &[ScanPass], model: &TubeModel, least_mm: f64) -> Matrix6<f64> {
    let (centre, reach_mm) = middle(model);
    let spread_mm = moved_mm(passes, model).max(least_mm);
    let arm = (model.start.inverse() * centre).coords;
    let mut motion = Matrix6::identity();
    motion.fixed_view_mut::<3, 3>(0, 3).copy_from(&-arm.cross_matrix());
    motion.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * reach_mm));
    motion.transpose() * motion / (spread_mm * spread_mm)
}

/// By how much passes were moved against each other in the middle of the tube: one standard deviation along each axis.
pub fn moved_mm(passes: &[ScanPass], model: &TubeModel) -> f64 {
    let (centre, _) = middle(model);
    let count = passes.len().max(1) as f64;
    let moved = passes.iter().map(|p| p.motion * centre - centre);
    let mean = moved.clone().sum::<Vector3<f64>>() / count;
    (moved.map(|m| (m - mean).norm_squared()).sum::<f64>() / (3.0 * count)).sqrt()
}
