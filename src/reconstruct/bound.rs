//! The Cramér-Rao bound: the smallest standard deviations that any unbiased fit of a scan can have. What the accuracy
//! of the reconstruction is held against; the reconstruction itself does not know it.

use nalgebra::Point3;

use super::fit::invert;
use super::measure::{Ends, Values, jacobian, values};
use super::model::TubeModel;
use super::moments::Sample;
use super::normal::equations;

/// A cut-off that no residual reaches: all points count in full.
const NO_CUTOFF_MM: f64 = 1e9;

/// The least standard deviation of every value, in the order of the truth's rows. The first and the last length and
/// intersection distance have none: how well an end is found is not a matter of the surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Bound {
    /// Straights between bends, one more than there are bends; 0 at both ends.
    pub lengths_mm: Vec<f64>,
    /// Rotations; 0 in the first row.
    pub rotations_rad: Vec<f64>,
    /// Bend angles.
    pub angles_rad: Vec<f64>,
    /// CLR.
    pub radii_mm: Vec<f64>,
    /// Intersection distances, one more than there are bends; the first and the last are meaningless.
    pub intersections_mm: Vec<f64>,
    /// Outer radius of the tube.
    pub tube_radius_mm: f64,
}

/// The bound for a tube whose truth is known, from the points that were scanned of it: J^T J at the truth times the
/// variance of white noise along the surface's normal, in the parameters that `truth` says are free.
pub fn cramer_rao(truth: &TubeModel, points: Vec<Point3<f64>>, noise_mm: f64) -> Bound {
    let parameters = truth.parameters();
    let pass = Sample::new(points, truth).pass(truth, NO_CUTOFF_MM);
    let (normal, _) = equations(&pass.moments, truth, &parameters);
    let ends = Ends::default();
    let jacobian = jacobian(truth, &parameters, &ends);
    let covariance = &jacobian * invert(&normal) * jacobian.transpose();
    let sigmas = covariance.diagonal().iter().map(|v| noise_mm * v.max(0.0).sqrt()).collect();
    let Values { lengths, rotations, angles, radii, corners, ovalities: _, flattenings: _, tube_radius } =
        values(truth, &ends).like(sigmas);
    Bound {
        lengths_mm: lengths,
        rotations_rad: rotations,
        angles_rad: angles,
        radii_mm: radii,
        intersections_mm: corners,
        tube_radius_mm: tube_radius.iter().sum(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruct::fit::{Effort, fit};
    use crate::sim::scan::{Density, ScanSettings, TubeShape, scan};
    use crate::tube::{Bend, Lra};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    const NOISE_MM: f64 = 0.03;

    fn truth() -> (TubeModel, Vec<Point3<f64>>) {
        let bend = |length_mm, rotation_rad, angle_rad, radius_mm| Bend {
            length_mm,
            rotation_rad,
            angle_rad,
            radius_mm,
        };
        let bends = vec![bend(60.0, 0.0, 1.0, 25.0), bend(30.0, 1.2, 0.8, 25.0), bend(40.0, -0.7, 1.6, 25.0)];
        let lra = Lra { bends, last_length_mm: 50.0 };
        let settings = ScanSettings {
            density: Density::Points(3000),
            noise_mm: 0.0,
            outlier_share: 0.0,
            ..ScanSettings::default()
        };
        let got = scan(&TubeShape::round(lra.clone(), 16.0), &settings, 3);
        (TubeModel::round(got.spine.segments()[0].start, lra, 8.0), got.points)
    }

    /// All values that have a bound, as one list.
    fn listed(
        lengths: &[f64],
        rotations: &[f64],
        angles: &[f64],
        radii: &[f64],
        corners: &[f64],
    ) -> Vec<f64> {
        let n = angles.len();
        [&lengths[1..n], &rotations[1..], angles, radii, &corners[1..n]].concat()
    }

    /// Scatter of fits to many scans that differ in their noise alone.
    fn scatter_over_bound(common_radius: bool) -> Vec<f64> {
        let (model, points) = truth();
        let model = TubeModel { common_radius, ..model };
        let b = cramer_rao(&model, points.clone(), NOISE_MM);
        let bound = listed(&b.lengths_mm, &b.rotations_rad, &b.angles_rad, &b.radii_mm, &b.intersections_mm);
        let all = |m: &TubeModel| {
            let v = values(m, &Ends::default());
            listed(&v.lengths, &v.rotations, &v.angles, &v.radii, &v.corners)
        };
        let (right, spine) = (all(&model), model.spine());
        let mut squares = vec![0.0; right.len()];
        let seeds = 200;
        for seed in 0..seeds {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let noisy = points.iter().map(|p| {
                let normal = (p - spine.closest(p).point).normalize();
                p + normal * (NOISE_MM * rng.sample::<f64, _>(StandardNormal))
            });
            let mut sample = Sample::new(noisy.collect(), &model);
            let effort = Effort { cutoff_mm: 8.0 * NOISE_MM, rounds: 0, steps: 20, prior: None };
            let found = all(&fit(&mut sample, &model, effort).model);
            squares.iter_mut().zip(found.iter().zip(&right)).for_each(|(s, (a, b))| *s += (a - b) * (a - b));
        }
        squares.iter().zip(&bound).map(|(s, b)| (s / seeds as f64).sqrt() / b).collect()
    }

    #[test]
    fn fits_scatter_as_the_bound_says() {
        for common in [false, true] {
            let ratios = scatter_over_bound(common);
            // The rms of 200 normal values is itself uncertain by one in twenty.
            assert!(ratios.iter().all(|r| (0.85..1.16).contains(r)), "{common}: {ratios:?}");
            let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
            assert!((0.94..1.07).contains(&mean), "{common}: {mean}");
        }
    }

    #[test]
    fn one_radius_for_all_bends_is_known_better_and_noise_counts_in_proportion() {
        let (model, points) = truth();
        let each = cramer_rao(&model, points.clone(), NOISE_MM);
        let common =
            cramer_rao(&TubeModel { common_radius: true, ..model.clone() }, points.clone(), NOISE_MM);
        assert!(common.radii_mm[0] < 0.8 * each.radii_mm[0]);
        let double = cramer_rao(&model, points, 2.0 * NOISE_MM);
        assert!((double.angles_rad[1] / each.angles_rad[1] - 2.0).abs() < 1e-9);
    }
}
