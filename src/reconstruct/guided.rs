//! The structure by the nominal: its table laid onto the spine ([`places`](super::places)) in both directions, fitted to
//! the measured centre line, and doubted. Beside [`structure`], the free search, which is the check on it.
//!
//! Safety: a wrong part must never look like a good measurement of the right one. So the nominal's structure is returned
//! only (1) when the fit raises no doubt: all of the centre line lies on it, no bend more would explain the sections better
//! (tried where the free search would), and every angle, rotation, length and CLR is what forming may have made of the
//! nominal's; or (2) in doubt, when the free search finds nothing that explains the sections better. Where the free
//! search explains them better, its answer is returned, with both in figures. Bends too shallow for the free search are
//! kept: they cost it more than they explain, which is no evidence against them.

use nalgebra::{DMatrix, Point3, UnitQuaternion, Vector3};

use super::evidence::{Joint, Solved};
use super::fit::{RadiusPrior, Way, descend};
use super::likeness::{is_formed, rows, unlikeness};
use super::model::{Parameter, TubeModel};
use super::moves::{split, with_bend, with_common_radius, without_bend};
use super::places::{Course, SHALLOW_RAD, lay};
use super::profile::{Held, lengths};
use super::search::{DOUBT, JOINT_GAIN};
use super::sections::CentreLine;
use super::stripes;
use super::structure::{self, Shown, Structure};
use super::whole::Whole;
use crate::tube::{Decision, Lra, Nominal};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Steps of the fits to the polygon and to the sections, and how often the sections are measured.
const ROUGH_STEPS: usize = 20;
const FULL_STEPS: usize = 40;
const MEASUREMENTS: usize = 2;

/// Bend radii are expected within this share of each other, or as far as the nominal's differ.
const RADIUS_SPREAD: f64 = 0.3;

/// A vertex of the spine's polygon this far from the fitted centre line is not explained by it, in tube radii; and how
/// many in a row may be so.
const OFF_RADII: f64 = 0.25;
const MOST_OFF: usize = 3;

/// A bend of less than this share of its nominal angle may have been lost by the fit: at no angle a plane says nothing.
const LOST_SHARE: f64 = 0.2;

/// Sections that scatter this much more than their points say are not the tube's, unless the passes disagree: then by so
/// many times what one point of each section would say of the passes.
const MOST_CORRELATION: f64 = 25.0;
const PASSES_CORRELATION: f64 = 5.0;

/// A joint that takes away such a share of all misfit is tried whatever the scatter (as in `search`).
const EXPLAINED: f64 = 0.2;

/// A joint worth so many times what makes it looked at is more than one bend's.
const MOST_GAIN: f64 = 10.0;

/// A bend that moves the tube by less than so many times what the passes lie apart is their doing (as in `search`).
const ABOVE_PASSES: f64 = 2.75;

/// Forming and the die's wear change a CLR by less than this share of it.
const DIE_SHARE: f64 = 0.2;

/// Answers that differ by fewer of these are the same.
const SIGMAS: f64 = 4.0;

/// An angle less certain than this is not measured by the nominal's structure; the free search is asked.
const MAX_ANGLE_SIGMA_RAD: f64 = 5.0 * DEGREE;

/// Two answers that differ by less than this and the sigmas are the same.
const SAME_ANGLE_RAD: f64 = 0.05 * DEGREE;

/// What is told of the nominal's structure beside the scan's own.
const KEPT: &str = "the scan's own explains it no better";
const LEFT: &str = "the scan's own explains it better";

/// A structure and what the user should know of the choice, bends counted as the nominal counts them.
pub type Chosen = (Structure, Vec<String>);

/// Finds the structure by the nominal, or freely where that explains the scan better. None when neither does.
pub fn choose(shown: &Shown, nominal: &Nominal) -> Option<Chosen> {
    let Shown { polygon, sample, radius_mm, .. } = *shown;
    let free = || structure::choose(shown);
    let part = nominal.lra.merged();
    let Some(guided) = Guided::fit(polygon, sample, radius_mm, &part) else {
        return free().map(|own| (told(own, "it cannot lie on the centre line", 0.0, false), Vec::new()));
    };
    let taken = |why: &str| told(guided.structure(), why, 0.0, true);
    if guided.is_sure(polygon, &shown.whole) {
        return Some((taken("nothing in the scan speaks against it"), guided.resting()));
    }
    match free() {
        Some(own) => Some(guided.or_own(own, sample)),
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

/// What the five values of one bend more cost.
fn bend_price(line: &CentreLine, correlation: f64) -> f64 {
    5.0 * (line.count / correlation).max(2.0).ln()
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
    fn fit(polygon: &[Point3<f64>], sample: &[Point3<f64>], radius_mm: f64, part: &Lra) -> Option<Guided> {
        let course = Course::new(polygon, radius_mm).filter(|_| !part.bends.is_empty())?;
        let prior = expected_radii(part);
        let rough = CentreLine::of_polygon(polygon, radius_mm);
        let laid =
            [(part.clone(), false), (part.reversed(), true)].into_iter().filter_map(|(part, reversed)| {
                let start = lay(&course, &part)?;
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

    fn structure(&self) -> Structure {
        let (model, noise_mm) = (self.best.model.clone(), self.line.noise_mm);
        Structure { model, noise_mm, prior: self.prior, held: self.held.clone(), decisions: Vec::new() }
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

    /// Whether all of the spine's polygon lies on the fitted centre line.
    fn explains(&self, polygon: &[Point3<f64>]) -> bool {
        // The ends' lengths are not fitted.
        let mut model = self.best.model.clone();
        let beyond = 10.0 * model.tube_radius_mm;
        model.start *= nalgebra::Translation3::new(-beyond, 0.0, 0.0);
        model.lra.bends.iter_mut().take(1).for_each(|b| b.length_mm += beyond);
        model.lra.last_length_mm += beyond;
        let spine = model.spine();
        let mut run = 0;
        polygon.iter().all(|p| {
            let off = spine.closest(p).distance_mm > OFF_RADII * model.tube_radius_mm;
            run = if off { run + 1 } else { 0 };
            run <= MOST_OFF
        })
    }

    /// Whether forming may have made this of the nominal.
    fn is_formed_of_the_nominal(&self) -> bool {
        let mut found = rows(&self.best.model.lra);
        let unknown = f64::INFINITY;
        for (i, row) in found.iter_mut().enumerate() {
            row.angle_sigma_rad = self.angle_sigma_rad(i);
            row.length_sigma_mm = self.sigma(Parameter::Length(i)).unwrap_or(unknown);
            row.rotation_sigma_rad = self.sigma(Parameter::Rotation(i)).unwrap_or(unknown);
        }
        is_formed(&found, &rows(&self.part), self.best.model.tube_radius_mm)
    }

    /// Whether nothing speaks for asking the free search.
    fn is_sure(&self, polygon: &[Point3<f64>], whole: &Whole) -> bool {
        let passes_mm = stripes::disagreement_mm(whole, &self.best.model, self.line.noise_mm);
        !self.is_scattered(passes_mm)
            && self.is_determined()
            && self.is_formed_of_the_nominal()
            && self.explains(polygon)
            && self.is_of_its_dies()
            && !self.lacks_a_bend(passes_mm)
    }

    /// Whether every angle is measured.
    fn is_determined(&self) -> bool {
        (0..self.part.bends.len()).all(|i| self.angle_sigma_rad(i) <= MAX_ANGLE_SIGMA_RAD)
    }

    /// Whether the sections scatter more about the tube than their points, and what the passes disagree, say.
    fn is_scattered(&self, passes_mm: f64) -> bool {
        let each = self.line.count / (self.line.places() as f64).max(1.0);
        let passes = each * (passes_mm / self.line.noise_mm).powi(2);
        self.correlation > MOST_CORRELATION.max(PASSES_CORRELATION * passes)
    }

    /// Whether a bend more would explain the scan better, or what the residuals say is too much for one: tried where the
    /// free search would try one, and judged by what it leaves.
    fn lacks_a_bend(&self, passes_mm: f64) -> bool {
        let (model, line) = (&self.best.model, &self.line);
        let mut joints = self.solved.joints(line, model, &self.best.parameters, line.noise_mm);
        let gain = JOINT_GAIN * self.correlation;
        let price = self.best.parameters.len() as f64 * (line.count / self.correlation).max(2.0).ln();
        let misfit = (self.best.score - price) * self.correlation;
        joints.retain(|j| j.gain > gain.min(EXPLAINED * misfit));
        joints.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        if joints.first().is_some_and(|j| j.gain > MOST_GAIN * gain) {
            return true;
        }
        let mut tried: Vec<&Joint> = Vec::new();
        for joint in &joints {
            let near = |other: &&Joint| (other.at_mm - joint.at_mm).abs() < 2.0 * model.tube_radius_mm;
            if !tried.iter().any(near) {
                tried.push(joint);
            }
        }
        let more = tried.iter().flat_map(|j| [with_bend(model, j), split(model, j)].concat());
        // Its place is the best of many.
        let place = 2.0 * (line.places() as f64).ln();
        let is_better = |more: TubeModel| {
            let more = fitted(line, more, self.prior, self.correlation, FULL_STEPS).model;
            let correlation = line.correlation(&more).min(self.correlation);
            let judged = |m: &TubeModel| fitted(line, m.clone(), self.prior, correlation, 0).score;
            judged(&more) + place < judged(model) && line.apart_mm(model, &more) > ABOVE_PASSES * passes_mm
        };
        more.into_iter().any(is_better)
    }

    /// Whether every CLR is about the nominal's: a bend much wider may be two.
    fn is_of_its_dies(&self) -> bool {
        let pairs = self.best.model.lra.bends.iter().zip(&self.part.bends).enumerate();
        pairs.into_iter().all(|(i, (found, part))| {
            let sigma_mm = self.sigma(Parameter::BendRadius(i)).unwrap_or(0.0);
            (found.radius_mm - part.radius_mm).abs() < DIE_SHARE * part.radius_mm + SIGMAS * sigma_mm
        })
    }

    /// Bends that the free search would not spend their values on.
    fn resting(&self) -> Vec<String> {
        let worth_a_look = DOUBT * bend_price(&self.line, self.correlation);
        let mut out: Vec<(usize, String)> = Vec::new();
        for (i, bend) in self.best.model.lra.bends.iter().enumerate() {
            let sigma = self.angle_sigma_rad(i);
            if bend.angle_rad < SHALLOW_RAD && (bend.angle_rad / sigma).powi(2) < worth_a_look {
                let less = without_bend(&self.best.model, i);
                let less = fitted(&self.line, less, self.prior, self.correlation, FULL_STEPS);
                if less.score >= self.best.score {
                    continue;
                }
                let number = self.number(i);
                let text = format!(
                    "bend {number} rests on the nominal: {:.2} +- {:.2} degrees are too few for the scan to show it by itself",
                    bend.angle_rad.to_degrees(),
                    sigma.to_degrees()
                );
                out.push((number, text));
            }
        }
        out.sort_by_key(|(number, _)| *number);
        out.into_iter().map(|(_, text)| text).collect()
    }

    /// The better of the nominal's structure and the scan's own.
    fn or_own(&self, own: Structure, sample: &[Point3<f64>]) -> Chosen {
        let n = self.part.bends.len();
        let line = CentreLine::measure(sample, &own.model, true);
        let correlation = line.correlation(&own.model);
        let mine = fitted(&line, self.best.model.clone(), self.prior, correlation, FULL_STEPS);
        let other = fitted(&line, own.model.clone(), own.prior, correlation, 0);
        let bends = other.model.lra.bends.len();
        let sure = self.is_determined();
        let formed = self.is_formed_of_the_nominal();
        // The nominal's, but for what its further bends cost no worse: the free search spared itself the shallow ones.
        let saved = bend_price(&line, correlation) * n.saturating_sub(bends) as f64;
        let spared = formed && mine.score - saved <= other.score;
        let gain = other.score - mine.score;
        let mine_is_kept = || (told(self.structure(), KEPT, gain, true), self.resting());
        if sure && (mine.score <= other.score || spared) {
            return mine_is_kept();
        }
        let groups = self.groups(&other.model);
        if bends == n && groups.is_empty() {
            return if sure { mine_is_kept() } else { (told(own, LEFT, gain, false), self.resting()) };
        }
        let what = if bends == 1 { "bend" } else { "bends" };
        let list = if groups.is_empty() { String::new() } else { format!("; {}", groups.join("; ")) };
        (
            told(own, LEFT, gain, false),
            vec![format!("the scan by itself shows {bends} {what}, the nominal has {n}{list}")],
        )
    }

    /// Bend by bend of the nominal where the other model has other angles there, both in figures.
    fn groups(&self, other: &TubeModel) -> Vec<String> {
        let spine = self.best.model.spine();
        let middle = |i: usize| {
            let arc = &spine.segments()[2 * i + 1];
            arc.start_mm + 0.5 * arc.length_mm
        };
        let n = self.part.bends.len();
        let mut there: Vec<Vec<f64>> = vec![Vec::new(); n];
        let theirs = other.spine();
        for (k, bend) in other.lra.bends.iter().enumerate() {
            let arc = &theirs.segments()[2 * k + 1];
            let point = arc.frame_at(0.5 * arc.length_mm).translation.vector.into();
            let at = spine.closest(&point).arc_length_mm;
            let nearest = (0..n).min_by(|a, b| (middle(*a) - at).abs().total_cmp(&(middle(*b) - at).abs()));
            there[nearest.unwrap_or(0)].push(bend.angle_rad);
        }
        let mut out: Vec<(usize, String)> = Vec::new();
        for (i, angles) in there.iter().enumerate() {
            let angle = self.best.model.lra.bends[i].angle_rad;
            let same = SAME_ANGLE_RAD + SIGMAS * self.angle_sigma_rad(i);
            if angles.len() != 1 || (angles[0] - angle).abs() > same {
                let mut theirs: Vec<String> =
                    angles.iter().map(|a| format!("{:.2}", a.to_degrees())).collect();
                if self.reversed {
                    theirs.reverse();
                }
                let own = if theirs.is_empty() { "none".to_owned() } else { theirs.join(" + ") };
                let number = self.number(i);
                let mine = angle.to_degrees();
                let text =
                    format!("bend {number}: {mine:.2} by the nominal's structure, {own} by the scan's own");
                out.push((number, text));
            }
        }
        out.sort_by_key(|(number, _)| *number);
        out.into_iter().map(|(_, text)| text).collect()
    }
}
