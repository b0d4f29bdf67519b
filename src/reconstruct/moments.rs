//! One pass over the points: residuals, robust weights and one small moment matrix per segment.
//!
//! A rigid twist of the tube changes a point's distance by the product of its normal line's Plücker coordinates
//! (m, p x m) with the twist (paper 004, section 2). So a point's Jacobian row is that six-vector times the
//! segment's twist matrix, plus a few columns of its own: the arc's CLR, its ovality, the tube's radius, where it is asked
//! for the arc's flattening, and on ramps that are told apart what the arc's angle does to them. The sum of their outer
//! products per segment is all of the points that the normal equations need: a pass costs O(points) whatever the number
//! of bends.
//!
//! Sums run over chunks of fixed size and are added in order: the result does not depend on the threads.

use nalgebra::{Point3, SMatrix};
use rayon::prelude::*;

use super::lanes::Adder;
use super::local::{prepare, settle};
use super::model::TubeModel;
use super::normal::symmetric;
use super::ramps::Ramps;

/// Points per chunk of a sum.
pub(super) const CHUNK: usize = 1024;

/// Fewer points say nothing of how well a straight was scanned.
const STRAIGHT_POINTS: f64 = 100.0;

/// A point this near to a segment's surface, in tube radii, is on it beyond doubt.
const ON_SURFACE: f64 = 0.1;

/// Derivatives of a residual: six Plücker coordinates (negated), own CLR, own ovality, tube radius.
pub const ROWS: usize = 9;

/// Places of the other derivatives and of the residual in a moment. Those behind the residual only some fits ask for.
pub const OWN_RADIUS: usize = 6;
/// See [`OWN_RADIUS`].
pub const OVALITY: usize = 7;
/// See [`OWN_RADIUS`].
pub const TUBE_RADIUS: usize = 8;
/// See [`OWN_RADIUS`].
pub const RESIDUAL: usize = 9;
/// See [`OWN_RADIUS`].
pub const FLATTENING: usize = 10;
/// What the arc's angle does to the ramp at its end.
pub const OWN_ANGLE: usize = 11;
/// How oval a stretch of a ramp is beside what the model says, see [`Pass::doubting`].
pub const DOUBT: usize = 12;
/// Rows of a moment.
pub const SQUARE: usize = 13;

/// The derivatives and the residual, squared.
pub type Moment = SMatrix<f64, SQUARE, SQUARE>;

/// The sums of one pass.
#[derive(Debug, Clone)]
pub struct Pass {
    /// Per segment, lower triangles.
    pub moments: Vec<Moment>,
    /// Of stretches where sections turn oval, those that were asked for.
    pub(super) ramps: Vec<Moment>,
    /// Robust cost (Tukey's biweight), in mm^2.
    pub cost: f64,
    /// Sum of weights.
    pub weight: f64,
    /// Sum of psi^2 and of psi', for the covariance of the estimate.
    pub(super) psi_squared: f64,
    pub(super) psi_slope: f64,
    /// How large the residuals are within the cut-off.
    pub sizes: Sizes,
}

/// How many residuals there are of every size, in equal steps up to the cut-off: counts are the same in any order.
#[derive(Debug, Clone, Default)]
pub struct Sizes {
    /// Empty before the first residual.
    counts: Vec<u32>,
}

/// Steps of the residuals' size; a median is good to a small part of one.
const STEPS: usize = 512;

impl Sizes {
    /// Counts squares of residuals over the cut-off.
    pub(super) fn count(&mut self, squares: &[f64]) {
        self.counts.resize(STEPS, 0);
        for square in squares.iter().filter(|t2| **t2 < 1.0) {
            self.counts[((square.sqrt() * STEPS as f64) as usize).min(STEPS - 1)] += 1;
        }
    }

    fn merge(&mut self, other: &Sizes) {
        if !other.counts.is_empty() {
            self.counts.resize(STEPS, 0);
            self.counts.iter_mut().zip(&other.counts).for_each(|(a, b)| *a += b);
        }
    }

    /// Residuals within the cut-off.
    pub fn used(&self) -> usize {
        self.counts.iter().map(|n| *n as usize).sum()
    }

    /// Median size of the residuals within the cut-off, as a share of it; None without any.
    pub fn median(&self) -> Option<f64> {
        let half = 0.5 * self.used() as f64;
        let mut below = 0.0;
        for (step, n) in self.counts.iter().enumerate() {
            let n = f64::from(*n);
            if n > 0.0 && below + n >= half {
                return Some((step as f64 + (half - below) / n) / STEPS as f64);
            }
            below += n;
        }
        None
    }
}

/// Points with the segment that each belongs to, kept from pass to pass.
#[derive(Debug, Clone)]
pub struct Sample {
    /// The points.
    pub points: Vec<Point3<f64>>,
    segment: Vec<u32>,
}

impl Sample {
    /// Assigns every point to the segment on whose surface it lies, off all surfaces to the closest. The point before
    /// is usually on the same segment.
    pub fn new(points: Vec<Point3<f64>>, model: &TubeModel) -> Sample {
        let (spine, locals) = (model.spine(), prepare(model));
        let radius = model.tube_radius_mm;
        let find = |part: &[Point3<f64>]| -> Vec<u32> {
            let mut segment = 0;
            let one = |p: &Point3<f64>| {
                let local = settle(p, &mut segment, &locals);
                if locals[segment as usize].residual_mm(local.into(), radius).abs() > ON_SURFACE * radius {
                    segment = spine.closest(p).segment as u32;
                }
                segment
            };
            part.iter().map(one).collect()
        };
        let segment = points.par_chunks(CHUNK).map(find).collect::<Vec<_>>().concat();
        Sample { points, segment }
    }

    /// Signed distances of all points from the model's surface; also moves each point to its segment.
    pub fn residuals(&mut self, model: &TubeModel) -> Vec<f64> {
        let locals = prepare(model);
        let radius = model.tube_radius_mm;
        self.points
            .par_iter()
            .zip(self.segment.par_iter_mut())
            .with_min_len(CHUNK)
            .map(|(p, segment)| {
                let local = settle(p, segment, &locals);
                locals[*segment as usize].residual_mm(local.into(), radius)
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
        let ramps = Ramps::none(locals.len());
        let sum = |(points, segments): (&[Point3<f64>], &mut [u32])| {
            let mut adder = Adder::new(&locals, &ramps, model, cutoff_mm);
            for (p, segment) in points.iter().zip(segments) {
                let local = settle(p, segment, &locals);
                adder.add(*segment as usize, local.into());
            }
            adder.finish()
        };
        let chunks = self.points.par_chunks(CHUNK).zip(self.segment.par_chunks_mut(CHUNK));
        Pass::total(locals.len(), chunks.map(sum).collect::<Vec<_>>())
    }
}

impl Pass {
    /// No points yet.
    pub fn empty(segments: usize) -> Pass {
        let moments = vec![Moment::zeros(); segments];
        let ramps = Vec::new();
        Pass {
            moments,
            ramps,
            cost: 0.0,
            weight: 0.0,
            psi_squared: 0.0,
            psi_slope: 0.0,
            sizes: Sizes::default(),
        }
    }

    /// The sums of all parts, added in order.
    pub(super) fn total(segments: usize, parts: impl IntoIterator<Item = Pass>) -> Pass {
        let mut total = Pass::empty(segments);
        parts.into_iter().for_each(|p| total.merge(&p));
        total
    }

    /// Points with weight above zero.
    pub fn used(&self) -> usize {
        self.sizes.used()
    }

    /// Median size of the residuals within the cut-off that the pass was made with.
    pub fn median_mm(&self, cutoff_mm: f64) -> Option<f64> {
        self.sizes.median().map(|share| share * cutoff_mm)
    }

    /// Root mean square residual of each straight's points, as they are weighted; none of too few. A straight that moved under the
    /// scan, or is bowed or dented, shows here.
    pub fn straight_rms_mm(&self) -> Vec<Option<f64>> {
        // Lines and arcs take turns. The tube's radius moves every point alike: its square is the weight.
        let straights = self.moments.iter().step_by(2);
        let sums = straights.map(|m| (m[(TUBE_RADIUS, TUBE_RADIUS)], m[(RESIDUAL, RESIDUAL)]));
        sums.map(|(weight, square)| (weight >= STRAIGHT_POINTS).then(|| (square / weight).sqrt())).collect()
    }

    /// By how much a step of iteratively reweighted least squares falls short of Newton's: weights fall as residuals grow.
    pub fn shortfall(&self) -> f64 {
        (self.weight / self.psi_slope.max(1e-12)).clamp(1.0, 1.5)
    }

    /// The sums with the ovality of every stretch of the ramps free within what is known of it, and eliminated: how a section turns
    /// oval along the tube is not known well enough to tell where the bend is. `noise_mm`: standard deviation of a point.
    pub(super) fn doubting(mut self, ramps: &Ramps, noise_mm: f64) -> Pass {
        for (moment, (segment, doubt_mm)) in std::mem::take(&mut self.ramps).iter().zip(ramps.doubts()) {
            let mut moment = symmetric(moment);
            let column = moment.column(DOUBT).into_owned();
            let square = column[DOUBT] + (noise_mm / doubt_mm).powi(2);
            moment -= column * column.transpose() / square;
            moment.row_mut(DOUBT).fill(0.0);
            moment.column_mut(DOUBT).fill(0.0);
            self.moments[segment] += moment.lower_triangle();
            self.cost -= 0.5 * column[RESIDUAL].powi(2) / square;
        }
        self
    }

    pub(super) fn merge(&mut self, other: &Pass) {
        self.ramps.resize(self.ramps.len().max(other.ramps.len()), Moment::zeros());
        self.ramps.iter_mut().zip(&other.ramps).for_each(|(a, b)| *a += b);
        self.moments.iter_mut().zip(&other.moments).for_each(|(a, b)| *a += b);
        self.cost += other.cost;
        self.weight += other.weight;
        self.psi_squared += other.psi_squared;
        self.psi_slope += other.psi_slope;
        self.sizes.merge(&other.sizes);
    }

    /// Variance of one point's residual as the estimate feels it: times the inverse of the normal matrix it gives the
    /// covariance (asymptotics of an M-estimate, P. Huber 1981, section 7.6).
    pub fn variance_mm2(&self, parameters: usize) -> f64 {
        let n = self.used() as f64;
        let freedom = n / (n - parameters as f64).max(1.0);
        freedom * self.psi_squared * self.weight / self.psi_slope.max(1e-12).powi(2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruct::model::Flattening;
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
            flattening: Flattening::Free { bends_mm: vec![-0.2, -0.3, 0.0], spread_mm: 0.3 },
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
            // Where the section turns oval the slope along the tube is left out of the derivatives.
            let locals = prepare(&model);
            let local = &locals[sample.segments()[0] as usize];
            let ramp = local.ramp_at((local.to_local * p).into(), model.tube_radius_mm);
            prop_assume!(ramp == 0.0 || ramp == 1.0);
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
        fn on_ramps_that_are_told_apart_they_are_too(
            inwards in 0.05..0.95f64, bend in 0..3usize, at_end in any::<bool>(), around in 0.0..std::f64::consts::TAU,
            off in -1.0..1.0f64, common in any::<bool>(),
        ) {
            let model = TubeModel { common_radius: common, ..model(common) };
            let parameters = model.parameters();
            let arc = model.spine().segments()[2 * bend + 1];
            let inwards_mm = inwards * (0.5 * arc.length_mm).min(model.tube_radius_mm);
            let at_mm = arc.start_mm + if at_end { arc.length_mm - inwards_mm } else { inwards_mm };
            let p = near_surface(&model, at_mm / model.spine().length_mm(), around, off);
            let (locals, ramps) = (prepare(&model), Ramps::of(&model));
            let mut segment = 2 * bend as u32 + 1;
            let local = settle(&p, &mut segment, &locals);
            let mut adder = Adder::new(&locals, &ramps, &model, 1e6);
            adder.add(segment as usize, local.into());
            // So noisy a point doubts nothing.
            let pass = adder.finish().doubting(&ramps, 1e9);
            let (_, gradient) = normal::equations(&pass.moments, &model, &parameters);
            let distance = |m: &TubeModel| Sample::new(vec![p], m).residuals(m)[0];
            let r = distance(&model);
            prop_assume!(r.abs() > 1e-3);
            let h = 1e-6;
            for (j, parameter) in parameters.iter().enumerate() {
                let step = |d: f64| DVector::from_fn(parameters.len(), |k, _| if k == j { d } else { 0.0 });
                let at = |d: f64| distance(&model.moved(&parameters, &step(d)));
                let numeric = (at(h) - at(-h)) / (2.0 * h);
                let analytic = gradient[j] / r;
                prop_assert!((analytic - numeric).abs() < 1e-4 * (1.0 + numeric.abs()), "{parameter:?}: {analytic} {numeric}");
            }
        }

        #[test]
        fn settling_from_any_start_finds_the_distance(along in 0.0..1.0f64, around in 0.0..std::f64::consts::TAU, off in -1.0..1.0f64) {
            let model = TubeModel { ovality_mm: vec![0.0; 3], flattening: Flattening::NONE, ..model(false) };
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
