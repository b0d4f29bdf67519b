//! How well each straight's points lie on the tube: a straight that moved under the scan, or is bowed or dented, shows here.

use super::fit::Fit;
use super::local::prepare;
use super::whole::Whole;

/// Fewer points say nothing of a straight.
const LEAST_POINTS: usize = 100;

/// Root mean square distance of the points that count, straight by straight; none where there are too few.
pub fn rms_mm(whole: &Whole, fit: &Fit) -> Vec<Option<f64>> {
    let (locals, radius_mm) = (prepare(&fit.model), fit.model.tube_radius_mm);
    let new = || vec![(0.0, 0_usize); locals.len()];
    let add = |sums: &mut Vec<(f64, usize)>, segment: usize, p: [f64; 3]| {
        let off_mm = locals[segment].residual_mm(p, radius_mm);
        if off_mm.abs() < fit.cutoff_mm {
            sums[segment].0 += off_mm * off_mm;
            sums[segment].1 += 1;
        }
    };
    let mut total = new();
    for part in whole.walk(&fit.model, fit.cutoff_mm, new, add) {
        total.iter_mut().zip(part).for_each(|(sum, part)| *sum = (sum.0 + part.0, sum.1 + part.1));
    }
    // Lines and arcs take turns.
    let rms = |(sum, count): &(f64, usize)| (*count >= LEAST_POINTS).then(|| (sum / *count as f64).sqrt());
    total.iter().step_by(2).map(rms).collect()
}
