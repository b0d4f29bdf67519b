//! How much of the residuals the points of one place share: passes that disagree, a tube that is not quite what the model
//! says. Such error does not average out over the points, and the sigmas must know.
//!
//! After the fit, on sums of all points over short stretches of the tube, taken in one walk (`whole`). What is judged
//! is as in `sections`: the shift, the size and the ovality of every stretch's own best section.

use nalgebra::{Cholesky, Matrix2, Matrix5, SMatrix, Vector5};

use super::fit::Fit;
use super::local::{Local, prepare};
use super::model::TubeModel;
use super::radius::median;
use super::whole::Whole;
use crate::tube::Spine;

/// Length of a stretch in tube radii: so that it holds this many points, within this range.
const ENOUGH_POINTS: f64 = 15.0;
const RADII: (f64, f64) = (0.5, 2.0);

/// What is expected of a stretch's values, in tube radii: size, two shifts, two ovalities.
const SPREADS: [f64; 5] = [0.01, 0.3, 0.3, 0.02, 0.02];

/// Beside a tangent point, this near in tube radii, ovality may differ from the model's by this share of the bend's.
const NEAR_TANGENT_RADII: f64 = 1.2;
const OVAL_SHARE: f64 = 0.15;

/// Fewest points that judge a stretch, and the median of chi-squared with five degrees of freedom.
const JUDGED_POINTS: f64 = 8.0;
const MEDIAN_CHI2: f64 = 4.351;

/// Weighted products of a stretch's derivatives (five values) and the residual: the lower triangle, row by row.
type Sums = [f64; 21];

/// By how much the stretches scatter about the model, over what their points' noise explains: 1 for independent noise
/// about the right tube. A median, so that a local misfit does not count.
pub fn correlation(whole: &Whole, fit: &Fit) -> f64 {
    let model = &fit.model;
    let spine = model.spine();
    let radius = model.tube_radius_mm;
    let per_radius = whole.len() as f64 * radius / spine.length_mm().max(1e-9);
    let bins = Bins::new(&spine, (ENOUGH_POINTS / per_radius).clamp(RADII.0, RADII.1) * radius);
    let locals = prepare(model);
    let new = || vec![[0.0; 21]; bins.total];
    let parts = whole.walk(model, fit.cutoff_mm, new, |sums: &mut Vec<Sums>, k, p| {
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

fn add(sums: &mut Sums, local: &Local, p: [f64; 3], radius_mm: f64, cutoff_mm: f64) {
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
fn excess(sums: &Sums, model: &TubeModel, spine: &Spine, at_mm: f64, noise_mm: f64) -> f64 {
    let mut at = sums.iter();
    let mut full = SMatrix::<f64, 6, 6>::zeros();
    for i in 0..6 {
        for (j, value) in (0..=i).zip(&mut at) {
            (full[(i, j)], full[(j, i)]) = (*value, *value);
        }
    }
    let doubt_mm = oval_doubt_mm(model, spine, at_mm);
    if doubt_mm > 0.0 {
        // Ovality may be what it likes, within the doubt: eliminated.
        let free = full.fixed_view::<2, 2>(3, 3) + Matrix2::identity() * (noise_mm / doubt_mm).powi(2);
        let rows: SMatrix<f64, 2, 6> = full.fixed_view::<2, 6>(3, 0).into_owned();
        full -= free.try_inverse().map_or(SMatrix::zeros(), |inverse| rows.transpose() * inverse * rows);
    }
    let square: Matrix5<f64> = full.fixed_view::<5, 5>(0, 0).into_owned();
    let mixed: Vector5<f64> = full.fixed_view::<5, 1>(0, 5).into_owned();
    let held = SPREADS.map(|spread| (noise_mm / (spread * model.tube_radius_mm)).powi(2));
    let Some(solver) = Cholesky::new(square + Matrix5::from_diagonal(&held.into())) else { return 0.0 };
    let values = solver.solve(&mixed);
    (2.0 * mixed.dot(&values) - values.dot(&(square * values))) / (noise_mm * noise_mm)
}

/// By how much a stretch's ovality may differ from the model's.
fn oval_doubt_mm(model: &TubeModel, spine: &Spine, at_mm: f64) -> f64 {
    let near = |tangent_mm: f64| (at_mm - tangent_mm).abs() < NEAR_TANGENT_RADII * model.tube_radius_mm;
    let doubt = |(i, oval_mm): (usize, &f64)| {
        let arc = &spine.segments()[2 * i + 1];
        let doubtful = near(arc.start_mm) || near(arc.start_mm + arc.length_mm);
        if doubtful { OVAL_SHARE * oval_mm.abs() } else { 0.0 }
    };
    model.ovality_mm.iter().enumerate().map(doubt).fold(0.0, f64::max)
}

/// How the segments are cut into stretches.
struct Bins {
    /// First stretch of every segment, how many there are, where the segment begins, and its length.
    segments: Vec<(usize, usize, f64, f64)>,
    total: usize,
}

impl Bins {
    fn new(spine: &Spine, length_mm: f64) -> Bins {
        let mut bins = Bins { segments: Vec::new(), total: 0 };
        for segment in spine.segments() {
            let count = (segment.length_mm / length_mm).ceil().max(1.0) as usize;
            bins.segments.push((bins.total, count, segment.start_mm, segment.length_mm));
            bins.total += count;
        }
        bins
    }

    fn of(&self, segment: usize, share: f64) -> usize {
        let (first, count, ..) = self.segments[segment];
        first + ((share * count as f64) as usize).min(count - 1)
    }

    /// The middle of every stretch: arc length.
    fn places_mm(&self) -> impl Iterator<Item = f64> + '_ {
        self.segments.iter().flat_map(|&(_, count, start_mm, length_mm)| {
            (0..count).map(move |i| start_mm + (i as f64 + 0.5) / count as f64 * length_mm)
        })
    }
}
