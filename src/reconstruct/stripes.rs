//! How far apart the passes of a scan lie, which no file labels: neighbours in the file are nearly always neighbours in one
//! stripe of one pass, and so differ by the scanner's noise alone; the points of one place differ by what the passes
//! disagree besides.
//!
//! Under `structure`: what moves the tube by no more than that is no bend. Of a file in another order neighbours come from
//! all passes, and nothing is found. (The tube's ends ask `passes` instead, which needs no order, but straights.)

use super::fit::CUTOFF_SIGMAS;
use super::local::prepare;
use super::model::TubeModel;
use super::whole::Whole;
use crate::recognize::{MEDIAN_TO_SIGMA, median};

/// Neighbours in the file are no farther apart than this, in tube radii.
const NEIGHBOUR_RADII: f64 = 0.35;
/// Points looked at, in runs of so many as they lie in the file.
const MOST_POINTS: usize = 200_000;
const RUN: usize = 1000;
/// Fewer pairs tell nothing.
const LEAST_PAIRS: usize = 500;
/// A share of the variance that is within the error of both estimates.
const LEAST_SHARE: f64 = 0.05;

/// Neighbours so far.
#[derive(Default)]
struct Pairs {
    before: Option<(usize, [f64; 3], f64)>,
    differences: Vec<f64>,
}

/// Standard deviation of what the passes disagree across the surface, of points that scatter by `noise_mm` about their
/// sections; 0 where nothing says that they do.
pub fn disagreement_mm(whole: &Whole, model: &TubeModel, noise_mm: f64) -> f64 {
    let locals = prepare(model);
    let radius = model.tube_radius_mm;
    let near = (NEIGHBOUR_RADII * radius).powi(2);
    let cutoff_mm = CUTOFF_SIGMAS * noise_mm;
    let add = |pairs: &mut Pairs, segment: usize, p: [f64; 3]| {
        let residual_mm = locals[segment].residual_mm(p, radius);
        if let Some((_, q, other_mm)) = pairs.before.filter(|b| b.0 == segment) {
            let square: f64 = p.iter().zip(&q).map(|(a, b)| (a - b) * (a - b)).sum();
            if square < near && residual_mm.abs() < cutoff_mm && other_mm.abs() < cutoff_mm {
                pairs.differences.push((residual_mm - other_mm).abs());
            }
        }
        pairs.before = Some((segment, p, residual_mm));
    };
    let runs = whole.runs(RUN, MOST_POINTS);
    let parts = whole.only(&runs).walk(model, cutoff_mm, Pairs::default, add);
    let mut differences: Vec<f64> = parts.into_iter().flat_map(|p| p.differences).collect();
    if differences.len() < LEAST_PAIRS {
        return 0.0;
    }
    // A difference has the variance of both.
    let within = median(&mut differences).map_or(noise_mm, |m| m * MEDIAN_TO_SIGMA / 2f64.sqrt());
    let between = noise_mm * noise_mm - within * within;
    if between > LEAST_SHARE * noise_mm * noise_mm { between.sqrt() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::PointCloud;
    use crate::tube::{Frame, Lra};
    use nalgebra::Point3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    const RADIUS: f64 = 10.0;
    const NOISE: f64 = 0.03;

    fn straight() -> TubeModel {
        TubeModel::round(Frame::identity(), Lra { bends: Vec::new(), last_length_mm: 100.0 }, RADIUS)
    }

    /// Two passes, each in stripes over half of the tube, one off by as much out as the other in.
    fn passes(apart_mm: f64) -> Vec<Point3<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut points = Vec::new();
        for pass in [-1.0, 1.0] {
            for stripe in 0..100 {
                for k in 0..60 {
                    let off = NOISE * rng.sample::<f64, _>(StandardNormal) + pass * apart_mm;
                    let turn = 0.05 * f64::from(k);
                    let r = RADIUS + off;
                    points.push(Point3::new(f64::from(stripe), r * turn.cos(), r * turn.sin()));
                }
            }
        }
        points
    }

    fn found_mm(points: &[Point3<f64>], noise_mm: f64) -> f64 {
        let cloud = PointCloud::from_points(points);
        disagreement_mm(&Whole::new(&cloud, None), &straight(), noise_mm)
    }

    #[test]
    fn what_passes_disagree_shows_beside_the_scanners_noise() {
        assert_eq!(found_mm(&passes(0.0), NOISE), 0.0);
        for apart in [0.02, 0.04, 0.08] {
            let found = found_mm(&passes(apart), NOISE.hypot(apart));
            assert!((found / apart - 1.0).abs() < 0.15, "{found} of {apart}");
        }
    }

    #[test]
    fn a_file_in_another_order_tells_nothing() {
        let points = passes(0.04);
        let mixed: Vec<Point3<f64>> = (0..points.len()).map(|i| points[i * 7919 % points.len()]).collect();
        assert_eq!(found_mm(&mixed, NOISE.hypot(0.04)), 0.0);
        assert_eq!(found_mm(&points[..100], NOISE), 0.0, "too few");
    }
}
