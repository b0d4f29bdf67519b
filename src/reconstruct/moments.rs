//! One pass over the points: residuals, robust weights and one small moment matrix per segment.
//!
//! A rigid twist of the tube changes a point's distance by the product of its normal line's Plücker coordinates
//! (m, p x m) with the twist (paper 004, section 2). So a point's Jacobian row is that six-vector times the
//! segment's twist matrix, plus two columns of its own: the arc's CLR and the tube's radius. The sum of their
//! outer products per segment, nine numbers squared, is all of the points that the normal equations need: a pass
//! costs O(points) whatever the number of bends.
//!
//! Sums run over chunks of fixed size and are added in order: the result does not depend on the threads.

use nalgebra::{DMatrix, DVector, Isometry3, Point3, SMatrix};
use rayon::prelude::*;

use super::model::{Parameter, SegmentMotion, TubeModel};
use crate::tube::SegmentKind;

/// Points per chunk of a sum.
const CHUNK: usize = 4096;

/// Rows and columns of a moment: six Plücker coordinates, own CLR, tube radius, residual.
type Moment = SMatrix<f64, 9, 9>;

/// A segment prepared for the pass.
struct Local {
    to_local: Isometry3<f64>,
    length_mm: f64,
    arc: Option<(f64, f64)>,
}

/// What a point sees of its segment, in the segment's frame.
#[derive(Debug, Clone, Copy)]
struct Sight {
    /// Signed distance from the tube's surface, outside positive.
    residual_mm: f64,
    /// Derivatives of the residual: Plücker coordinates (negated), own CLR, tube radius.
    row: [f64; 8],
}

/// The sums of one pass.
#[derive(Debug, Clone)]
pub struct Pass {
    moments: Vec<Moment>,
    /// Robust cost (Tukey's biweight), in mm^2.
    pub cost: f64,
    /// Sum of weights.
    pub weight: f64,
    /// Sum of psi^2 and of psi', for the covariance of the estimate.
    psi_squared: f64,
    psi_slope: f64,
    /// Points with weight above zero.
    pub used: usize,
}

/// Points with the segment that each belongs to, kept from pass to pass.
#[derive(Debug, Clone)]
pub struct Sample {
    /// The points.
    pub points: Vec<Point3<f64>>,
    segment: Vec<u32>,
}

impl Sample {
    /// Assigns every point to the closest segment by looking at all of them.
    pub fn new(points: Vec<Point3<f64>>, model: &TubeModel) -> Sample {
        let spine = model.spine();
        let segment = points.par_iter().map(|p| spine.closest(p).segment as u32).collect();
        Sample { points, segment }
    }

    /// Signed distances of all points from the model's surface; also moves each point to its segment.
    pub fn residuals(&mut self, model: &TubeModel) -> Vec<f64> {
        let locals = prepare(model);
        let radius = model.tube_radius_mm;
        self.points
            .par_iter()
            .zip(self.segment.par_iter_mut())
            .map(|(p, segment)| {
                let local = settle(p, segment, &locals);
                see(&local, &locals[*segment as usize], radius).residual_mm
            })
            .collect()
    }

    /// Segment index of every point (as of the last pass).
    pub fn segments(&self) -> &[u32] {
        &self.segment
    }

    /// Sums residuals and their derivatives with the biweight of cut-off `cutoff_mm`.
    pub fn pass(&mut self, model: &TubeModel, cutoff_mm: f64) -> Pass {
        let locals = prepare(model);
        let radius = model.tube_radius_mm;
        let chunks: Vec<Pass> = self
            .points
            .par_chunks(CHUNK)
            .zip(self.segment.par_chunks_mut(CHUNK))
            .map(|(points, segments)| {
                let mut pass = Pass::empty(locals.len());
                for (p, segment) in points.iter().zip(segments) {
                    let local = settle(p, segment, &locals);
                    let sight = see(&local, &locals[*segment as usize], radius);
                    pass.add(*segment as usize, &sight, cutoff_mm);
                }
                pass
            })
            .collect();
        let mut total = Pass::empty(locals.len());
        chunks.iter().for_each(|c| total.merge(c));
        total
    }
}

impl Pass {
    fn empty(segments: usize) -> Pass {
        let moments = vec![Moment::zeros(); segments];
        Pass { moments, cost: 0.0, weight: 0.0, psi_squared: 0.0, psi_slope: 0.0, used: 0 }
    }

    fn add(&mut self, segment: usize, sight: &Sight, cutoff_mm: f64) {
        let full = cutoff_mm * cutoff_mm / 6.0;
        let t = sight.residual_mm / cutoff_mm;
        let keep = 1.0 - t * t;
        if keep.is_nan() || keep <= 0.0 {
            self.cost += full;
            return;
        }
        let w = keep * keep;
        self.cost += full * (1.0 - w * keep);
        self.weight += w;
        self.psi_squared += (w * sight.residual_mm).powi(2);
        self.psi_slope += w - 4.0 * t * t * keep;
        self.used += 1;
        let r = &sight.row;
        let h = [r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], sight.residual_mm];
        let moment = &mut self.moments[segment];
        for column in 0..9 {
            let scaled = w * h[column];
            for row in column..9 {
                moment[(row, column)] += scaled * h[row];
            }
        }
    }

    fn merge(&mut self, other: &Pass) {
        self.moments.iter_mut().zip(&other.moments).for_each(|(a, b)| *a += b);
        self.cost += other.cost;
        self.weight += other.weight;
        self.psi_squared += other.psi_squared;
        self.psi_slope += other.psi_slope;
        self.used += other.used;
    }

    /// Normal matrix J^T W J and gradient J^T W r.
    pub fn normal_equations(
        &self,
        motions: &[SegmentMotion],
        parameters: &[Parameter],
    ) -> (DMatrix<f64>, DVector<f64>) {
        let n = parameters.len();
        let radius = parameters.iter().position(|p| *p == Parameter::TubeRadius);
        let (mut matrix, mut gradient) = (DMatrix::zeros(n, n), DVector::zeros(n));
        for (moment, motion) in self.moments.iter().zip(motions) {
            let mut moment = *moment;
            moment.fill_upper_triangle_with_lower_triangle();
            let mut basis = DMatrix::zeros(8, n);
            basis.rows_mut(0, 6).copy_from(&motion.twists);
            if let Some(own) = motion.own_radius {
                basis[(6, own)] = 1.0;
            }
            if let Some(radius) = radius {
                basis[(7, radius)] = 1.0;
            }
            matrix += basis.transpose() * (moment.fixed_view::<8, 8>(0, 0) * &basis);
            gradient += basis.transpose() * moment.fixed_view::<8, 1>(0, 8);
        }
        (matrix, gradient)
    }

    /// Variance of one point's residual as the estimate feels it: times the inverse of the normal matrix it gives the
    /// covariance (asymptotics of an M-estimate, P. Huber 1981, section 7.6).
    pub fn variance_mm2(&self, parameters: usize) -> f64 {
        let n = self.used as f64;
        let freedom = n / (n - parameters as f64).max(1.0);
        freedom * self.psi_squared * self.weight / self.psi_slope.max(1e-12).powi(2)
    }
}

fn prepare(model: &TubeModel) -> Vec<Local> {
    let local = |s: &crate::tube::Segment| Local {
        to_local: s.start.inverse(),
        length_mm: s.length_mm,
        arc: match s.kind {
            SegmentKind::Arc { radius_mm, angle_rad } => Some((radius_mm, angle_rad)),
            SegmentKind::Line => None,
        },
    };
    model.spine().segments().iter().map(local).collect()
}

/// Moves a point along the tube to the segment it faces; returns it in that segment's frame.
fn settle(p: &Point3<f64>, segment: &mut u32, locals: &[Local]) -> Point3<f64> {
    let last = locals.len() - 1;
    let mut came_from = usize::MAX;
    let mut k = (*segment as usize).min(last);
    loop {
        let local = locals[k].to_local * p;
        let next = match locals[k].side(&local) {
            -1 if k > 0 => k - 1,
            1 if k < last => k + 1,
            _ => k,
        };
        if next == k || next == came_from {
            *segment = k as u32;
            return local;
        }
        came_from = k;
        k = next;
    }
}

impl Local {
    /// Before (-1), on (0) or after (1) the segment.
    fn side(&self, p: &Point3<f64>) -> i32 {
        match self.arc {
            None => i32::from(p.x > self.length_mm) - i32::from(p.x < 0.0),
            Some((radius, angle)) => {
                // Turn measured from the middle of the gap opposite to the arc, so that it wraps there.
                let turn = p.x.atan2(radius - p.y);
                let turn = if turn < (angle / 2.0 - std::f64::consts::PI) {
                    turn + std::f64::consts::TAU
                } else {
                    turn
                };
                i32::from(turn > angle) - i32::from(turn < 0.0)
            }
        }
    }
}

fn see(p: &Point3<f64>, local: &Local, tube_radius_mm: f64) -> Sight {
    match local.arc {
        None => {
            let distance = p.y.hypot(p.z).max(1e-12);
            let (my, mz) = (p.y / distance, p.z / distance);
            let row = [0.0, -my, -mz, 0.0, p.x * mz, -p.x * my, 0.0, -1.0];
            Sight { residual_mm: distance - tube_radius_mm, row }
        }
        Some((radius, _)) => {
            let (qx, qy) = (p.x, p.y - radius);
            let ring = qx.hypot(qy).max(1e-12);
            let (ux, uy) = (qx / ring, qy / ring);
            let outward = ring - radius;
            let distance = outward.hypot(p.z).max(1e-12);
            let in_plane = outward / distance;
            let (mx, my, mz) = (in_plane * ux, in_plane * uy, p.z / distance);
            let own = in_plane * (-uy - 1.0);
            let moment = [p.y * mz - p.z * my, p.z * mx - p.x * mz, p.x * my - p.y * mx];
            let row = [-mx, -my, -mz, -moment[0], -moment[1], -moment[2], own, -1.0];
            Sight { residual_mm: distance - tube_radius_mm, row }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::{Bend, Frame, Lra};
    use nalgebra::Vector3;
    use proptest::prelude::*;

    fn model(common_radius: bool) -> TubeModel {
        let bend = |length_mm, rotation_rad, angle_rad, radius_mm| Bend {
            length_mm,
            rotation_rad,
            angle_rad,
            radius_mm,
        };
        TubeModel {
            start: Frame::new(Vector3::new(5.0, -7.0, 30.0), Vector3::new(0.4, -1.0, 0.3)),
            lra: Lra {
                bends: vec![
                    bend(60.0, 0.0, 1.2, 25.0),
                    bend(40.0, 2.0, 3.6, 31.0),
                    bend(0.5, -0.7, 0.1, 28.0),
                ],
                last_length_mm: 50.0,
            },
            tube_radius_mm: 10.0,
            common_radius,
        }
    }

    /// A point near the surface at a place along and around the tube.
    fn near_surface(model: &TubeModel, along: f64, around: f64, off: f64) -> Point3<f64> {
        let spine = model.spine();
        let frame = spine.frame_at(along * spine.length_mm());
        let radius = model.tube_radius_mm + off;
        frame * Point3::new(0.0, radius * around.cos(), radius * around.sin())
    }

    proptest! {
        #[test]
        fn derivatives_are_those_of_finite_differences(
            along in 0.01..0.99f64, around in 0.0..6.28f64, off in -1.0..1.0f64, common in any::<bool>(),
        ) {
            let model = model(common);
            let parameters = model.parameters();
            let p = near_surface(&model, along, around, off);
            let mut sample = Sample::new(vec![p], &model);
            let cutoff = 1e6;
            let pass = sample.pass(&model, cutoff);
            let (_, gradient) = pass.normal_equations(&model.motions(&parameters), &parameters);
            let distance = |m: &TubeModel| m.spine().closest(&p).distance_mm - m.tube_radius_mm;
            let r = distance(&model);
            prop_assume!(r.abs() > 1e-3);
            let h = 1e-6;
            let numeric: Vec<f64> = (0..parameters.len())
                .map(|j| {
                    let step = |d: f64| DVector::from_fn(parameters.len(), |k, _| if k == j { d } else { 0.0 });
                    let at = |d: f64| distance(&model.moved(&parameters, &step(d)));
                    (at(h) - at(-h)) / (2.0 * h)
                })
                .collect();
            for (j, parameter) in parameters.iter().enumerate() {
                let analytic = gradient[j] / r;
                let scale = 1.0 + numeric[j].abs();
                prop_assert!((analytic - numeric[j]).abs() < 1e-4 * scale, "{parameter:?}: {analytic} {}", numeric[j]);
            }
        }

        #[test]
        fn settling_from_any_start_finds_the_distance(along in 0.0..1.0f64, around in 0.0..6.28f64, off in -1.0..1.0f64) {
            let model = model(false);
            let p = near_surface(&model, along, around, off);
            let mut sample = Sample::new(vec![p], &model);
            let residual = sample.residuals(&model)[0];
            let expected = model.spine().closest(&p).distance_mm - model.tube_radius_mm;
            prop_assert!((residual - expected).abs() < 1e-9);
        }
    }

    #[test]
    fn sums_do_not_depend_on_the_number_of_threads() {
        let model = model(false);
        let points: Vec<_> = (0..20_000)
            .map(|i| near_surface(&model, (i as f64 * 0.618).fract(), i as f64, (i as f64 * 0.37).sin()))
            .collect();
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Sample::new(points.clone(), &model).pass(&model, 3.0))
        };
        let (one, three) = (run(1), run(3));
        assert_eq!(one.cost.to_bits(), three.cost.to_bits());
        assert_eq!(one.moments, three.moments);
    }
}
