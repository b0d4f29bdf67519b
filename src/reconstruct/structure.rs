//! How many bends: candidates from the spine's polygon at several tolerances, each fitted to a thinned sample, and
//! the one kept that explains the data with the fewest values (Bayesian information criterion).

use nalgebra::Point3;

use super::arcline::{Limits, approximate};
use super::fit::{Effort, Fit, fit};
use super::model::TubeModel;
use super::moments::Sample;
use super::simplify::simplify;

/// Tolerances of the polygon in tube radii; noise and the spine's own shrinkage in bends are below the smallest
/// (0.038 radii, paper 000, section 3.2).
const TOLERANCES: [f64; 4] = [0.03, 0.05, 0.08, 0.13];

/// Tolerance of the arcs over that of the polygon.
const ARC_FACTOR: f64 = 2.5;

/// A bend below this angle is tried without.
const DROP_RAD: f64 = 0.2;

/// First cut-off of residuals in tube radii.
const FIRST_CUTOFF: f64 = 0.4;

/// A candidate and its score.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The fit.
    pub fit: Fit,
    /// Information criterion relative to nothing in particular: smaller is better.
    pub score: f64,
}

/// Finds the structure: the best of all candidates, or None when the polygon carries none.
pub fn choose(polygon: &[Point3<f64>], sample: &[Point3<f64>], radius_mm: f64) -> Option<Candidate> {
    let mut fits: Vec<Fit> = Vec::new();
    for tolerance in TOLERANCES {
        let kept: Vec<Point3<f64>> =
            simplify(polygon, tolerance * radius_mm).into_iter().map(|i| polygon[i]).collect();
        let limits = Limits { tolerance_mm: ARC_FACTOR * tolerance * radius_mm, min_radius_mm: radius_mm };
        let Some((lra, start)) = approximate(&kept, limits) else { continue };
        if fits.iter().any(|f| f.model.lra.bends.len() == lra.bends.len() && tolerance > 0.06) {
            continue;
        }
        let model = TubeModel { start, lra, tube_radius_mm: radius_mm, common_radius: false };
        fits.push(quick_fit(sample, &model));
    }
    let sigma = fits.iter().map(|f| f.sigma_mm).min_by(f64::total_cmp)?;
    let mut best =
        fits.into_iter().map(|f| score(sample, f, sigma)).min_by(|a, b| a.score.total_cmp(&b.score))?;
    while let Some(simpler) = simpler(sample, &best, sigma) {
        best = simpler;
    }
    let mut common = best.fit.model.clone();
    common.common_radius = true;
    let mean = common_radius_mm(&common);
    common.lra.bends.iter_mut().for_each(|b| b.radius_mm = mean);
    let common = score(sample, quick_fit(sample, &common), sigma);
    Some(if common.score < best.score { common } else { best })
}

fn quick_fit(sample: &[Point3<f64>], model: &TubeModel) -> Fit {
    let effort = Effort { cutoff_mm: FIRST_CUTOFF * model.tube_radius_mm, rounds: 4, steps: 30 };
    fit(&mut Sample::new(sample.to_vec(), model), model, effort)
}

/// The best candidate with one bend less, when it scores better.
fn simpler(sample: &[Point3<f64>], best: &Candidate, sigma: f64) -> Option<Candidate> {
    let model = &best.fit.model;
    let small = (0..model.lra.bends.len()).filter(|&i| model.lra.bends[i].angle_rad < DROP_RAD);
    small
        .map(|i| score(sample, quick_fit(sample, &without_bend(model, i)), sigma))
        .filter(|c| c.score < best.score)
        .min_by(|a, b| a.score.total_cmp(&b.score))
}

/// The tube with bend `i` pulled straight.
fn without_bend(model: &TubeModel, i: usize) -> TubeModel {
    let mut out = model.clone();
    out.lra.bends[i].angle_rad = 0.0;
    out.lra.bends[i].length_mm += model.lra.bends[i].radius_mm * model.lra.bends[i].angle_rad;
    out.lra = out.lra.merged();
    // The first row's rotation belongs into the pose.
    if let Some(first) = out.lra.bends.first_mut() {
        let turn =
            nalgebra::UnitQuaternion::from_axis_angle(&nalgebra::Vector3::x_axis(), first.rotation_rad);
        out.start *= turn;
        first.rotation_rad = 0.0;
    }
    out
}

/// Radius weighted by angle: sharp bends know theirs best.
fn common_radius_mm(model: &TubeModel) -> f64 {
    let weight: f64 = model.lra.bends.iter().map(|b| b.angle_rad).sum();
    model.lra.bends.iter().map(|b| b.angle_rad * b.radius_mm).sum::<f64>() / weight.max(1e-12)
}

fn score(sample: &[Point3<f64>], fit: Fit, sigma_mm: f64) -> Candidate {
    let pass = Sample::new(sample.to_vec(), &fit.model).pass(&fit.model, 6.0 * sigma_mm);
    let misfit = 2.0 * pass.cost / (sigma_mm * sigma_mm);
    let score = misfit + fit.parameters.len() as f64 * (sample.len() as f64).ln();
    Candidate { fit, score }
}
