//! The search for the structure: the best tube so far with what looks like error taken for a bend, where that explains much;
//! changed by one bend at a time (dropped, merged, split, put in) as long as the measured centre line is better explained
//! per value spent (Bayesian information criterion); then by one bend taken from one place to another.
//!
//! Under `structure`, which gives it the tubes to begin with.

use rayon::prelude::*;

use super::evidence::{Joint, Solved};
use super::fit::{RESOLVED, RadiusPrior, Way, descend};
use super::model::{Parameter, TubeModel};
use super::moves::{doubled, drawn_apart, is_one, likeliest_pairs, merged, split, with_bend, without_bend};
use super::sections::CentreLine;
use super::undecided::Undecided;
use crate::tube::Decision;

/// More bends than this are a coil or a hose, not a bent tube.
pub const MOST_BENDS: usize = 40;

/// A change must gain this much, or rounding could turn it back for ever.
const LEAST_GAIN: f64 = 1e-6;

/// A value this many times less certain than what it costs would still be spent is tried without.
pub(super) const DOUBT: f64 = 4.0;

/// Changes turned down at the end that are remembered.
const REMEMBERED: usize = 5;

/// Gain of a joint, per independent point, that makes a bend be tried there.
pub(super) const JOINT_GAIN: f64 = 30.0;

/// Joints tried per round, and rounds.
const JOINTS: usize = 3;
const ROUNDS: usize = 20;

/// A bend is taken elsewhere for no less than this: what a descent leaves undone is no reason.
const LEAST_MOVE: f64 = 1.0;

/// Bends that are tried elsewhere, and how many bends' price taking one out may cost.
const MOVED: usize = 3;
const DEAREST_MOVED: f64 = 8.0;

/// A joint that takes away such a share of all misfit is looked into, however large the misfit.
const EXPLAINED: f64 = 0.05;

/// A bend must move the tube by this many times what the passes lie apart: of passes 20 to 80 micrometres apart the bends that
/// were none moved it by 1.1 to 2.7 times that, true ones by 3 and more.
pub(super) const ABOVE_PASSES: f64 = 2.75;

/// A tube's stock is no straighter than this, in tube radii.
const STRAIGHT_RADII: f64 = 0.005;

/// One that explains more than so many bends' price is none of the passes' making.
const DEAREST_NONE: f64 = 3.0;

/// An angle within so many standard deviations of zero is not known.
pub(super) const UNSURE: f64 = 2.0;

/// Steps of a fit, and of one that only has to show whether a change is worth it.
pub(super) const FULL_STEPS: usize = 100;
const TRIAL_STEPS: usize = 40;

/// A fitted structure.
#[derive(Debug, Clone)]
pub(super) struct Candidate {
    /// The tube.
    pub model: TubeModel,
    /// Its free values.
    pub parameters: Vec<Parameter>,
    /// Information criterion: smaller is better.
    pub score: f64,
}

impl Candidate {
    pub(super) fn bends(&self) -> usize {
        self.model.lra.bends.len()
    }
}

/// The data and what all candidates share.
pub(super) struct Jury {
    pub line: CentreLine,
    /// How many points say one thing.
    pub correlation: f64,
    pub prior: Option<RadiusPrior>,
    pub decisions: Vec<Decision>,
    /// What a choice between structures that was hardly one leaves open.
    pub undecided: Undecided,
}

/// What the sections say of a candidate.
struct Told {
    solved: Solved,
    /// The most helpful first.
    joints: Vec<Joint>,
}

/// A change to be tried.
struct Change {
    /// In words.
    what: String,
    /// The bend of the tube as it is, counted from 0.
    bend: Option<usize>,
    model: TubeModel,
}

impl Jury {
    /// Fits a model to the sections; given up when it cannot score below `goal`.
    pub(super) fn fit(&self, model: &TubeModel, steps: usize, goal: f64) -> Candidate {
        let model = model.clone().settled();
        let parameters = model.parameters();
        let noise_mm = self.line.noise_mm;
        let worth = (goal - self.price(parameters.len(), model.lra.bends.len()))
            * self.correlation
            * noise_mm
            * noise_mm
            / 2.0;
        let way = Way { cutoff_mm: f64::INFINITY, noise_mm, steps, goal: worth, resolved: RESOLVED };
        let descent = descend(&mut &self.line, model, &parameters, self.prior, way);
        let misfit = 2.0 * descent.pass.cost / (noise_mm * noise_mm) / self.correlation;
        let score = misfit + self.price(parameters.len(), descent.model.lra.bends.len());
        Candidate { model: descent.model, parameters, score }
    }

    /// Scores a model as it is.
    pub(super) fn judge(&self, model: TubeModel) -> Candidate {
        self.fit(&model, 0, f64::INFINITY)
    }

    /// What a number of values costs; and each bend, that its place is the best of so many (extended information
    /// criterion, J. Chen and Z. Chen, Biometrika 2008).
    pub(super) fn price(&self, parameters: usize, bends: usize) -> f64 {
        let places = (self.line.places() as f64).max(1.0);
        parameters as f64 * (self.line.count / self.correlation).max(2.0).ln()
            + 2.0 * bends as f64 * places.ln()
    }

    pub(super) fn decide(&mut self, what: String, bend: Option<usize>, gain: f64, kept: bool) {
        self.decisions.push(Decision { what, bend: bend.map(|i| i + 1), gain, kept });
    }

    /// Changes the best candidate as long as it gets better. Of the changes turned down in the last round the likeliest
    /// are remembered.
    pub(super) fn search(&mut self, mut best: Candidate) -> Candidate {
        for _ in 0..ROUNDS {
            let told = self.told(&best);
            if let Some(other) = self.explained(&best, &told) {
                best = other;
                continue;
            }
            let mut tried = self.tried(&best, &told);
            tried.sort_by(|a, b| a.1.score.total_cmp(&b.1.score));
            if let Some((i, better)) = self.better(&best, &tried) {
                let (change, candidate) = tried.swap_remove(i);
                self.decide(change.what, None, best.score - candidate.score, true);
                best = better;
            } else if let Some(other) = self.moved(&best, &tried) {
                best = other;
            } else {
                self.decisions.retain(|d| d.kept);
                for (change, candidate) in tried.into_iter().take(REMEMBERED) {
                    self.decide(change.what, change.bend, best.score - candidate.score, false);
                }
                break;
            }
        }
        best
    }

    /// The best of the tried changes that is better fitted to the end, too: an arc that has become too short to be oval scores as if it
    /// still were, and so would be changed to and fro for ever.
    fn better(&self, best: &Candidate, tried: &[(Change, Candidate)]) -> Option<(usize, Candidate)> {
        let is_better = |candidate: &Candidate| candidate.score < best.score - LEAST_GAIN;
        let better = tried.iter().enumerate().take_while(|(_, (_, candidate))| is_better(candidate));
        let fitted = better.map(|(i, (_, c))| (i, self.fit(&c.model, FULL_STEPS, f64::INFINITY)));
        fitted.into_iter().find(|(_, candidate)| is_better(candidate))
    }

    /// A tube that runs nowhere farther than `most_mm` from the line that the sections were taken about: changed as in the
    /// search until it does, if it comes to that.
    pub(super) fn nearer(&self, mut first: Candidate, most_mm: f64) -> Candidate {
        for _ in 0..ROUNDS {
            if self.line.farthest_mm(&first.model) < most_mm {
                break;
            }
            let tried = self.tried(&first, &self.told(&first)).into_iter().map(|(_, candidate)| candidate);
            let best = tried.min_by(|a, b| a.score.total_cmp(&b.score));
            let Some(better) = best.filter(|b| b.score < first.score - LEAST_GAIN) else { break };
            first = self.fit(&better.model, FULL_STEPS, f64::INFINITY);
        }
        first
    }

    /// The best candidate with one bend taken out and one put in elsewhere, if that is better: two shallow bends of which
    /// one has taken the other's part are no step of one bend away from right.
    fn moved(&mut self, best: &Candidate, tried: &[(Change, Candidate)]) -> Option<Candidate> {
        let dearest = best.score + DEAREST_MOVED * self.price(5, 1);
        let fewer = tried.iter().filter(|(_, c)| c.bends() < best.bends() && c.score < dearest);
        let mut changes = Vec::new();
        for (change, candidate) in fewer.take(MOVED) {
            let less = self.fit(&candidate.model, FULL_STEPS, f64::INFINITY);
            let more = self
                .changes(&less, &self.told(&less))
                .into_iter()
                .filter(|c| c.model.lra.bends.len() >= best.bends());
            changes.extend(more.map(|m| (format!("{}, and {}", change.what, m.what), m.model)));
        }
        let fit = |(what, model)| (what, self.fit(&model, FULL_STEPS, best.score));
        let fitted: Vec<(String, Candidate)> = changes.into_par_iter().map(fit).collect();
        let (what, candidate) = fitted.into_iter().min_by(|a, b| a.1.score.total_cmp(&b.1.score))?;
        let gain = best.score - candidate.score;
        if gain < LEAST_MOVE {
            return None;
        }
        self.decide(what, None, gain, true);
        Some(candidate)
    }

    /// What looks like error that neighbours share may be a bend that is missing. Where one more takes much of it away, both
    /// are judged by what that one leaves.
    fn explained(&mut self, best: &Candidate, told: &Told) -> Option<Candidate> {
        let misfit = (best.score - self.price(best.parameters.len(), best.bends())) * self.correlation;
        let joints = apart(&told.joints, EXPLAINED * misfit, best.model.tube_radius_mm);
        let tried = |j: &Joint| {
            let more = [with_bend(&best.model, j), split(&best.model, j)].concat();
            more.into_iter().map(|m| (j.at_mm, m)).collect::<Vec<_>>()
        };
        let more: Vec<(f64, TubeModel)> = joints.iter().flat_map(tried).collect();
        let fit = |(at_mm, model)| (at_mm, self.fit(&model, FULL_STEPS, f64::INFINITY));
        let fitted: Vec<(f64, Candidate)> = more.into_par_iter().map(fit).collect();
        let (at_mm, more) = fitted.into_iter().min_by(|a, b| a.1.score.total_cmp(&b.1.score))?;
        let before = self.correlation;
        self.correlation = self.line.correlation(&more.model).min(before);
        let (less, more) = (self.judge(best.model.clone()), self.judge(more.model));
        let gain = less.score - more.score;
        if gain < LEAST_GAIN {
            self.correlation = before;
            return None;
        }
        self.decide(format!("a bend put in at {at_mm:.0} mm"), None, gain, true);
        Some(more)
    }

    /// The tube with neighbouring bends made one that are one for any bender, or of which one has an angle that is not
    /// known at all, unless much speaks against it.
    pub(super) fn united(&mut self, mut best: Candidate) -> Candidate {
        let mut unsure = self.unsure(&best);
        let mut i = 1;
        while i < best.bends() {
            let one = is_one(&best.model, i) || unsure[i - 1] || unsure[i];
            let one = one.then(|| merged(&best.model, i)).flatten();
            let fitted = one.map(|m| self.fit(&m, FULL_STEPS, f64::INFINITY));
            let bearable = best.score + DEAREST_NONE * self.price(5, 1);
            match fitted.filter(|c| c.score < bearable) {
                Some(less) => {
                    let at_mm = best.model.spine().segments()[2 * i + 1].start_mm;
                    let what = format!("the arcs that meet at {at_mm:.0} mm are one bend");
                    self.decide(what, None, best.score - less.score, true);
                    best = less;
                    unsure = self.unsure(&best);
                }
                None => i += 1,
            }
        }
        best
    }

    /// How certainly a bend's angle differs from zero, in terms of the score.
    fn angle_worth(&self, best: &Candidate, solved: &Solved, i: usize) -> f64 {
        let variance = self.line.noise_mm.powi(2) * self.correlation;
        let at = best.parameters.iter().position(|p| *p == Parameter::Angle(i));
        let square = best.model.lra.bends[i].angle_rad.powi(2);
        at.map_or(0.0, |j| square / (solved.inverse[(j, j)] * variance).max(1e-300))
    }

    /// Which bends have an angle that is not known from zero.
    fn unsure(&self, best: &Candidate) -> Vec<bool> {
        let solved = Solved::new(&self.line, &best.model, &best.parameters, self.prior);
        (0..best.bends()).map(|i| self.angle_worth(best, &solved, i) < UNSURE.powi(2)).collect()
    }

    /// The tube without the bends that move it by no more than its scan's passes disagree, or than its noise where that is a
    /// small part of the tube: no stock is straighter, and what the model leaves out shows no less.
    pub(super) fn material(&mut self, mut best: Candidate, passes_mm: f64) -> Candidate {
        let noise_mm = self.line.noise_mm.min(STRAIGHT_RADII * best.model.tube_radius_mm);
        let least_mm = noise_mm.max(ABOVE_PASSES * passes_mm);
        loop {
            let dearest = best.score + DEAREST_NONE * self.price(5, 1);
            let solved = Solved::new(&self.line, &best.model, &best.parameters, self.prior);
            let fewer = self.fewer(&best, &solved);
            let fitted = fewer.into_iter().map(|c| (self.fit(&c.model, FULL_STEPS, dearest), c.what));
            let none = fitted
                .filter(|(c, _)| c.score < dearest && self.line.apart_mm(&best.model, &c.model) < least_mm);
            let Some((less, what)) = none.min_by(|a, b| a.0.score.total_cmp(&b.0.score)) else { return best };
            let um = 1e3 * least_mm;
            let what =
                format!("{what}: it moves the tube by less than {um:.0} um, no more than the scan shows");
            self.decide(what, None, best.score - less.score, true);
            best = less;
        }
    }

    /// All changes by one bend that may be worth it, each fitted.
    fn tried(&self, best: &Candidate, told: &Told) -> Vec<(Change, Candidate)> {
        let changes = self.changes(best, told);
        let fit = |change: Change| {
            let candidate = self.fit(&change.model, TRIAL_STEPS, best.score);
            (change, candidate)
        };
        changes.into_par_iter().map(fit).collect()
    }

    fn told(&self, best: &Candidate) -> Told {
        let solved = Solved::new(&self.line, &best.model, &best.parameters, self.prior);
        let mut joints = solved.joints(&self.line, &best.model, &best.parameters, self.line.noise_mm);
        joints.sort_by(|a, b| b.gain.total_cmp(&a.gain).then(a.at_mm.total_cmp(&b.at_mm)));
        Told { solved, joints }
    }

    /// The changes to a bend less that may be worth it.
    fn fewer(&self, best: &Candidate, solved: &Solved) -> Vec<Change> {
        let model = &best.model;
        let bearable = DOUBT * self.price(5, 1);
        let spine = model.spine();
        let at = |i: usize| spine.segments()[2 * i + 1].start_mm;
        let shallow = |i: &usize| self.angle_worth(best, solved, *i) < bearable;
        let dropped = (0..best.bends()).filter(shallow).map(|i| {
            let what = format!("the bend at {:.0} mm pulled straight", at(i));
            Change { what, bend: Some(i), model: without_bend(model, i) }
        });
        let merged = likeliest_pairs(model).into_iter().filter_map(|i| {
            let what = format!("the bends at {:.0} and {:.0} mm made one", at(i - 1), at(i));
            Some(Change { what, bend: Some(i - 1), model: merged(model, i)? })
        });
        dropped.chain(merged).collect()
    }

    /// All changes that may be worth it.
    fn changes(&self, best: &Candidate, told: &Told) -> Vec<Change> {
        let model = &best.model;
        let n = model.lra.bends.len();
        let spine = model.spine();
        let at = |i: usize| spine.segments()[2 * i + 1].start_mm;
        let change = |what: String, bend: Option<usize>, model: TubeModel| Change { what, bend, model };
        let joints = apart(&told.joints, JOINT_GAIN * self.correlation, model.tube_radius_mm);
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
        let drawn = (1..n).filter_map(|i| {
            let what = format!("the bends at {:.0} and {:.0} mm drawn apart", at(i - 1), at(i));
            Some(change(what, Some(i), drawn_apart(model, i)?))
        });
        let fewer = self.fewer(best, &told.solved).into_iter();
        let all = fewer.chain(inserted).chain(split).chain(doubled).chain(drawn);
        all.filter(|c| c.model.lra.bends.len() <= MOST_BENDS).collect()
    }
}

/// Places where a joint would help by so much, the most helpful first, no two close together.
fn apart(joints: &[Joint], least_gain: f64, tube_radius_mm: f64) -> Vec<Joint> {
    let mut out: Vec<Joint> = Vec::new();
    for joint in joints.iter().filter(|j| j.gain > least_gain) {
        if out.len() < JOINTS && out.iter().all(|o| (joint.at_mm - o.at_mm).abs() > 2.0 * tube_radius_mm) {
            out.push(*joint);
        }
    }
    out
}
