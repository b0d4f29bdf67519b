//! The inner loop of a pass: points of one segment, a row of them side by side, into the segment's moment.
//!
//! Under `moments`. Points are collected by segment and worked off when a bucket is full, in loops over arrays of fixed
//! size, which the compiler turns into vector instructions.

#![allow(clippy::needless_range_loop)] // one index for all that lies side by side

use super::local::{Arc, Local, Outline, oval_share};
use super::model::TubeModel;
use super::moments::{DOUBT, FLATTENING, Moment, OWN_ANGLE, Pass, SQUARE};
use super::ramps::Ramps;

/// Points side by side.
const LANES: usize = 32;

/// One number for each of the points.
type Lane = [f64; LANES];

/// The rows of a moment that a bend's points fill: the flattening where it is asked for, the last two on ramps.
const ALL_ROWS: [usize; SQUARE] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];

/// A lane of zeros.
const ZERO: Lane = [0.0; LANES];

/// Points of one segment that wait, in its frame.
struct Bucket {
    x: Lane,
    y: Lane,
    z: Lane,
    /// How far inwards on a ramp the point is, 0 to 1, and how oval the section is there.
    share: Lane,
    ramp: Lane,
    count: usize,
}

/// Collects points by segment and sums them up.
pub struct Adder<'a> {
    locals: &'a [Local],
    tube_radius_mm: f64,
    cutoff_mm: f64,
    /// Rows that bends fill outside of ramps that are told apart.
    rows: usize,
    ramps: &'a Ramps,
    /// Of the segments, then of the ramps' stretches.
    buckets: Vec<Bucket>,
    pass: Pass,
}

impl<'a> Adder<'a> {
    /// For the segments of a model, and stretches of its ramps told apart; residuals beyond the cut-off do not count.
    pub fn new(locals: &'a [Local], ramps: &'a Ramps, model: &TubeModel, cutoff_mm: f64) -> Adder<'a> {
        // Beside the axis: on it a point has no direction, and not even without weight is NaN nothing.
        let empty = || Bucket { x: ZERO, y: ZERO, z: [1.0; LANES], share: ZERO, ramp: ZERO, count: 0 };
        Adder {
            locals,
            tube_radius_mm: model.tube_radius_mm,
            cutoff_mm,
            rows: if model.flattening.is_free() { OWN_ANGLE } else { FLATTENING },
            ramps,
            buckets: (0..locals.len() + ramps.len()).map(|_| empty()).collect(),
            pass: Pass { ramps: vec![Moment::zeros(); ramps.len()], ..Pass::empty(locals.len()) },
        }
    }

    /// Adds a point in the frame of the segment that it faces.
    pub fn add(&mut self, segment: usize, p: [f64; 3]) {
        let local = &self.locals[segment];
        let (mut full, mut own) = ((1.0, if local.arc.is_some() { 1.0 } else { 0.0 }), segment);
        if let Some((at_end, share)) = local.place_on_ramp(p, self.tube_radius_mm) {
            full = (share, oval_share(share));
            own = self.ramps.stretch(segment, at_end, share).map_or(segment, |s| self.locals.len() + s);
        }
        let bucket = &mut self.buckets[own];
        let at = bucket.count;
        [bucket.x[at], bucket.y[at], bucket.z[at]] = p;
        (bucket.share[at], bucket.ramp[at]) = full;
        bucket.count += 1;
        if bucket.count == LANES {
            self.work_off(own);
        }
    }

    /// The sums of all points added.
    pub fn finish(mut self) -> Pass {
        (0..self.buckets.len()).for_each(|k| self.work_off(k));
        self.pass
    }

    fn work_off(&mut self, own: usize) {
        let bucket = &mut self.buckets[own];
        let count = std::mem::take(&mut bucket.count);
        if count == 0 {
            return;
        }
        // What points before have left behind is finite and gets no weight.
        let stretch = own.checked_sub(self.locals.len());
        let (segment, end) = stretch.map_or((own, None), |s| {
            let (segment, at_end) = self.ramps.place(s);
            (segment, Some(at_end))
        });
        let sums = Sums { pass: &mut self.pass, segment, stretch, cutoff_mm: self.cutoff_mm, count };
        match &self.locals[segment].arc {
            None => line(bucket, self.tube_radius_mm, sums),
            Some(arc) => bend(bucket, arc, self.tube_radius_mm, (self.rows, end), sums),
        }
    }
}

/// Where a bucket's sums go.
struct Sums<'a> {
    pass: &'a mut Pass,
    segment: usize,
    stretch: Option<usize>,
    cutoff_mm: f64,
    count: usize,
}

fn line(at: &Bucket, tube_radius_mm: f64, mut sums: Sums) {
    let mut h = [ZERO; 6];
    for l in 0..LANES {
        let (x, y, z) = (at.x[l], at.y[l], at.z[l]);
        let distance = (y * y + z * z).sqrt().max(1e-12);
        let (my, mz) = (y / distance, z / distance);
        h[0][l] = -my;
        h[1][l] = -mz;
        h[2][l] = x * mz;
        h[3][l] = -x * my;
        h[4][l] = -1.0;
        h[5][l] = distance - tube_radius_mm;
    }
    let weights = sums.weigh(&h[5]);
    sums.square(&h, &weights, &[1, 2, 4, 5, 8, 9]);
}

/// In the arc's frame, with section coordinates (outward, z) around the spine. The residual's gradient is the section's
/// radial direction less r'(psi) / rho times the tangential one. Of the rows so many as are asked for; all on a ramp, of which
/// `end` says whether it is that at the arc's end.
fn bend(at: &Bucket, arc: &Arc, tube_radius_mm: f64, (rows, end): (usize, Option<bool>), mut sums: Sums) {
    let mut h = [ZERO; SQUARE];
    for l in 0..LANES {
        let (x, y, z, ramp) = (at.x[l], at.y[l], at.z[l], at.ramp[l]);
        let qy = y - arc.radius_mm;
        let ring = (x * x + qy * qy).sqrt().max(1e-12);
        let (ux, uy) = (x / ring, qy / ring);
        let outward = ring - arc.radius_mm;
        let distance = (outward * outward + z * z).sqrt().max(1e-12);
        let (cos, sin) = (outward / distance, z / distance);
        let (oval_mm, flat_mm) = (arc.ovality_mm * ramp, arc.flattening_mm * ramp);
        let outline = Outline::at(cos, sin, tube_radius_mm, oval_mm, flat_mm);
        let slope = outline.by_direction_mm / distance;
        // Along the section: outward and z components of the gradient.
        let (along_outward, mz) = (cos + slope * sin, sin - slope * cos);
        let (mx, my) = (along_outward * ux, along_outward * uy);
        h[0][l] = -mx;
        h[1][l] = -my;
        h[2][l] = -mz;
        h[3][l] = z * my - y * mz;
        h[4][l] = x * mz - z * mx;
        h[5][l] = y * mx - x * my;
        h[6][l] = along_outward * (-uy - 1.0);
        h[7][l] = -ramp * outline.by_oval;
        h[8][l] = -outline.by_radius;
        h[9][l] = distance - outline.radius_mm;
        h[10][l] = -ramp * outline.by_flat;
        h[DOUBT][l] = -outline.by_oval;
    }
    let rows = end.map_or(rows, |_| SQUARE);
    if let Some(at_end) = end {
        on_ramp(at, arc, tube_radius_mm, at_end, &mut h);
    }
    let weights = sums.weigh(&h[9]);
    sums.square(&h[..rows], &weights, &ALL_ROWS[..rows]);
}

/// Adds what the derivatives owe to the slope of a ramp along the tube.
fn on_ramp(at: &Bucket, arc: &Arc, tube_radius_mm: f64, at_end: bool, h: &mut [Lane; SQUARE]) {
    let full = arc.full_ramp_mm(tube_radius_mm);
    let is_short = full < tube_radius_mm;
    // A short arc is all ramp, as long as the arc is.
    let (by_angle, by_own_radius, by_tube_radius) =
        if is_short { (0.5 * arc.radius_mm, 0.5 * arc.angle_rad, 0.0) } else { (0.0, 0.0, 1.0) };
    let sign = if at_end { -1.0 } else { 1.0 };
    for l in 0..LANES {
        let (x, y, z, share) = (at.x[l], at.y[l], at.z[l], at.share[l]);
        let qy = y - arc.radius_mm;
        let ring = (x * x + qy * qy).sqrt().max(1e-12);
        let outward = ring - arc.radius_mm;
        let cos = outward / (outward * outward + z * z).sqrt().max(1e-12);
        let by_flat = (4.0 * cos * cos - 3.0) * cos;
        let uneven = h[DOUBT][l] * arc.ovality_mm - by_flat * arc.flattening_mm;
        // Of the residual along the tube, inwards on the ramp.
        let slope =
            uneven * 0.5 * std::f64::consts::PI * (std::f64::consts::PI * share).sin() / full.max(1e-12);
        let along = sign * slope * arc.radius_mm / ring;
        let (mx, my) = (-along * qy / ring, along * x / ring);
        h[0][l] -= mx;
        h[1][l] -= my;
        h[3][l] += z * my;
        h[4][l] -= z * mx;
        h[5][l] += y * mx - x * my;
        let inwards = share * full / arc.radius_mm - sign * arc.radius_mm * x / (ring * ring);
        h[6][l] += slope * (inwards - share * by_own_radius);
        h[8][l] -= slope * share * by_tube_radius;
        h[OWN_ANGLE][l] = slope * (if at_end { arc.radius_mm } else { 0.0 } - share * by_angle);
    }
}

impl Sums<'_> {
    /// Tukey's biweight of the residuals; adds up what does not depend on the derivatives.
    fn weigh(&mut self, residuals_mm: &Lane) -> Lane {
        let (mut keep, mut squares) = (ZERO, ZERO);
        for l in 0..LANES {
            let t = residuals_mm[l] / self.cutoff_mm;
            squares[l] = t * t;
            keep[l] = if l < self.count { (1.0 - t * t).max(0.0) } else { 0.0 };
        }
        let weights = keep.map(|k| k * k);
        let full = self.cutoff_mm * self.cutoff_mm / 6.0;
        let (mut cost, mut weight, mut psi_squared, mut psi_slope) = (0.0, 0.0, 0.0, 0.0);
        for l in 0..self.count {
            let (k, w, t2) = (keep[l], weights[l], squares[l]);
            cost += 1.0 - w * k;
            weight += w;
            psi_squared += w * w * t2;
            psi_slope += k * (k - 4.0 * t2);
        }
        self.pass.cost += full * cost;
        self.pass.weight += weight;
        self.pass.psi_squared += psi_squared * self.cutoff_mm * self.cutoff_mm;
        self.pass.psi_slope += psi_slope;
        self.pass.sizes.count(&squares[..self.count]);
        weights
    }

    /// Adds the weighted products of all pairs to the moment's rows.
    fn square(&mut self, h: &[Lane], weights: &Lane, rows: &[usize]) {
        let moment: &mut Moment = match self.stretch {
            None => &mut self.pass.moments[self.segment],
            Some(stretch) => &mut self.pass.ramps[stretch],
        };
        for (j, &column) in rows.iter().enumerate() {
            let mut scaled = ZERO;
            for l in 0..LANES {
                scaled[l] = weights[l] * h[j][l];
            }
            for i in j..rows.len() {
                moment[(rows[i], column)] += dot(&scaled, &h[i]);
            }
        }
    }
}

/// Four sums side by side.
fn dot(a: &Lane, b: &Lane) -> f64 {
    let mut sums = [0.0; 4];
    for (a, b) in a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0) {
        for k in 0..4 {
            sums[k] += a[k] * b[k];
        }
    }
    (sums[0] + sums[2]) + (sums[1] + sums[3])
}
