//! One pass over the points: residuals, robust weights and one small moment matrix per segment.
//!
//! A rigid twist of the tube changes a point's distance by the product of its normal line's Plücker coordinates
//! (m, p x m) with the twist (paper 004, section 2). So a point's Jacobian row is that six-vector times the
//! segment's twist matrix, plus three columns of its own: the arc's CLR, its ovality and the tube's radius. The sum of
//! their outer products per segment, ten numbers squared, is all of the points that the normal equations need: a
//! pass costs O(points) whatever the number of bends.
//!
//! Sums run over chunks of fixed size and are added in order: the result does not depend on the threads.

use nalgebra::{Point3, SMatrix};
use rayon::prelude::*;

use super::local::{Arc, Local, Oval, prepare, settle};
use super::model::TubeModel;

/// Points per chunk of a sum.
const CHUNK: usize = 4096;

/// Derivatives of a residual: six Plücker coordinates (negated), own CLR, own ovality, tube radius.
pub const ROWS: usize = 9;

/// Places of the other derivatives and of the residual in a moment.
pub const OWN_RADIUS: usize = 6;
/// See [`OWN_RADIUS`].
pub const OVALITY: usize = 7;
/// See [`OWN_RADIUS`].
pub const TUBE_RADIUS: usize = 8;
/// See [`OWN_RADIUS`].
pub const RESIDUAL: usize = 9;

/// The derivatives and the residual, squared.
pub type Moment = SMatrix<f64, 10, 10>;

/// What a point sees of its segment, in the segment's frame.
#[derive(Debug, Clone, Copy)]
struct Sight {
    /// Signed distance from the tube's surface, outside positive.
    residual_mm: f64,
    row: [f64; ROWS],
}

/// The sums of one pass.
#[derive(Debug, Clone)]
pub struct Pass {
    /// Per segment, lower triangles.
    pub moments: Vec<Moment>,
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
        let chunks: Vec<Pass> = self
            .points
            .par_chunks(CHUNK)
            .zip(self.segment.par_chunks_mut(CHUNK))
            .map(|(points, segments)| {
                let mut pass = Pass::empty(locals.len());
                for (p, segment) in points.iter().zip(segments) {
                    let local = settle(p, segment, &locals);
                    let k = *segment as usize;
                    pass.add(k, &see(&local, &locals[k], model.tube_radius_mm), cutoff_mm);
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
    /// No points yet.
    pub fn empty(segments: usize) -> Pass {
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
        let h = [r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], sight.residual_mm];
        let moment = &mut self.moments[segment];
        for column in 0..=ROWS {
            let scaled = w * h[column];
            for row in column..=ROWS {
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

    /// Variance of one point's residual as the estimate feels it: times the inverse of the normal matrix it gives the
    /// covariance (asymptotics of an M-estimate, P. Huber 1981, section 7.6).
    pub fn variance_mm2(&self, parameters: usize) -> f64 {
        let n = self.used as f64;
        let freedom = n / (n - parameters as f64).max(1.0);
        freedom * self.psi_squared * self.weight / self.psi_slope.max(1e-12).powi(2)
    }
}

fn see(p: &Point3<f64>, local: &Local, tube_radius_mm: f64) -> Sight {
    match &local.arc {
        None => {
            let distance = p.y.hypot(p.z).max(1e-12);
            let (my, mz) = (p.y / distance, p.z / distance);
            let row = [0.0, -my, -mz, 0.0, p.x * mz, -p.x * my, 0.0, 0.0, -1.0];
            Sight { residual_mm: distance - tube_radius_mm, row }
        }
        Some(arc) => see_arc(p, arc, tube_radius_mm),
    }
}

/// In the arc's frame, with section coordinates (outward, z) around the spine. The residual's gradient is the section's
/// radial direction less r'(psi) / rho times the tangential one.
fn see_arc(p: &Point3<f64>, arc: &Arc, tube_radius_mm: f64) -> Sight {
    let (qx, qy) = (p.x, p.y - arc.radius_mm);
    let ring = qx.hypot(qy).max(1e-12);
    let (ux, uy) = (qx / ring, qy / ring);
    let outward = ring - arc.radius_mm;
    let distance = outward.hypot(p.z).max(1e-12);
    let (cos, sin) = (outward / distance, p.z / distance);
    let ramp = arc.ramp(ux.atan2(-uy).rem_euclid(std::f64::consts::TAU), tube_radius_mm);
    let oval = Oval::at(cos, sin, tube_radius_mm, arc.ovality_mm * ramp);
    let slope = oval.by_direction_mm / distance;
    // Along the section: outward and z components of the gradient.
    let (along_outward, along_z) = (cos + slope * sin, sin - slope * cos);
    let (mx, my, mz) = (along_outward * ux, along_outward * uy, along_z);
    let own = along_outward * (-uy - 1.0);
    let moment = [p.y * mz - p.z * my, p.z * mx - p.x * mz, p.x * my - p.y * mx];
    let turns = [-moment[0], -moment[1], -moment[2]];
    let own = [own, -ramp * oval.by_oval, -oval.by_radius];
    let row = [-mx, -my, -mz, turns[0], turns[1], turns[2], own[0], own[1], own[2]];
    Sight { residual_mm: distance - oval.radius_mm, row }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruct::normal;
    use crate::tube::{Bend, Frame, Lra};
    use nalgebra::{DVector, Vector3};
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
            ovality_mm: vec![-0.4, 0.3, -0.2],
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
            along in 0.01..0.99f64, around in 0.0..std::f64::consts::TAU, off in -1.0..1.0f64, common in any::<bool>(),
        ) {
            let model = model(common);
            let parameters = model.parameters();
            let p = near_surface(&model, along, around, off);
            let mut sample = Sample::new(vec![p], &model);
            let cutoff = 1e6;
            let pass = sample.pass(&model, cutoff);
            let (_, gradient) = normal::equations(&pass.moments, &model, &parameters);
            let distance = |m: &TubeModel| Sample::new(vec![p], m).residuals(m)[0];
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
        fn settling_from_any_start_finds_the_distance(along in 0.0..1.0f64, around in 0.0..std::f64::consts::TAU, off in -1.0..1.0f64) {
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
