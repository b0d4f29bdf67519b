//! How many bends: candidates from the spine's polygon at several tolerances, each fitted to a thinned sample, then
//! changed by one bend at a time as long as the data is better explained per value spent (Bayesian information
//! criterion): a bend dropped, two merged into one, one put in where the residuals show a kink.

use nalgebra::{Point3, UnitQuaternion, Vector3};

use super::arcline::{Limits, approximate};
use super::evidence;
use super::fit::{Effort, Fit, RadiusPrior, fit};
use super::model::TubeModel;
use super::moments::Sample;
use super::simplify::simplify;
use crate::tube::{Bend, SegmentKind};

/// Tolerances of the polygon in tube radii; the spine's own shrinkage in bends is 0.038 (paper 000, section 3.2).
const TOLERANCES: [f64; 4] = [0.03, 0.05, 0.08, 0.13];

/// Tolerance of the arcs over that of the polygon.
const ARC_FACTOR: f64 = 2.5;

/// First cut-off of residuals in tube radii.
const FIRST_CUTOFF: f64 = 0.4;

/// Bend radii of one tube are expected within this share of each other.
const RADIUS_SPREAD: f64 = 0.3;

/// A bend below this angle is tried without.
const DROP_RAD: f64 = 0.2;

/// Neighbouring bends this near to one plane are tried as one.
const MERGE_RAD: f64 = 0.6;

/// Length of a station of the residuals in tube radii, and the evidence that makes a bend be tried there.
const STATION_RADII: f64 = 1.0;
const KINK_CHI2: f64 = 25.0;

/// Kinks tried per round, and rounds.
const KINKS: usize = 3;
const ROUNDS: usize = 40;

/// First angle of a bend that is tried.
const TRIAL_RAD: f64 = 0.02;

/// A fitted structure.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The fit to the sample.
    pub fit: Fit,
    /// Information criterion: smaller is better.
    pub score: f64,
    /// Expectation of the bend radii that it was fitted with.
    pub prior: Option<RadiusPrior>,
}

/// The sample and what all candidates share.
struct Jury<'a> {
    sample: &'a [Point3<f64>],
    /// Noise by which misfits are judged.
    sigma_mm: f64,
    /// How many points say one thing: misfits count only once per patch of surface where residuals hang together.
    correlation: f64,
    prior: Option<RadiusPrior>,
}

/// Finds the structure: the best of all candidates, or None when the polygon carries none.
pub fn choose(polygon: &[Point3<f64>], sample: &[Point3<f64>], radius_mm: f64) -> Option<Candidate> {
    let mut jury = Jury { sample, sigma_mm: 0.0, correlation: 1.0, prior: None };
    let mut fits: Vec<Fit> = Vec::new();
    for tolerance in TOLERANCES {
        let kept: Vec<Point3<f64>> =
            simplify(polygon, tolerance * radius_mm).into_iter().map(|i| polygon[i]).collect();
        let limits = Limits { tolerance_mm: ARC_FACTOR * tolerance * radius_mm, min_radius_mm: radius_mm };
        let Some((lra, start)) = approximate(&kept, limits) else { continue };
        let model = TubeModel { start, lra, tube_radius_mm: radius_mm, common_radius: false };
        fits.push(jury.fit(&model));
    }
    jury.calibrate(fits.iter().min_by(|a, b| a.sigma_mm.total_cmp(&b.sigma_mm))?);
    let best = fits.into_iter().map(|f| jury.judge(f)).min_by(|a, b| a.score.total_cmp(&b.score))?;
    jury.prior = radius_prior(&best.fit.model);
    let mut best = jury.judge(jury.fit(&best.fit.model));
    for _ in 0..ROUNDS {
        let Some(better) = jury.improve(&best) else { break };
        jury.calibrate(&better.fit);
        best = jury.judge(better.fit);
    }
    let common = jury.judge(jury.fit(&with_common_radius(&best.fit.model)));
    Some(if common.score < best.score { common } else { best })
}

impl Jury<'_> {
    fn fit(&self, model: &TubeModel) -> Fit {
        let cutoff_mm = FIRST_CUTOFF * model.tube_radius_mm;
        let effort = Effort { cutoff_mm, rounds: 4, steps: 30, prior: self.prior };
        fit(&mut Sample::new(self.sample.to_vec(), model), model, effort)
    }

    fn judge(&self, fit: Fit) -> Candidate {
        let pass = Sample::new(self.sample.to_vec(), &fit.model).pass(&fit.model, 6.0 * self.sigma_mm);
        let misfit = 2.0 * pass.cost / (self.sigma_mm * self.sigma_mm) / self.correlation;
        let independent = self.sample.len() as f64 / self.correlation;
        let score = misfit + fit.parameters.len() as f64 * independent.ln();
        Candidate { fit, score, prior: self.prior }
    }

    /// Takes noise and correlation from a fit.
    fn calibrate(&mut self, fit: &Fit) {
        let sample = Sample::new(self.sample.to_vec(), &fit.model);
        let station = STATION_RADII * fit.model.tube_radius_mm;
        self.sigma_mm = fit.sigma_mm;
        self.correlation = evidence::correlation(&sample, &fit.model, station, fit.cutoff_mm, fit.sigma_mm);
    }

    /// The best of all changes by one bend, when it scores better.
    fn improve(&self, best: &Candidate) -> Option<Candidate> {
        let model = &best.fit.model;
        let n = model.lra.bends.len();
        let dropped =
            (0..n).filter(|&i| model.lra.bends[i].angle_rad < DROP_RAD).map(|i| without_bend(model, i));
        let merged = (1..n).filter_map(|i| merged(model, i));
        let inserted = self.kinks(&best.fit).into_iter().map(|(at, offset)| with_bend(model, at, &offset));
        let tried = dropped.chain(merged).chain(inserted.flatten());
        tried
            .map(|m| self.judge(self.fit(&m)))
            .filter(|c| c.score < best.score)
            .min_by(|a, b| a.score.total_cmp(&b.score))
    }

    /// Places where the points lie beside the model, the clearest first, no two close together.
    fn kinks(&self, fit: &Fit) -> Vec<(f64, Vector3<f64>)> {
        let sample = Sample::new(self.sample.to_vec(), &fit.model);
        let station = STATION_RADII * fit.model.tube_radius_mm;
        let mut offsets = evidence::offsets(&sample, &fit.model, station, 4.0 * fit.cutoff_mm, self.sigma_mm);
        offsets.retain(|o| o.chi2 > KINK_CHI2 * self.correlation);
        offsets.sort_by(|a, b| b.chi2.total_cmp(&a.chi2).then(a.at_mm.total_cmp(&b.at_mm)));
        let mut out: Vec<(f64, Vector3<f64>)> = Vec::new();
        for o in offsets {
            if out.len() < KINKS && out.iter().all(|(at, _)| (at - o.at_mm).abs() > 3.0 * station) {
                out.push((o.at_mm, o.offset));
            }
        }
        out
    }
}

fn radius_prior(model: &TubeModel) -> Option<RadiusPrior> {
    let radius_mm = mean_radius_mm(model)?;
    Some(RadiusPrior { radius_mm, spread_mm: RADIUS_SPREAD * radius_mm })
}

/// Mean CLR weighted by angle: sharp bends know theirs best. None without bends.
fn mean_radius_mm(model: &TubeModel) -> Option<f64> {
    let weight: f64 = model.lra.bends.iter().map(|b| b.angle_rad).sum();
    let sum: f64 = model.lra.bends.iter().map(|b| b.angle_rad * b.radius_mm).sum();
    (weight > 0.0).then(|| sum / weight)
}

fn with_common_radius(model: &TubeModel) -> TubeModel {
    let mut out = TubeModel { common_radius: true, ..model.clone() };
    if let Some(mean) = mean_radius_mm(model) {
        out.lra.bends.iter_mut().for_each(|b| b.radius_mm = mean);
    }
    out
}

/// The tube with bend `i` pulled straight.
fn without_bend(model: &TubeModel, i: usize) -> TubeModel {
    let mut out = model.clone();
    let bend = &mut out.lra.bends[i];
    bend.length_mm += bend.radius_mm * bend.angle_rad;
    bend.angle_rad = 0.0;
    out.lra = out.lra.merged();
    turn_into_pose(&mut out);
    out
}

/// The first row's rotation belongs into the pose.
fn turn_into_pose(model: &mut TubeModel) {
    if let Some(first) = model.lra.bends.first_mut() {
        model.start *= UnitQuaternion::from_axis_angle(&Vector3::x_axis(), first.rotation_rad);
        first.rotation_rad = 0.0;
    }
}

/// Bends `i - 1` and `i` as one, when they turn in about one plane the same way.
fn merged(model: &TubeModel, i: usize) -> Option<TubeModel> {
    let (one, other) = (model.lra.bends[i - 1], model.lra.bends[i]);
    let angle_rad = one.angle_rad + other.angle_rad;
    let arcs = one.radius_mm * one.angle_rad + other.radius_mm * other.angle_rad;
    if other.rotation_rad.abs() > MERGE_RAD || other.length_mm > 0.5 * arcs || angle_rad <= 0.0 {
        return None;
    }
    let mut out = model.clone();
    let radius_mm = (arcs + other.length_mm) / angle_rad;
    out.lra.bends[i - 1] = Bend { angle_rad, radius_mm, ..one };
    out.lra.bends.remove(i);
    if let Some(next) = out.lra.bends.get_mut(i) {
        next.rotation_rad += other.rotation_rad;
    }
    Some(out)
}

/// The tube with a shallow bend more at (or beside) an arc length, turning against the offset that the points
/// show there. On an arc the straights beside it are tried.
fn with_bend(model: &TubeModel, at_mm: f64, offset: &Vector3<f64>) -> Vec<TubeModel> {
    let spine = model.spine();
    let segments = spine.segments();
    let hit = segments.partition_point(|s| s.start_mm + s.length_mm < at_mm).min(segments.len() - 1);
    let lines = if segments[hit].kind == SegmentKind::Line { vec![hit] } else { vec![hit - 1, hit + 1] };
    let place = |line: usize| {
        let segment = &segments[line];
        let along = (at_mm - segment.start_mm).clamp(0.1 * segment.length_mm, 0.9 * segment.length_mm);
        insert(model, line / 2, along, &segment.start.inverse_transform_vector(offset))
    };
    lines.into_iter().map(place).collect()
}

/// Puts a bend into straight `row`; `offset` is seen from that straight's frame, whose y axis points to the centre
/// of the bend after it.
fn insert(model: &TubeModel, row: usize, along_mm: f64, offset: &Vector3<f64>) -> TubeModel {
    let mut out = model.clone();
    let radius_mm = mean_radius_mm(model).unwrap_or(6.0 * model.tube_radius_mm);
    // The centre lies opposite to the offset. The row's frame has its rotation applied already.
    let turn = (-offset.z).atan2(-offset.y);
    let before = out.lra.bends.get(row).map_or(0.0, |b| b.rotation_rad);
    let bend = Bend { length_mm: along_mm, rotation_rad: before + turn, angle_rad: TRIAL_RAD, radius_mm };
    let used = along_mm + radius_mm * TRIAL_RAD;
    match out.lra.bends.get_mut(row) {
        Some(next) => {
            next.length_mm = (next.length_mm - used).max(0.0);
            next.rotation_rad = -turn;
        }
        None => out.lra.last_length_mm = (out.lra.last_length_mm - used).max(0.0),
    }
    out.lra.bends.insert(row, bend);
    turn_into_pose(&mut out);
    out
}
