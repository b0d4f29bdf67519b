//! How much of the residuals the points of one place share: passes that disagree, a tube that is not quite what the model
//! says. Such error does not average out over the points, and the sigmas must know.
//!
//! After the fit, on sums of all points over short stretches of the tube, taken in one walk (`whole`). What is judged
//! is as in `sections`: the shift, the size and the ovality of every stretch's own best section.

use super::fit::Fit;
use super::local::{Local, prepare};
use super::model::TubeModel;
use super::radius::median;
use super::section::{
    Bins, JUDGED_POINTS, MEDIAN_CHI2, SPREADS, Sums, Values, cost, doubt_ovality, oval_doubt_mm, solve,
};
use super::whole::Whole;
use crate::tube::Spine;

/// Weighted products of a stretch's derivatives (five values) and the residual: the lower triangle, row by row.
type Flat = [f64; 21];

/// By how much the stretches scatter about the model, over what their points' noise explains: 1 for independent noise
/// about the right tube. A median, so that a local misfit does not count.
pub fn correlation(whole: &Whole, fit: &Fit) -> f64 {
    let model = &fit.model;
    let spine = model.spine();
    let radius = model.tube_radius_mm;
    let bins = Bins::new(&spine, radius, whole.len());
    let locals = prepare(model);
    let new = || vec![[0.0; 21]; bins.total];
    let parts = whole.walk(model, fit.cutoff_mm, new, |sums: &mut Vec<Flat>, k, p| {
        add(&mut sums[bins.of(k, locals[k].share_along(p))], &locals[k], p, radius, fit.cutoff_mm);
    });
    let mut total = new();
    for part in &parts {
        total.iter_mut().zip(part).for_each(|(a, b)| a.iter_mut().zip(b).for_each(|(a, b)| *a += b));
    }
    let judged = bins.places_mm().zip(&total).filter(|(_, sums)| sums[0] >= JUDGED_POINTS);
    let mut excess: Vec<f64> = judged.map(|(at, s)| excess(s, model, &spine, at, fit.sigma_mm)).collect();
    (median(&mut excess).unwrap_or(0.0) / MEDIAN_CHI2).max(1.0)
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

/// What the stretch's own values would take off the squared residuals, over the noise's variance.
fn excess(sums: &Flat, model: &TubeModel, spine: &Spine, at_mm: f64, noise_mm: f64) -> f64 {
    let mut at = sums.iter();
    let mut full = Sums::zeros();
    for i in 0..6 {
        for (j, value) in (0..=i).zip(&mut at) {
            (full[(i, j)], full[(j, i)]) = (*value, *value);
        }
    }
    doubt_ovality(&mut full, noise_mm / oval_doubt_mm(model, spine, at_mm));
    let values = solve(&full, &SPREADS.map(|spread| spread * model.tube_radius_mm), noise_mm);
    (cost(&full, &Values::zeros()) - cost(&full, &values)) / (noise_mm * noise_mm)
}
