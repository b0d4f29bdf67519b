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

use nalgebra::{DMatrix, UnitQuaternion, Vector3};

use super::evidence::Solved;
use super::fit::{CUTOFF_SIGMAS, Effort, RadiusPrior, Way, descend, fit, polish};
use super::likeness::{rows, unlikeness};
use super::model::{Parameter, TubeModel};
use super::moments::Sample;
use super::moves::with_common_radius;
use super::places::{Course, lay};
use super::profile::{Held, lengths};
use super::sections::CentreLine;
use super::structure::{self, Shown, Structure};
use crate::tube::{Decision, Lra, Nominal};

/// Steps of the fits to the polygon, to the sections and to the points, and how often the sections are measured.
const ROUGH_STEPS: usize = 20;
const FULL_STEPS: usize = 40;
const POINT_STEPS: usize = 100;
const MEASUREMENTS: usize = 2;

/// A cloud of so many times the sample's points is large: a walk through it costs more than a fit to the sample.
const MANY_SAMPLES: usize = 10;

/// Bend radii are expected within this share of each other, or as far as the nominal's differ.
const RADIUS_SPREAD: f64 = 0.3;

/// A bend of less than this share of its nominal angle may have been lost by the fit: at no angle a plane says nothing.
const LOST_SHARE: f64 = 0.2;

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

/// Fits a model to the sections, or judges it as it is with no steps.
fn fitted(
    line: &CentreLine,
    model: TubeModel,
    prior: Option<RadiusPrior>,
    correlation: f64,
    steps: usize,
) -> Fitted {
    let model = model.settled();
    let parameters = model.parameters();
    let noise_mm = line.noise_mm;
    let way = Way { cutoff_mm: f64::INFINITY, noise_mm, steps, goal: f64::INFINITY };
    let descent = descend(&mut line.clone(), model, &parameters, prior, way);
    let misfit = 2.0 * descent.pass.cost / (noise_mm * noise_mm) / correlation;
    let score = misfit + parameters.len() as f64 * (line.count / correlation).max(2.0).ln();
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

/// The model with a bend that the fit has lost turned as the nominal has it; the bends after it stay in their planes.
fn bent_again(model: &TubeModel, part: &Lra, i: usize) -> TubeModel {
    let mut out = model.clone();
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
        let laid =
            [(part.clone(), false), (part.reversed(), true)].into_iter().filter_map(|(part, reversed)| {
                let start = TubeModel { flattening: shown.flattening.clone(), ..lay(&course, &part)? };
                Some((fitted(&rough, start, prior, 1.0, ROUGH_STEPS), part, reversed))
            });
        // Where it fits as well both ways, the more alike.
        let off = |(found, part, _): &(Fitted, Lra, bool)| {
            found.score + unlikeness(&rows(&found.model.lra), &rows(part), radius_mm)
        };
        let (mut best, part, reversed) = laid.min_by(|a, b| off(a).total_cmp(&off(b)))?;
        let mut line = rough;
        for round in 0..MEASUREMENTS {
            line = CentreLine::measure(sample, &best.model, round > 0);
            best = fitted(&line, best.model, prior, 1.0, FULL_STEPS);
            for i in 0..part.bends.len() {
                if best.model.lra.bends[i].angle_rad < LOST_SHARE * part.bends[i].angle_rad {
                    let again = bent_again(&best.model, &part, i);
                    let again = fitted(&line, again, prior, 1.0, FULL_STEPS);
                    best = if again.score < best.score { again } else { best };
                }
            }
        }
        let correlation = line.correlation(&best.model);
        best = fitted(&line, best.model, prior, correlation, 0);
        if has_common_radius(&part) && part.bends.len() > 1 {
            let common = fitted(&line, with_common_radius(&best.model), prior, correlation, FULL_STEPS);
            best = if common.score < best.score { common } else { best };
        }
        let solved = Solved::new(&line, &best.model, &best.parameters, None);
        let variance = line.noise_mm.powi(2) * correlation;
        let held = lengths(&line, &best.model, correlation, prior);
        let mut covariance = &solved.inverse * variance;
        held.iter().for_each(|h| hold(&mut covariance, &best.parameters, h));
        let sigmas = covariance.diagonal().iter().map(|v| v.max(0.0).sqrt()).collect();
        Some(Guided { best, line, correlation, prior, part, reversed, sigmas, held, solved })
    }

    /// The structure; of a large cloud fitted to the sample's own points, from where the fit to all is a step or two.
    fn structure(&self, shown: &Shown) -> Structure {
        let (mut model, noise_mm) = (self.best.model.clone(), self.line.noise_mm);
        if shown.whole.len() > MANY_SAMPLES * shown.sample.len() {
            let own = shown.sample.iter().filter(|p| !self.line.crowded().holds(p)).copied().collect();
            let cutoff_mm = CUTOFF_SIGMAS * noise_mm;
            let effort = Effort { cutoff_mm, rounds: 0, steps: POINT_STEPS, prior: self.prior };
            let mut sample = Sample::new(own, &model);
            let polished = polish(&mut sample, &model, effort, &self.held);
            model = polished.unwrap_or_else(|| fit(&mut sample, &model, effort)).model;
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
