//! The structure by the nominal: its table laid onto the spine ([`places`](super::places)) in both directions, fitted to
//! the measured centre line, and doubted ([`doubt`]). Beside [`structure`], the free search, which is the check on it
//! ([`own`]).
//!
//! Safety: a wrong part must never look like a good measurement of the right one. So the nominal's structure is returned
//! only (1) when the fit raises no doubt: all of the centre line lies on it, no bend more would explain the sections better
//! (tried where the free search would), and every angle, rotation, length and CLR is what forming may have made of the
//! nominal's; or (2) in doubt, when the free search finds nothing that explains the sections better. Where the free
//! search explains them better, its answer is returned, with both in figures. Bends too shallow for the free search are
//! kept: they cost it more than they explain, which is no evidence against them.

mod doubt;
mod own;

use nalgebra::{DMatrix, Point3, Translation3, UnitQuaternion, Vector3};

use super::evidence::Solved;
use super::fit::{self, CUTOFF_SIGMAS, RESOLVED, RadiusPrior, Way, descend, polish};
use super::likeness::{rows, unlikeness};
use super::model::{Parameter, TubeModel};
use super::moments::Sample;
use super::moves::with_common_radius;
use super::places::{Course, lay};
use super::profile::{Held, lengths};
use super::section::filling;
use super::sections::CentreLine;
use super::structure::{self, Shown, Structure};
use crate::tube::{Decision, Lra, Nominal};

/// Steps of a fit to the points.
const POINT_STEPS: usize = 100;

/// A cloud of so many times the sample's points is large: a walk through it costs more than a fit to the sample.
const MANY_SAMPLES: usize = 10;

/// Bend radii are expected within this share of each other, or as far as the nominal's differ.
const RADIUS_SPREAD: f64 = 0.3;

/// A bend of less than this share of its nominal angle may have been lost by the fit: at no angle a plane says nothing.
const LOST_SHARE: f64 = 0.2;

/// Such a bend has strayed when it is this far from where the nominal has it, in tube radii: less is forming and the fit's.
const STRAYED_RADII: f64 = 8.0;

/// Answers that differ by fewer of these are the same.
const SIGMAS: f64 = 4.0;

/// A structure and what the user should know of the choice, bends counted as the nominal counts them.
pub type Chosen = (Structure, Vec<String>);

/// Finds the structure by the nominal, or freely where that explains the scan better. None when neither does.
pub fn choose(shown: &Shown, nominal: &Nominal) -> Option<Chosen> {
    let polygon = shown.polygon;
    let free = || structure::choose(shown);
    let part = nominal.lra.merged();
    let Some(guided) = Guided::fit(shown, &part) else {
        return free().map(|own| (told(own, "it cannot lie on the centre line", 0.0, false), Vec::new()));
    };
    let taken = |why: &str| told(guided.structure(shown), why, 0.0, true);
    if guided.is_sure(polygon, &shown.whole) {
        return Some((taken("nothing in the scan speaks against it"), guided.resting()));
    }
    match free() {
        Some(own) => Some(guided.or_own(own, shown)),
        None => guided.explains(polygon).then(|| (taken("the scan by itself shows none"), Vec::new())),
    }
}

/// The structure with what became of the nominal's among its decisions; `gain` over the scan's own.
fn told(mut structure: Structure, why: &str, gain: f64, kept: bool) -> Structure {
    let what = format!("the nominal's structure: {why}");
    structure.decisions.push(Decision { what, bend: None, gain, kept });
    structure
}

/// How far a fit goes.
#[derive(Debug, Clone, Copy)]
struct Effort {
    steps: usize,
    /// Share of a standard deviation that is not worth another step.
    resolved: f64,
    /// Given up where it cannot score below this.
    goal: f64,
}

/// To the polygon; on the way; to the end; and not at all, only judged.
const ROUGHLY: Effort = Effort { steps: 20, ..NEARLY };
const NEARLY: Effort = Effort { resolved: 0.3, ..FULLY };
const FULLY: Effort = Effort { steps: 40, resolved: RESOLVED, goal: f64::INFINITY };
const AS_IT_IS: Effort = Effort { steps: 0, ..FULLY };

/// A fit to the sections.
#[derive(Debug, Clone)]
struct Fitted {
    model: TubeModel,
    parameters: Vec<Parameter>,
    /// Squared residuals over the noise's variance, per independent point, and what the values cost (as in `structure`):
    /// smaller is better.
    score: f64,
}

/// The nominal's structure as the scan shows it.
struct Guided {
    best: Fitted,
    line: CentreLine,
    correlation: f64,
    prior: Option<RadiusPrior>,
    /// The nominal in the polygon's direction.
    part: Lra,
    /// Whether that is against its own.
    reversed: bool,
    /// Standard deviation per parameter.
    sigmas: Vec<f64>,
    /// Lengths that the linear equations leave open.
    held: Vec<Held>,
    solved: Solved,
}

/// Fits a model to the sections.
fn fitted(
    line: &CentreLine,
    model: TubeModel,
    prior: Option<RadiusPrior>,
    correlation: f64,
    effort: Effort,
) -> Fitted {
    let model = model.settled();
    let parameters = model.parameters();
    let noise_mm = line.noise_mm;
    let price = parameters.len() as f64 * (line.count / correlation).max(2.0).ln();
    let unit = noise_mm * noise_mm * correlation;
    let Effort { steps, resolved, goal } = effort;
    let way = Way { cutoff_mm: f64::INFINITY, noise_mm, steps, resolved, goal: (goal - price) * unit / 2.0 };
    let descent = descend(&mut &*line, model, &parameters, prior, way);
    let score = 2.0 * descent.pass.cost / unit + price;
    Fitted { model: descent.model, parameters, score }
}

/// What bend radii the nominal lets expect.
fn expected_radii(part: &Lra) -> Option<RadiusPrior> {
    let weight: f64 = part.bends.iter().map(|b| b.angle_rad).sum();
    let mean = part.bends.iter().map(|b| b.angle_rad * b.radius_mm).sum::<f64>() / weight;
    let most = part.bends.iter().map(|b| (b.radius_mm - mean).abs()).fold(RADIUS_SPREAD * mean, f64::max);
    (weight > 0.0).then_some(RadiusPrior { radius_mm: mean, spread_mm: most })
}

/// The covariance when a value is as sure as was found by moving it.
fn hold(covariance: &mut DMatrix<f64>, parameters: &[Parameter], (parameter, sigma): &Held) {
    let Some(j) = parameters.iter().position(|p| p == parameter) else { return };
    let (own, wanted) = (covariance[(j, j)], sigma * sigma);
    if own > wanted {
        let column = covariance.column(j).into_owned();
        *covariance -= &column * column.transpose() * ((own - wanted) / (own * own));
    }
}

/// The model with a bend that the fit has lost turned as the nominal has it, and where it has it on the straight that the fit
/// has made of it; the bends after it stay in their planes.
fn bent_again(model: &TubeModel, part: &Lra, i: usize) -> TubeModel {
    let mut out = placed_again(model, part, i);
    let bends = &mut out.lra.bends;
    bends[i].angle_rad = part.bends[i].angle_rad;
    if i > 0 {
        let turn = bends[i].rotation_rad - part.bends[i].rotation_rad;
        bends[i].rotation_rad -= turn;
        bends.iter_mut().skip(i + 1).take(1).for_each(|b| b.rotation_rad += turn);
    } else if let Some(next) = bends.get_mut(1) {
        let turn = next.rotation_rad - part.bends[1].rotation_rad;
        next.rotation_rad -= turn;
        out.start *= UnitQuaternion::from_axis_angle(&Vector3::x_axis(), turn);
    }
    out
}

/// The model with a bend that turns nothing, and so may have strayed to anywhere on its straight, where the nominal has it
/// between its neighbours; the tube stays where it is.
fn placed_again(model: &TubeModel, part: &Lra, i: usize) -> TubeModel {
    let mut out = model.clone();
    let lengths = |lra: &Lra| {
        let after = lra.bends.get(i + 1).map_or(lra.last_length_mm, |b| b.length_mm);
        (lra.bends[i].length_mm, after)
    };
    let ((before, after), (wanted_before, wanted_after)) = (lengths(&model.lra), lengths(part));
    // Where the tube ends there is no neighbour, and a straight of any length.
    let later_mm = match (i, i + 1 == part.bends.len()) {
        (0, true) => 0.0,
        (0, false) => after - wanted_after,
        (_, true) => wanted_before - before,
        _ => (before + after) * wanted_before / (wanted_before + wanted_after).max(1e-9) - before,
    };
    if later_mm.abs() < STRAYED_RADII * model.tube_radius_mm {
        return out;
    }
    if i == 0 {
        out.start *= Translation3::new(later_mm, 0.0, 0.0);
    } else {
        out.lra.bends[i].length_mm += later_mm;
    }
    match out.lra.bends.get_mut(i + 1) {
        Some(next) => next.length_mm -= later_mm,
        None => out.lra.last_length_mm -= later_mm,
    }
    out
}

fn has_common_radius(part: &Lra) -> bool {
    part.bends.windows(2).all(|w| (w[0].radius_mm - w[1].radius_mm).abs() < 1e-6)
}

impl Guided {
    /// The nominal laid and fitted in the better of both directions; None where it cannot lie.
    fn fit(shown: &Shown, part: &Lra) -> Option<Guided> {
        let Shown { polygon, sample, radius_mm, .. } = *shown;
        let course = Course::new(polygon, radius_mm).filter(|_| !part.bends.is_empty())?;
        let prior = expected_radii(part);
        let rough = CentreLine::of_polygon(polygon, radius_mm);
        let mut laid: Option<(Fitted, Lra, bool)> = None;
        // Where it fits as well both ways, the more alike.
        let off = |(found, part, _): &(Fitted, Lra, bool)| {
            found.score + unlikeness(&rows(&found.model.lra), &rows(part), radius_mm)
        };
        for (part, reversed) in [(part.clone(), false), (part.reversed(), true)] {
            let Some(start) = lay(&course, &part) else { continue };
            let start = TubeModel { flattening: shown.flattening.clone(), ..start };
            let goal = laid.as_ref().map_or(f64::INFINITY, off);
            let found = (fitted(&rough, start, prior, 1.0, Effort { goal, ..ROUGHLY }), part, reversed);
            laid = if off(&found) < goal { Some(found) } else { laid };
        }
        let (mut best, part, reversed) = laid?;
        let mut line = rough;
        // What the first measurement makes of the tube is where the last is taken: some of the points show it.
        let some = filling(sample.len(), radius_mm, course.length_mm());
        let some: Vec<Point3<f64>> = sample.iter().step_by(some).copied().collect();
        for (points, effort, is_fitted) in [(&some[..], NEARLY, false), (sample, FULLY, true)] {
            line = CentreLine::measure(points, &best.model, is_fitted);
            best = fitted(&line, best.model, prior, 1.0, effort);
            for i in 0..part.bends.len() {
                if best.model.lra.bends[i].angle_rad < LOST_SHARE * part.bends[i].angle_rad {
                    let again = bent_again(&best.model, &part, i);
                    let again = fitted(&line, again, prior, 1.0, effort);
                    best = if again.score < best.score { again } else { best };
                }
            }
        }
        Some(Guided::of(line, best.model, prior, part, reversed))
    }

    /// The nominal's structure as it was fitted to the sections.
    fn of(
        line: CentreLine,
        model: TubeModel,
        prior: Option<RadiusPrior>,
        part: Lra,
        reversed: bool,
    ) -> Guided {
        let correlation = line.correlation(&model);
        let mut best = fitted(&line, model, prior, correlation, AS_IT_IS);
        if has_common_radius(&part) && part.bends.len() > 1 {
            let common = fitted(&line, with_common_radius(&best.model), prior, correlation, FULLY);
            best = if common.score < best.score { common } else { best };
        }
        let solved = Solved::new(&line, &best.model, &best.parameters, None);
        let variance = line.noise_mm.powi(2) * correlation;
        let held = lengths(&line, &best.model, correlation, prior);
        let mut covariance = &solved.inverse * variance;
        held.iter().for_each(|h| hold(&mut covariance, &best.parameters, h));
        let sigmas = covariance.diagonal().iter().map(|v| v.max(0.0).sqrt()).collect();
        Guided { best, line, correlation, prior, part, reversed, sigmas, held, solved }
    }

    /// The structure; of a large cloud fitted to the sample's own points, from where the fit to all is a step or two.
    fn structure(&self, shown: &Shown) -> Structure {
        let (mut model, noise_mm) = (self.best.model.clone(), self.line.noise_mm);
        if shown.whole.len() > MANY_SAMPLES * shown.sample.len() {
            let own = shown.sample.iter().filter(|p| !self.line.crowded().holds(p)).copied().collect();
            let cutoff_mm = CUTOFF_SIGMAS * noise_mm;
            let effort = fit::Effort { cutoff_mm, rounds: 0, steps: POINT_STEPS, prior: self.prior };
            let mut sample = Sample::new(own, &model);
            let polished = polish(&mut sample, &model, effort, &self.held);
            model = polished.unwrap_or_else(|| fit::fit(&mut sample, &model, effort)).model;
        }
        let (held, prior) = (self.held.clone(), self.prior);
        let correlation = self.correlation;
        let (undecided, decisions) = (Vec::new(), Vec::new());
        let crowded = self.line.crowded().clone();
        Structure { model, noise_mm, correlation, crowded, prior, held, undecided, decisions }
    }

    fn sigma(&self, parameter: Parameter) -> Option<f64> {
        let at = self.best.parameters.iter().position(|p| *p == parameter)?;
        Some(self.sigmas[at])
    }

    fn angle_sigma_rad(&self, bend: usize) -> f64 {
        self.sigma(Parameter::Angle(bend)).unwrap_or(f64::INFINITY)
    }

    /// The nominal's count of a bend, from 1.
    fn number(&self, bend: usize) -> usize {
        if self.reversed { self.part.bends.len() - bend } else { bend + 1 }
    }
}
