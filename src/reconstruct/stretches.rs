//! How much of the residuals the points of one place share: passes that disagree, a tube that is not quite what the model
//! says. Such error does not average out over the points, and the sigmas must know.
//!
//! After the fit, on sums of all points over short stretches of the tube, taken in one walk (`whole`). What is judged
//! is as in `sections`: the shift, the size and the ovality of every stretch's own best section.

use std::collections::VecDeque;

use nalgebra::Vector3;

use super::fit::Fit;
use super::local::{Local, prepare};
use super::model::TubeModel;
use super::section::{
    Bins, JUDGED_POINTS, MEDIAN_CHI2, SPREADS, Sums, Values, cost, doubt_ovality, oval_doubt_mm, persistence,
    solve,
};
use super::whole::Whole;
use crate::recognize::median;
use crate::tube::Spine;

/// Weighted products of a stretch's derivatives (five values) and the residual: the lower triangle, row by row.
type Flat = [f64; 21];

/// Stretches apart whose errors add up in an angle or a distance, and in a bend's radius. What reaches farther along shifts and
/// turns the tube as a whole, and legs are long: it takes little part in them; an arc is short and bent by all of it.
const NEAR: usize = 1;
const ALONG_ARC: usize = 4;

/// Factors of the variance over that of independent noise.
#[derive(Debug, Clone, Copy)]
pub struct Correlation {
    /// Of all values.
    pub near: f64,
    /// Of the bends' radii.
    pub along_arc: f64,
}

/// By how much the stretches scatter about the model, over what their points' noise explains: 1 for independent noise
/// about the right tube. A median, so that a local misfit does not count.
pub fn correlation(whole: &Whole, fit: &Fit) -> Correlation {
    let model = &fit.model;
    let spine = model.spine();
    let radius = model.tube_radius_mm;
    let bins = Bins::new(&spine, radius, whole.len());
    let locals = prepare(model);
    let parts = whole.walk(model, fit.cutoff_mm, Run::default, |run, k, p| {
        add(run.at(bins.of(k, locals[k].share_along(p))), &locals[k], p, radius, fit.cutoff_mm);
    });
    let mut total = vec![[0.0; 21]; bins.total];
    for part in &parts {
        let total = total[part.first..].iter_mut().zip(&part.sums);
        total.for_each(|(a, b)| a.iter_mut().zip(b).for_each(|(a, b)| *a += b));
    }
    let places = bins.places().zip(bins.places_mm()).zip(&total);
    let judged = places.filter(|(_, sums)| sums[0] >= JUDGED_POINTS);
    let own: Vec<Own> =
        judged.map(|((segment, at_mm), s)| own(s, model, &spine, (segment, at_mm), fit.sigma_mm)).collect();
    let mut excess: Vec<f64> = own.iter().map(|o| o.excess).collect();
    let offs: Vec<Vector3<f64>> = own.iter().map(|o| o.off_mm).collect();
    let scatter = (median(&mut excess).unwrap_or(0.0) / MEDIAN_CHI2).max(1.0);
    let factor = |farthest| scatter * persistence(&offs, farthest);
    Correlation { near: factor(NEAR), along_arc: factor(ALONG_ARC) }
}

/// Sums of neighbouring stretches: those that a part of the file has points of, mostly a few of them.
#[derive(Default)]
struct Run {
    first: usize,
    sums: VecDeque<Flat>,
}

impl Run {
    /// The sums of a stretch, which is among them from then on.
    fn at(&mut self, stretch: usize) -> &mut Flat {
        if self.sums.is_empty() {
            self.first = stretch;
        }
        while stretch < self.first {
            self.sums.push_front([0.0; 21]);
            self.first -= 1;
        }
        let at = stretch - self.first;
        if at >= self.sums.len() {
            self.sums.resize(at + 1, [0.0; 21]);
        }
        &mut self.sums[at]
    }
}

/// A stretch by itself.
struct Own {
    /// What its own values would take off the squared residuals, over the noise's variance.
    excess: f64,
    /// By how much it lies off the model, across the tube.
    off_mm: Vector3<f64>,
}

fn add(sums: &mut Flat, local: &Local, p: [f64; 3], radius_mm: f64, cutoff_mm: f64) {
    let residual_mm = local.residual_mm(p, radius_mm);
    let t = residual_mm / cutoff_mm;
    let keep = 1.0 - t * t;
    if keep <= 0.0 {
        return;
    }
    let (u, v) = local.across(p);
    let size = (u * u + v * v).sqrt().max(1e-12);
    let (c, s) = (u / size, v / size);
    let h = [1.0, c, s, c * c - s * s, 2.0 * s * c, residual_mm];
    let mut at = 0;
    for i in 0..6 {
        let scaled = keep * keep * h[i];
        for value in &h[..=i] {
            sums[at] += scaled * value;
            at += 1;
        }
    }
}

/// The stretch whose sums these are, on a segment at an arc length.
fn own(sums: &Flat, model: &TubeModel, spine: &Spine, (segment, at_mm): (usize, f64), noise_mm: f64) -> Own {
    let mut at = sums.iter();
    let mut full = Sums::zeros();
    for i in 0..6 {
        for (j, value) in (0..=i).zip(&mut at) {
            (full[(i, j)], full[(j, i)]) = (*value, *value);
        }
    }
    doubt_ovality(&mut full, noise_mm / oval_doubt_mm(model, spine, at_mm));
    let values = solve(&full, &SPREADS.map(|spread| spread * model.tube_radius_mm), noise_mm);
    let excess = (cost(&full, &Values::zeros()) - cost(&full, &values)) / (noise_mm * noise_mm);
    // On an arc the first direction across is outwards.
    let outward = if segment % 2 == 1 { -1.0 } else { 1.0 };
    let off = Vector3::new(0.0, outward * values[1], values[2]);
    Own { excess, off_mm: spine.frame_at(at_mm).rotation * off }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_holds_its_stretches_in_whatever_order_they_come() {
        let mut run = Run::default();
        for stretch in [5, 9, 2, 5, 2, 3] {
            run.at(stretch)[0] += stretch as f64;
        }
        let sums: Vec<f64> = run.sums.iter().map(|s| s[0]).collect();
        assert_eq!((run.first, sums), (2, vec![4.0, 3.0, 0.0, 10.0, 0.0, 0.0, 0.0, 9.0]));
    }
}
