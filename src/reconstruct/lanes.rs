//! The inner loop of a pass: points of one segment, a row of them side by side, into the segment's moment.
//!
//! Under `moments`. Points are collected by segment and worked off when a bucket is full, in loops over arrays of fixed
//! size, which the compiler turns into vector instructions.

#![allow(clippy::needless_range_loop)] // one index for all that lies side by side

use super::local::{Arc, Local, Outline};
use super::model::TubeModel;
use super::moments::{FLATTENING, Moment, Pass, SQUARE};

/// Points side by side.
const LANES: usize = 32;

/// One number for each of the points.
type Lane = [f64; LANES];

/// The rows of a moment that a bend's points fill; the last where it is asked for.
const ALL_ROWS: [usize; SQUARE] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10];

/// A lane of zeros.
const ZERO: Lane = [0.0; LANES];

/// Points of one segment that wait, in its frame.
struct Bucket {
    x: Lane,
    y: Lane,
    z: Lane,
    /// How oval the section is at the point, 0 to 1.
    ramp: Lane,
    count: usize,
}

/// Collects points by segment and sums them up.
pub struct Adder<'a> {
    locals: &'a [Local],
    tube_radius_mm: f64,
    cutoff_mm: f64,
    flattening: bool,
    buckets: Vec<Bucket>,
    pass: Pass,
}

impl<'a> Adder<'a> {
    /// For the segments of a model; residuals beyond the cut-off do not count.
    pub fn new(locals: &'a [Local], model: &TubeModel, cutoff_mm: f64) -> Adder<'a> {
        // Beside the axis: on it a point has no direction, and not even without weight is NaN nothing.
        let empty = || Bucket { x: ZERO, y: ZERO, z: [1.0; LANES], ramp: ZERO, count: 0 };
        Adder {
            locals,
            tube_radius_mm: model.tube_radius_mm,
            cutoff_mm,
            flattening: model.flattening.is_free(),
            buckets: locals.iter().map(|_| empty()).collect(),
            pass: Pass::empty(locals.len()),
        }
    }

    /// Adds a point in the frame of the segment that it faces.
    pub fn add(&mut self, segment: usize, p: [f64; 3]) {
        let ramp = self.locals[segment].ramp_at(p, self.tube_radius_mm);
        let bucket = &mut self.buckets[segment];
        let at = bucket.count;
        (bucket.x[at], bucket.y[at], bucket.z[at], bucket.ramp[at]) = (p[0], p[1], p[2], ramp);
        bucket.count += 1;
        if bucket.count == LANES {
            self.work_off(segment);
        }
    }

    /// The sums of all points added.
    pub fn finish(mut self) -> Pass {
        (0..self.buckets.len()).for_each(|k| self.work_off(k));
        self.pass
    }

    fn work_off(&mut self, segment: usize) {
        let bucket = &mut self.buckets[segment];
        let count = std::mem::take(&mut bucket.count);
        if count == 0 {
            return;
        }
        // What points before have left behind is finite and gets no weight.
        let sums = Sums { pass: &mut self.pass, segment, cutoff_mm: self.cutoff_mm, count };
        match &self.locals[segment].arc {
            None => line(bucket, self.tube_radius_mm, sums),
            Some(arc) => bend(bucket, arc, self.tube_radius_mm, self.flattening, sums),
        }
    }
}

/// Where a bucket's sums go.
struct Sums<'a> {
    pass: &'a mut Pass,
    segment: usize,
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
/// radial direction less r'(psi) / rho times the tangential one.
fn bend(at: &Bucket, arc: &Arc, tube_radius_mm: f64, flattening: bool, mut sums: Sums) {
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
    }
    let weights = sums.weigh(&h[9]);
    let rows = if flattening { SQUARE } else { FLATTENING };
    sums.square(&h[..rows], &weights, &ALL_ROWS[..rows]);
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
        let moment: &mut Moment = &mut self.pass.moments[self.segment];
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
