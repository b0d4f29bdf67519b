//! How many bends: candidates from the spine's polygon at several tolerances, each fitted to a thinned sample, then
//! changed by one bend at a time as long as the data is better explained per value spent (Bayesian information
//! criterion): a bend dropped, two merged into one, one put in where the residuals show a kink.

use nalgebra::{Point3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::arcline::{Limits, approximate};
use super::evidence::{self, Joint};
use super::fit::{Effort, Fit, RadiusPrior, fit};
use super::model::TubeModel;
use super::moments::Sample;
use super::simplify::simplify;
use crate::tube::{Bend, Lra, Segment};

/// Tolerances of the polygon in tube radii; the spine's own shrinkage in bends is 0.038 (paper 000, section 3.2).
const TOLERANCES: [f64; 4] = [0.03, 0.05, 0.08, 0.13];

/// Tolerance of the arcs over that of the polygon.
const ARC_FACTOR: f64 = 2.5;

/// More bends than this are a coil or a hose, not a bent tube.
pub const MOST_BENDS: usize = 40;

/// Seamless joints in one plane from which on a table is no bent tube's.
const FREE_FORM_JOINTS: usize = 4;

/// First cut-off of residuals in tube radii.
const FIRST_CUTOFF: f64 = 0.4;

/// First cut-off after a small change of the structure.
const CHANGE_CUTOFF: f64 = 0.15;

/// A change must gain this much, or rounding could turn it back for ever.
const LEAST_GAIN: f64 = 1e-6;

/// Bend radii of one tube are expected within this share of each other.
const RADIUS_SPREAD: f64 = 0.3;

/// A bend below this angle is tried without.
const DROP_RAD: f64 = 0.2;

/// Neighbouring bends this near to one plane are tried as one.
const MERGE_RAD: f64 = 0.6;

/// Length of a station of the residuals in tube radii, and the evidence that makes a bend be tried there.
const STATION_RADII: f64 = 1.0;
const JOINT_GAIN: f64 = 40.0;

/// Joints tried per round, and rounds.
const JOINTS: usize = 3;
const ROUNDS: usize = 20;

/// Pairs of bends tried as one per round.
const PAIRS: usize = 4;

/// A bend this much wider than the mean may be two.
const WIDE: f64 = 1.3;

/// Steps per round of a fit, and of one that only has to show whether a change is worth it.
const FULL_STEPS: usize = 30;
const TRIAL_STEPS: usize = 16;

/// Smallest first angle of a bend that is tried.
const TRIAL_RAD: f64 = 0.01;

/// A fitted structure.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The fit to the sample.
    pub fit: Fit,
    /// The sample with each point at its segment.
    sample: Sample,
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
    let mut fits: Vec<(Fit, Sample)> = Vec::new();
    for tolerance in TOLERANCES {
        let kept: Vec<Point3<f64>> =
            simplify(polygon, tolerance * radius_mm).into_iter().map(|i| polygon[i]).collect();
        let limits = Limits { tolerance_mm: ARC_FACTOR * tolerance * radius_mm, min_radius_mm: radius_mm };
        let Some((lra, start)) = approximate(&kept, limits) else { continue };
        if lra.bends.len() > MOST_BENDS || is_free_form(&lra, radius_mm) {
            continue;
        }
        let model = TubeModel::round(start, lra, radius_mm);
        let cutoff = FIRST_CUTOFF * radius_mm;
        fits.push(jury.fit(Sample::new(sample.to_vec(), &model), &model, cutoff, FULL_STEPS));
    }
    let clearest = fits.iter().min_by(|a, b| a.0.sigma_mm.total_cmp(&b.0.sigma_mm))?;
    jury.calibrate(&clearest.0, &clearest.1);
    let mut best = fits.into_iter().map(|f| jury.judge(f)).min_by(|a, b| a.score.total_cmp(&b.score))?;
    jury.prior = radius_prior(&best.fit.model);
    best = jury.judge(jury.refit(&best, &best.fit.model, FULL_STEPS));
    for _ in 0..ROUNDS {
        let Some(better) = jury.improve(&best) else { break };
        best = jury.judge(jury.refit(&better, &better.fit.model, FULL_STEPS));
        jury.calibrate(&best.fit, &best.sample);
        best = jury.judge((best.fit, best.sample));
    }
    let common = jury.judge(jury.refit(&best, &with_common_radius(&best.fit.model), FULL_STEPS));
    Some(if common.score < best.score { common } else { best })
}

impl Jury<'_> {
    fn fit(&self, mut sample: Sample, model: &TubeModel, cutoff_mm: f64, steps: usize) -> (Fit, Sample) {
        let fit = fit(&mut sample, model, Effort { cutoff_mm, rounds: 4, steps, prior: self.prior });
        (fit, sample)
    }

    /// Fits a model that is a small change of the best one's.
    fn refit(&self, best: &Candidate, model: &TubeModel, steps: usize) -> (Fit, Sample) {
        let cutoff = (CHANGE_CUTOFF * model.tube_radius_mm).max(2.0 * best.fit.cutoff_mm);
        self.fit(best.sample.follow(&best.fit.model, model), model, cutoff, steps)
    }

    fn judge(&self, (fit, mut sample): (Fit, Sample)) -> Candidate {
        let pass = sample.pass(&fit.model, 6.0 * self.sigma_mm);
        let misfit = 2.0 * pass.cost / (self.sigma_mm * self.sigma_mm) / self.correlation;
        let independent = self.sample.len() as f64 / self.correlation;
        let score = misfit + fit.parameters.len() as f64 * independent.ln();
        Candidate { fit, sample, score, prior: self.prior }
    }

    /// Takes noise and correlation from a fit.
    fn calibrate(&mut self, fit: &Fit, sample: &Sample) {
        let station = STATION_RADII * fit.model.tube_radius_mm;
        self.sigma_mm = fit.sigma_mm;
        self.correlation = evidence::correlation(sample, &fit.model, station, fit.cutoff_mm, fit.sigma_mm);
    }

    /// The best of all changes by one bend, when it scores better.
    fn improve(&self, best: &Candidate) -> Option<Candidate> {
        let model = &best.fit.model;
        let n = model.lra.bends.len();
        let dropped =
            (0..n).filter(|&i| model.lra.bends[i].angle_rad < DROP_RAD).map(|i| without_bend(model, i));
        let merged = likeliest_pairs(model).into_iter().filter_map(|i| merged(model, i));
        let joints = self.joints(best);
        let inserted = joints.iter().flat_map(|j| with_bend(model, j));
        let split = joints.iter().flat_map(|j| split(model, j));
        let doubled = (0..n).filter_map(|i| doubled(model, i));
        let all = dropped.chain(merged).chain(inserted).chain(split).chain(doubled);
        let tried: Vec<TubeModel> = all.filter(|m| m.lra.bends.len() <= MOST_BENDS).collect();
        tried
            .into_par_iter()
            .map(|m| self.judge(self.refit(best, &m, TRIAL_STEPS)))
            .collect::<Vec<_>>()
            .into_iter()
            .filter(|c| c.score < best.score - LEAST_GAIN)
            .min_by(|a, b| a.score.total_cmp(&b.score))
    }

    /// Places where a joint would help, the most helpful first, no two close together.
    fn joints(&self, best: &Candidate) -> Vec<Joint> {
        let radius = best.fit.model.tube_radius_mm;
        let cutoff = 3.0 * best.fit.cutoff_mm;
        let station = STATION_RADII * radius;
        let mut joints =
            evidence::joints(&mut best.sample.clone(), &best.fit, station, cutoff, self.sigma_mm);
        joints.retain(|j| j.gain > JOINT_GAIN * self.correlation);
        joints.sort_by(|a, b| b.gain.total_cmp(&a.gain).then(a.at_mm.total_cmp(&b.at_mm)));
        let mut out: Vec<Joint> = Vec::new();
        for joint in joints {
            if out.len() < JOINTS && out.iter().all(|o| (joint.at_mm - o.at_mm).abs() > 2.0 * radius) {
                out.push(joint);
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
    let gone = out.lra.bends.remove(i);
    out.ovality_mm.remove(i);
    let length = gone.length_mm + gone.radius_mm * gone.angle_rad;
    match out.lra.bends.get_mut(i) {
        Some(next) => {
            next.length_mm += length;
            next.rotation_rad += gone.rotation_rad;
        }
        None => out.lra.last_length_mm += length,
    }
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

/// Bends that are likeliest one with the bend before: hardly a straight and hardly a turn between.
fn likeliest_pairs(model: &TubeModel) -> Vec<usize> {
    let bends = &model.lra.bends;
    let apart =
        |i: &usize| bends[*i].length_mm / model.tube_radius_mm + bends[*i].rotation_rad.abs() / MERGE_RAD;
    let mut pairs: Vec<usize> = (1..bends.len()).collect();
    pairs.sort_by(|a, b| apart(a).total_cmp(&apart(b)));
    pairs.truncate(PAIRS);
    pairs
}

/// Whether the table is a curve of no straights cut into arcs: bend on bend in one plane, which a bender would bend as
/// one. Fewer than [`FREE_FORM_JOINTS`] such joints may be a measurement's doubt about one bend.
pub fn is_free_form(lra: &Lra, tube_radius_mm: f64) -> bool {
    let seamless = |b: &&Bend| b.length_mm < 0.2 * tube_radius_mm && b.rotation_rad.abs() < 0.3;
    let joints = lra.bends.iter().skip(1).filter(seamless).count();
    joints >= FREE_FORM_JOINTS && 2 * joints >= lra.bends.len()
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
    out.ovality_mm.remove(i);
    if let Some(next) = out.lra.bends.get_mut(i) {
        next.rotation_rad += other.rotation_rad;
    }
    Some(out)
}

/// The bends at (or just beside) a joint, each as two with a straight between.
fn split(model: &TubeModel, joint: &Joint) -> Vec<TubeModel> {
    let spine = model.spine();
    let near = 1.5 * model.tube_radius_mm;
    let arcs = spine.segments().iter().enumerate().filter(|(k, s)| {
        let reach = s.start_mm - near..s.start_mm + s.length_mm + near;
        k % 2 == 1 && s.length_mm > 0.0 && reach.contains(&joint.at_mm)
    });
    let apart = |(k, segment): (usize, &Segment)| {
        let mut out = model.clone();
        let share = ((joint.at_mm - segment.start_mm) / segment.length_mm).clamp(0.15, 0.85);
        let whole = out.lra.bends[k / 2];
        // At least a little apart, also where the bend itself is shorter than that.
        let length_mm = joint.shift_mm.min(segment.length_mm).max(0.1 * model.tube_radius_mm);
        out.lra.bends[k / 2].angle_rad *= share;
        let angle_rad = whole.angle_rad * (1.0 - share);
        let rotation_rad = joint.turn_rad.x.clamp(-0.5, 0.5);
        out.lra.bends.insert(k / 2 + 1, Bend { length_mm, rotation_rad, angle_rad, ..whole });
        out.ovality_mm.insert(k / 2, model.ovality_mm[k / 2]);
        out
    };
    arcs.map(apart).collect()
}

/// A bend that is much wider than the others as two of the usual radius at its ends.
fn doubled(model: &TubeModel, i: usize) -> Option<TubeModel> {
    let whole = model.lra.bends[i];
    let usual = mean_radius_mm(model)?;
    if whole.radius_mm < WIDE * usual || whole.angle_rad <= 0.0 {
        return None;
    }
    let mut out = model.clone();
    let half = Bend { angle_rad: 0.5 * whole.angle_rad, radius_mm: usual, ..whole };
    let between = (whole.radius_mm - usual) * whole.angle_rad;
    out.lra.bends[i] = half;
    out.lra.bends.insert(i + 1, Bend { length_mm: between, rotation_rad: 0.0, ..half });
    out.ovality_mm.insert(i, 0.0);
    Some(out)
}

/// The tube with the shallow bend that a joint asks for. Where the joint lies on (or near the end of) an arc the
/// straights beside it are tried.
fn with_bend(model: &TubeModel, joint: &Joint) -> Vec<TubeModel> {
    let spine = model.spine();
    let segments = spine.segments();
    let near = 1.5 * model.tube_radius_mm;
    let lines = segments.iter().enumerate().filter(|(k, s)| {
        let (from, to) = (s.start_mm - near, s.start_mm + s.length_mm + near);
        let beside = |arc: Option<&Segment>| {
            arc.is_some_and(|a| (a.start_mm..=a.start_mm + a.length_mm).contains(&joint.at_mm))
        };
        let next_to = (*k > 0 && beside(segments.get(k - 1))) || beside(segments.get(k + 1));
        k % 2 == 0 && ((from..=to).contains(&joint.at_mm) || next_to)
    });
    let place = |(k, segment): (usize, &Segment)| {
        let along = (joint.at_mm - segment.start_mm).clamp(0.1 * segment.length_mm, 0.9 * segment.length_mm);
        insert(model, k / 2, along, joint)
    };
    lines.map(place).collect()
}

/// Puts a bend into straight `row`, turning as the joint does.
fn insert(model: &TubeModel, row: usize, along_mm: f64, joint: &Joint) -> TubeModel {
    let mut out = model.clone();
    let radius_mm = mean_radius_mm(model).unwrap_or(6.0 * model.tube_radius_mm);
    let angle_rad = joint.turn_rad.yz().norm().clamp(TRIAL_RAD, 20.0 * TRIAL_RAD);
    // The plane's normal (0, y, z) is the frame's z axis rolled about x.
    let roll = (-joint.turn_rad.y).atan2(joint.turn_rad.z);
    let before = out.lra.bends.get(row).map_or(0.0, |b| b.rotation_rad);
    let half = 0.5 * radius_mm * angle_rad;
    let bend =
        Bend { length_mm: (along_mm - half).max(0.0), rotation_rad: before + roll, angle_rad, radius_mm };
    match out.lra.bends.get_mut(row) {
        Some(next) => {
            next.length_mm = (next.length_mm - along_mm - half).max(0.0);
            next.rotation_rad = -roll;
        }
        None => out.lra.last_length_mm = (out.lra.last_length_mm - along_mm - half).max(0.0),
    }
    out.lra.bends.insert(row, bend);
    out.ovality_mm.insert(row, 0.0);
    turn_into_pose(&mut out);
    out
}
