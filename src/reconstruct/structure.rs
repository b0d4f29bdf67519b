//! How many bends: candidates from the spine's polygon at several tolerances, each fitted to the measured centre line, then
//! changed by one bend at a time as long as the data is better explained per value spent (Bayesian information
//! criterion): a bend dropped, two merged into one, one split, one put in where the residuals show a kink.

use nalgebra::Point3;
use rayon::prelude::*;

use super::arcline::{Limits, approximate};
use super::evidence::{Joint, Solved};
use super::fit::{CUTOFF_SIGMAS, Descent, Effort, Fit, RadiusPrior, Way, descend, fit};
use super::model::{Parameter, TubeModel};
use super::moments::Sample;
use super::moves::{
    doubled, is_free_form, likeliest_pairs, mean_radius_mm, merged, split, with_bend, with_common_radius,
    without_bend,
};
use super::profile::{Held, lengths};
use super::sections::CentreLine;
use super::simplify::simplify;
use crate::tube::Decision;

/// Tolerances of the polygon in tube radii; the spine's own shrinkage in bends is 0.038 (paper 000, section 3.2).
const TOLERANCES: [f64; 4] = [0.03, 0.05, 0.08, 0.13];

/// Tolerance of the arcs over that of the polygon.
const ARC_FACTOR: f64 = 2.5;

/// More bends than this are a coil or a hose, not a bent tube.
pub const MOST_BENDS: usize = 40;

/// A change must gain this much, or rounding could turn it back for ever.
const LEAST_GAIN: f64 = 1e-6;

/// Candidates whose scores differ by less are one: about what a fit leaves unresolved.
const SAME_SCORE: f64 = 0.01;

/// Bend radii of one tube are expected within this share of each other.
const RADIUS_SPREAD: f64 = 0.3;

/// A value this many times less certain than what it costs would still be spent is tried without.
const DOUBT: f64 = 4.0;

/// Changes turned down at the end that are remembered.
const REMEMBERED: usize = 5;

/// Gain of a joint, per independent point, that makes a bend be tried there.
const JOINT_GAIN: f64 = 30.0;

/// Joints tried per round, rounds, and times that the sections are measured anew about the best tube.
const JOINTS: usize = 3;
const ROUNDS: usize = 20;
const MEASUREMENTS: usize = 4;

/// Steps of a fit, and of one that only has to show whether a change is worth it.
const FULL_STEPS: usize = 100;
const TRIAL_STEPS: usize = 40;

/// A fitted structure.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The tube.
    pub model: TubeModel,
    /// Its free values.
    parameters: Vec<Parameter>,
    /// Information criterion: smaller is better.
    pub score: f64,
}

/// What was found.
#[derive(Debug, Clone)]
pub struct Structure {
    /// The tube.
    pub model: TubeModel,
    /// Standard deviation of a point about the surface.
    pub noise_mm: f64,
    /// Expectation of the bend radii that it was fitted with.
    pub prior: Option<RadiusPrior>,
    /// What the linear covariance overstates.
    pub held: Vec<Held>,
    /// How it came about, and what was turned down at the end.
    pub decisions: Vec<Decision>,
}

/// The data and what all candidates share.
struct Jury {
    line: CentreLine,
    /// How many points say one thing.
    correlation: f64,
    prior: Option<RadiusPrior>,
    decisions: Vec<Decision>,
}

/// A change to be tried.
struct Change {
    /// In words.
    what: String,
    /// The bend of the tube as it is, counted from 0.
    bend: Option<usize>,
    model: TubeModel,
}

/// Finds the structure: the best of all candidates, or None when the polygon carries none.
pub fn choose(polygon: &[Point3<f64>], sample: &[Point3<f64>], radius_mm: f64) -> Option<Structure> {
    let mut jury = Jury {
        line: CentreLine::of_polygon(polygon, radius_mm),
        correlation: 1.0,
        prior: None,
        decisions: Vec::new(),
    };
    let starts: Vec<TubeModel> =
        TOLERANCES.par_iter().filter_map(|t| start(polygon, t * radius_mm, radius_mm)).collect();
    let mut rough: Vec<Candidate> =
        starts.par_iter().map(|m| jury.fit(m, FULL_STEPS, f64::INFINITY)).collect();
    rough.sort_by(|a, b| a.score.total_cmp(&b.score));
    rough.dedup_by(|b, a| b.score - a.score < SAME_SCORE && b.parameters.len() == a.parameters.len());
    let first = rough.first()?;
    jury.line = CentreLine::measure(sample, &first.model, false);
    let fitted: Vec<Candidate> =
        rough.par_iter().map(|c| jury.fit(&c.model, FULL_STEPS, f64::INFINITY)).collect();
    let clearest = fitted.iter().min_by(|a, b| a.score.total_cmp(&b.score))?;
    jury.prior = radius_prior(&clearest.model);
    jury.correlation = jury.line.correlation(&clearest.model);
    let mut best =
        fitted.iter().map(|c| jury.judge(c.model.clone())).min_by(|a, b| a.score.total_cmp(&b.score))?;
    for _ in 0..MEASUREMENTS {
        jury.line = CentreLine::measure(sample, &best.model, true);
        best = jury.fit(&best.model, FULL_STEPS, f64::INFINITY);
        jury.correlation = jury.line.correlation(&best.model);
        best = jury.judge(best.model);
        let bends = best.model.lra.bends.len();
        let before = best.score;
        best = jury.search(best);
        if best.score >= before && best.model.lra.bends.len() == bends {
            break;
        }
    }
    if best.model.lra.bends.len() > 1 {
        let common = jury.fit(&with_common_radius(&best.model), FULL_STEPS, f64::INFINITY);
        let gain = best.score - common.score;
        jury.decide("one CLR for all bends".to_owned(), None, gain, gain > 0.0);
        if gain > 0.0 {
            // With one radius neighbours may turn out to be one bend.
            best = jury.search(common);
        }
    }
    Some(jury.confirmed(sample, best.model))
}

/// The arc-line spline of the polygon at a tolerance.
fn start(polygon: &[Point3<f64>], tolerance_mm: f64, radius_mm: f64) -> Option<TubeModel> {
    let kept: Vec<Point3<f64>> = simplify(polygon, tolerance_mm).into_iter().map(|i| polygon[i]).collect();
    let limits = Limits { tolerance_mm: ARC_FACTOR * tolerance_mm, min_radius_mm: radius_mm };
    let (lra, pose) = approximate(&kept, limits)?;
    let usual = lra.bends.len() <= MOST_BENDS && !is_free_form(&lra, radius_mm);
    usual.then(|| TubeModel::round(pose, lra, radius_mm))
}

impl Jury {
    /// Fits a model to the sections; given up when it cannot score below `goal`.
    fn fit(&self, model: &TubeModel, steps: usize, goal: f64) -> Candidate {
        let parameters = model.parameters();
        let noise_mm = self.line.noise_mm;
        let worth = (goal - self.price(parameters.len(), model.lra.bends.len()))
            * self.correlation
            * noise_mm
            * noise_mm
            / 2.0;
        let way = Way { cutoff_mm: f64::INFINITY, noise_mm, steps, goal: worth };
        let descent = descend(&mut self.line.clone(), model.clone(), &parameters, self.prior, way);
        self.scored(descent, parameters)
    }

    /// Scores a model as it is.
    fn judge(&self, model: TubeModel) -> Candidate {
        self.fit(&model, 0, f64::INFINITY)
    }

    fn scored(&self, descent: Descent, parameters: Vec<Parameter>) -> Candidate {
        let noise_mm = self.line.noise_mm;
        let misfit = 2.0 * descent.pass.cost / (noise_mm * noise_mm) / self.correlation;
        let score = misfit + self.price(parameters.len(), descent.model.lra.bends.len());
        Candidate { model: descent.model, parameters, score }
    }

    /// What a number of values costs; and each bend, that its place is the best of so many (extended information
    /// criterion, J. Chen and Z. Chen, Biometrika 2008).
    fn price(&self, parameters: usize, bends: usize) -> f64 {
        let places = (self.line.places() as f64).max(1.0);
        parameters as f64 * (self.line.count / self.correlation).max(2.0).ln()
            + 2.0 * bends as f64 * places.ln()
    }

    fn decide(&mut self, what: String, bend: Option<usize>, gain: f64, kept: bool) {
        self.decisions.push(Decision { what, bend: bend.map(|i| i + 1), gain, kept });
    }

    /// Changes the best candidate as long as it gets better. Of the changes turned down in the last round the likeliest
    /// are remembered.
    fn search(&mut self, mut best: Candidate) -> Candidate {
        for _ in 0..ROUNDS {
            let mut tried = self.tried(&best);
            tried.sort_by(|a, b| a.1.score.total_cmp(&b.1.score));
            let better = tried.first().is_some_and(|(_, c)| c.score < best.score - LEAST_GAIN);
            if !better {
                self.decisions.retain(|d| d.kept);
                for (change, candidate) in tried.into_iter().take(REMEMBERED) {
                    self.decide(change.what, change.bend, best.score - candidate.score, false);
                }
                break;
            }
            let (change, candidate) = tried.swap_remove(0);
            self.decide(change.what, None, best.score - candidate.score, true);
            best = self.fit(&candidate.model, FULL_STEPS, f64::INFINITY);
        }
        best
    }

    /// All changes by one bend that may be worth it, each fitted.
    fn tried(&self, best: &Candidate) -> Vec<(Change, Candidate)> {
        let changes = self.changes(best);
        let fit = |change: Change| {
            let candidate = self.fit(&change.model, TRIAL_STEPS, best.score);
            (change, candidate)
        };
        changes.into_par_iter().map(fit).collect()
    }

    /// The changes that may be worth it.
    fn changes(&self, best: &Candidate) -> Vec<Change> {
        let model = &best.model;
        let n = model.lra.bends.len();
        let solved = Solved::new(&self.line, model, &best.parameters);
        let variance = self.line.noise_mm.powi(2) * self.correlation;
        // How certainly a value differs from zero, in terms of the score.
        let worth = |parameter: Parameter, value: f64| {
            let at = best.parameters.iter().position(|p| *p == parameter);
            at.map_or(0.0, |j| value * value / (solved.inverse[(j, j)] * variance).max(1e-300))
        };
        let bearable = DOUBT * self.price(5, 1);
        let bends = &model.lra.bends;
        let spine = model.spine();
        let at = |i: usize| spine.segments()[2 * i + 1].start_mm;
        let change = |what: String, bend: Option<usize>, model: TubeModel| Change { what, bend, model };
        let shallow = |i: &usize| worth(Parameter::Angle(*i), bends[*i].angle_rad) < bearable;
        let dropped = (0..n).filter(shallow).map(|i| {
            change(format!("the bend at {:.0} mm pulled straight", at(i)), Some(i), without_bend(model, i))
        });
        let merged = likeliest_pairs(model).into_iter().filter_map(|i| {
            let what = format!("the bends at {:.0} and {:.0} mm made one", at(i - 1), at(i));
            Some(change(what, Some(i - 1), merged(model, i)?))
        });
        let joints = self.joints(best, &solved);
        let inserted = joints.iter().flat_map(|j| {
            let what = format!("a bend put in at {:.0} mm", j.at_mm);
            with_bend(model, j).into_iter().map(move |m| change(what.clone(), None, m))
        });
        let split = joints.iter().flat_map(|j| {
            let what = format!("the bend at {:.0} mm made two", j.at_mm);
            split(model, j).into_iter().map(move |m| change(what.clone(), None, m))
        });
        let doubled = (0..n).filter_map(|i| {
            let what = format!("the wide bend at {:.0} mm made two of the usual CLR", at(i));
            Some(change(what, Some(i), doubled(model, i)?))
        });
        let all = dropped.chain(merged).chain(inserted).chain(split).chain(doubled);
        all.filter(|c| c.model.lra.bends.len() <= MOST_BENDS).collect()
    }

    /// What is handed on.
    fn structure(self, model: TubeModel) -> Structure {
        let held = lengths(&self.line, &model, self.correlation, self.prior);
        let (noise_mm, prior, decisions) = (self.line.noise_mm, self.prior, self.decisions);
        Structure { noise_mm, prior, held, decisions, model }
    }

    /// The structure fitted to the points themselves, without the bends that they do not confirm: a section of few
    /// points may have taken some that are not the tube's for its own.
    fn confirmed(mut self, sample: &[Point3<f64>], model: TubeModel) -> Structure {
        let mut sample = Sample::new(sample.to_vec(), &model);
        let (mut best, mut score) = self.fit_points(&mut sample, &model);
        loop {
            let bends = &best.model.lra.bends;
            let bearable = DOUBT * self.price(5, 1) * self.correlation;
            let doubtful = |i: &usize| {
                let at = best.parameters.iter().position(|p| *p == Parameter::Angle(*i));
                at.is_some_and(|j| bends[*i].angle_rad.powi(2) < bearable * best.covariance[(j, j)])
            };
            let mut less: Vec<(usize, (Fit, f64))> = (0..bends.len())
                .filter(doubtful)
                .map(|i| (i, self.fit_points(&mut sample, &without_bend(&best.model, i))))
                .collect();
            less.sort_by(|a, b| a.1.1.total_cmp(&b.1.1));
            let Some((i, better)) = less.into_iter().next().filter(|l| l.1.1 < score) else {
                return self.structure(best.model);
            };
            let at_mm = best.model.spine().segments()[2 * i + 1].start_mm;
            let what = format!("the bend at {at_mm:.0} mm, not confirmed by the points, pulled straight");
            self.decide(what, None, score - better.1, true);
            (best, score) = better;
        }
    }

    fn fit_points(&self, sample: &mut Sample, model: &TubeModel) -> (Fit, f64) {
        let noise_mm = self.line.noise_mm;
        let cutoff_mm = CUTOFF_SIGMAS * noise_mm;
        let found = fit(sample, model, Effort { cutoff_mm, rounds: 0, steps: FULL_STEPS, prior: self.prior });
        let misfit = 2.0 * found.cost / (noise_mm * noise_mm) / self.correlation;
        let score = misfit + self.price(found.parameters.len(), model.lra.bends.len());
        (found, score)
    }

    /// Places where a joint would help, the most helpful first, no two close together.
    fn joints(&self, best: &Candidate, solved: &Solved) -> Vec<Joint> {
        let radius = best.model.tube_radius_mm;
        let mut joints = solved.joints(&self.line, &best.model, &best.parameters, self.line.noise_mm);
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
