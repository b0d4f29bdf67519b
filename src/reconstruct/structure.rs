//! How many bends: candidates from the spine's polygon at several tolerances, each fitted to the measured centre line;
//! the best of them [searched](super::search) for better ones; one die's radius for all bends where the data agrees; and
//! what neither the points nor more than the passes' disagreement confirm left out.

use nalgebra::{Cholesky, DMatrix, Point3};
use rayon::prelude::*;

use super::arcline::{Limits, approximate};
use super::evidence::Solved;
use super::fit::{CUTOFF_SIGMAS, Effort, Fit, RadiusPrior, fit};
use super::flattening::freed;
use super::model::{Flattening, Parameter, TubeModel};
use super::moments::Sample;
use super::moves::{
    is_free_form, mean_radius_mm, merged, shallow_pairs, with_common_radius, with_wide_doubled, without_bend,
    without_detours,
};
use super::profile::{Held, lengths};
use super::reach::reaching;
use super::scene::Scene;
use super::search::{Candidate, DOUBT, FULL_STEPS, Jury};
use super::sections::CentreLine;
use super::simplify::simplify;
use super::strangers::Crowded;
use super::stripes;
use super::undecided::{self, Own, Undecided};
use super::whole::Whole;
use crate::cloud::PointCloud;
use crate::tube::Decision;

pub use super::search::MOST_BENDS;

/// Tolerances of the polygon in tube radii; the spine's own shrinkage in bends is 0.038 (paper 000, section 3.2).
const TOLERANCES: [f64; 4] = [0.03, 0.05, 0.08, 0.13];

/// Tolerance of the arcs over that of the polygon.
const ARC_FACTOR: f64 = 2.5;

/// Candidates whose scores differ by less are one: about what a fit leaves unresolved.
const SAME_SCORE: f64 = 0.01;

/// Where a tube strays farther from the polygon, in radii, the points of its sections do not lie on one section.
const STRAYED_RADII: f64 = 0.03;

/// A tube that strays so far has lost its way: its sections are measured as if nothing had been fitted.
const LOST_RADII: f64 = 0.2;

/// Of a stretch this long that was left out, in radii, it is asked whether the tube is wrong there: whether its points miss the
/// tube by this many times their noise, squared. Of 187 stretches beside tables, jaws and other legs three were above (15, 25, 27);
/// with bends that are missing it is 60.
const SILENT_RADII: f64 = 4.0;
const LOUD: f64 = 10.0;

/// Bend radii of one tube are expected within this share of each other.
const RADIUS_SPREAD: f64 = 0.3;

/// Bends that know their own CLR to this share of it say whether there is one die: two at least, or there is nothing to test.
const KNOWN_RADIUS: f64 = 0.1;

/// How many bends' price one CLR for all may be behind before its own search.
const DEAREST_COMMON: f64 = 20.0;

/// A bend nearer to an end than so many tube radii must be confirmed by the points, however clear it is.
const UNCONFIRMED_RADII: f64 = 2.0;

/// Times that the sections are measured anew about the best tube.
const MEASUREMENTS: usize = 4;

/// What a structure is searched on.
#[derive(Debug, Clone)]
pub struct Shown<'a> {
    /// Vertices along the centre line.
    pub polygon: &'a [Point3<f64>],
    /// Ends of it beyond which points go on behind a stretch without.
    pub hidden: &'a [Point3<f64>],
    /// Some of the tube's points.
    pub sample: &'a [Point3<f64>],
    /// Tube radius, good to about a hundredth.
    pub radius_mm: f64,
    /// How flat the outer walls of the bends are, as far as is known.
    pub flattening: Flattening,
    /// The tube as a search that knew less of them found it.
    pub before: Option<TubeModel>,
    /// All of the tube's points as they lie in the file.
    pub whole: Whole<'a>,
}

impl<'a> Shown<'a> {
    /// What a scene shows of the tube in its cloud.
    pub fn new(cloud: &'a PointCloud, scene: &'a Scene, sample: &'a [Point3<f64>]) -> Shown<'a> {
        let whole = Whole::new(cloud, scene.own.as_deref());
        Shown {
            polygon: &scene.polygon,
            hidden: &scene.hidden,
            sample,
            radius_mm: scene.radius_mm,
            flattening: Flattening::NONE,
            before: None,
            whole,
        }
    }
}

/// What was found.
#[derive(Debug, Clone)]
pub struct Structure {
    /// The tube.
    pub model: TubeModel,
    /// Standard deviation of a point about the surface.
    pub noise_mm: f64,
    /// How many points say one thing.
    pub correlation: f64,
    /// Where the tube's sections tell nothing.
    pub crowded: Crowded,
    /// Expectation of the bend radii that it was fitted with.
    pub prior: Option<RadiusPrior>,
    /// What the linear covariance overstates.
    pub held: Vec<Held>,
    /// What it leaves out.
    pub undecided: Undecided,
    /// How it came about, and what was turned down at the end.
    pub decisions: Vec<Decision>,
}

impl Structure {
    /// The same with another tube that has fewer bends.
    pub fn with_fewer_bends(&self, model: TubeModel) -> Structure {
        Structure { model, undecided: Undecided::new(), ..self.clone() }
    }
}

/// Finds the structure: the best of all candidates, or None when the polygon carries none.
pub fn choose(shown: &Shown) -> Option<Structure> {
    let (jury, best) = searched(shown, None)?;
    let again = shown.before.as_ref().and_then(|before| searched(shown, Some(before)));
    Some(jury.confirmed(shown.sample, best.model, again.map(|(_, other)| other.model)))
}

/// The tube in as many bends as its polygon shows at the finest tolerance, needed or not: where passes lie apart a search may have
/// spared bends, and what it left of the shape would be taken for the passes'.
pub fn closest(shown: &Shown, chosen: &Structure) -> Option<Structure> {
    let finest = TOLERANCES.into_iter().fold(f64::INFINITY, f64::min);
    let model = start(shown.polygon, finest * shown.radius_mm, shown.radius_mm)?;
    let line = CentreLine::measure(shown.sample, &model, true);
    let jury =
        Jury { line, correlation: 1.0, prior: None, decisions: Vec::new(), undecided: Undecided::new() };
    let model = jury.fit(&model, FULL_STEPS, f64::INFINITY).model;
    Some(Structure { model, ..chosen.clone() })
}

/// The best tube that a search finds from the polygon, or from a tube that was found before.
fn searched(shown: &Shown, before: Option<&TubeModel>) -> Option<(Jury, Candidate)> {
    let Shown { polygon, sample, radius_mm, whole, .. } = *shown;
    let way = CentreLine::of_polygon(polygon, radius_mm);
    let mut jury = Jury {
        line: way.clone(),
        correlation: 1.0,
        prior: None,
        decisions: Vec::new(),
        undecided: Undecided::new(),
    };
    let start = |tolerance: &f64| {
        let model = start(polygon, tolerance * radius_mm, radius_mm)?;
        Some(TubeModel { flattening: shown.flattening.clone(), ..model })
    };
    let starts: Vec<TubeModel> = TOLERANCES.par_iter().filter_map(start).collect();
    let mut rough: Vec<Candidate> =
        starts.par_iter().map(|m| jury.fit(m, FULL_STEPS, f64::INFINITY)).collect();
    rough.sort_by(|a, b| a.score.total_cmp(&b.score));
    rough.dedup_by(|b, a| b.score - a.score < SAME_SCORE && b.parameters.len() == a.parameters.len());
    let first = match before {
        Some(before) => jury.judge(TubeModel { flattening: shown.flattening.clone(), ..before.clone() }),
        None => jury.nearer(rough.first()?.clone(), STRAYED_RADII * radius_mm),
    };
    jury.line = CentreLine::measure(sample, &first.model, false);
    rough.insert(0, first);
    let fitted: Vec<Candidate> =
        rough.par_iter().map(|c| jury.fit(&c.model, FULL_STEPS, f64::INFINITY)).collect();
    let clearest = fitted.iter().min_by(|a, b| a.score.total_cmp(&b.score))?;
    jury.prior = radius_prior(&clearest.model);
    jury.correlation = jury.line.correlation(&clearest.model);
    let mut best = jury.judge(clearest.model.clone());
    let unsettled = jury.measure_anew(shown, &way, &mut best);
    if jury.knowing_their_radius(&best) > 1 {
        best = jury.common(best);
    }
    if let Some(other) = unsettled.filter(|o| o.lra.bends.len() != best.bends()) {
        best = jury.settled(sample, best, other);
    }
    best = jury.united(best);
    let passes_mm = stripes::disagreement_mm(&whole, &best.model, jury.line.noise_mm);
    best = jury.material(best, passes_mm);
    Some((jury, best))
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
    /// Measures the sections anew about the best tube and searches on them, until nothing changes. What it was before is given back
    /// where its number of bends still changed at the end.
    fn measure_anew(&mut self, shown: &Shown, way: &CentreLine, best: &mut Candidate) -> Option<TubeModel> {
        let mut unsettled = None;
        for round in 0..MEASUREMENTS {
            best.model = reaching(&best.model, shown.sample);
            // Far from its polygon a tube's sections would take its own points for strangers'.
            let strays = way.farthest_mm(&best.model) > LOST_RADII * shown.radius_mm;
            self.line = CentreLine::measure(shown.sample, &best.model, !strays);
            if round == 0 {
                self.listen(shown.sample, &best.model);
            }
            *best = self.fit(&best.model, FULL_STEPS, f64::INFINITY);
            self.correlation = self.line.correlation(&best.model);
            *best = self.judge(best.model.clone());
            let before = best.clone();
            *best = self.search(best.clone());
            if let Some(straight) = self.without_detour(shown.sample, best) {
                *best = straight;
                continue;
            }
            // The search may have learned how many points say one thing: what was before is judged by that, too.
            let settled =
                best.bends() == before.bends() && best.score >= self.judge(before.model.clone()).score;
            unsettled = (best.bends() != before.bends()).then_some(before.model);
            if settled {
                break;
            }
        }
        unsettled
    }

    /// The tube with one CLR for all bends, if that is better. With one CLR neighbours may turn out to be one bend, and a wide
    /// one two; so it is judged after a search of its own, where it is not far behind.
    fn common(&mut self, best: Candidate) -> Candidate {
        let starts = [best.model.clone(), with_wide_doubled(&best.model)];
        let fitted = starts.iter().map(|m| self.fit(&with_common_radius(m), FULL_STEPS, f64::INFINITY));
        let Some(common) = fitted.min_by(|a, b| a.score.total_cmp(&b.score)) else { return best };
        let behind = common.score - best.score;
        let (before, correlation) = (self.decisions.clone(), self.correlation);
        let near = behind < DEAREST_COMMON * self.price(5, 1);
        let searched = if near { self.search(common) } else { common };
        let (searched, best_now) = (self.judge(searched.model), self.judge(best.model.clone()));
        let solved = Solved::new(&self.line, &best_now.model, &best_now.parameters, self.prior);
        let covariance = solved.inverse * (self.line.noise_mm.powi(2) * self.correlation);
        let gain = self.one_die(&searched, &best_now, &covariance);
        let what = "one CLR for all bends".to_owned();
        if gain > 0.0 {
            self.decide(what, None, gain, true);
            let (model, parameters) = (&best_now.model, &best_now.parameters[..]);
            let own = Own { model, gain, parameters, covariance: &covariance };
            self.undecided = undecided::between(&searched.model, &own);
            return searched;
        }
        (self.decisions, self.correlation) = (before, correlation);
        self.decide(what, None, gain, false);
        best
    }

    /// By how much one CLR for all bends is better than their own, which have this covariance. An information criterion
    /// takes a CLR more for as dear as if nothing at all were known of it beforehand; but a CLR is about as large as the others, and one
    /// that the points tell no better than that is no news: it speaks neither for one die nor against it.
    fn one_die(&self, one: &Candidate, own: &Candidate, covariance: &DMatrix<f64>) -> f64 {
        let gain = own.score - one.score;
        let Some(prior) = self.prior.filter(|_| one.bends() == own.bends()) else { return gain };
        let at: Vec<usize> = undecided::radii(&own.parameters).map(|(j, _)| j).collect();
        // As the score counts what is expected.
        let spread_mm2 = prior.spread_mm.powi(2) * self.correlation;
        let known = covariance.select_rows(&at).select_columns(&at) / spread_mm2;
        let Some(known) = Cholesky::new(known) else { return gain };
        let information = -2.0 * known.l().diagonal().map(f64::ln);
        // The one CLR is about as well known as the best of them.
        let occam = information.sum() - information.max();
        let price = |c: &Candidate| self.price(c.parameters.len(), c.bends());
        gain - price(own) + price(one) + occam
    }

    /// The tube without a row of bends that leads back onto the line before it, where the points are as well explained without:
    /// the sections, taken about that row, would not tell.
    fn without_detour(&mut self, sample: &[Point3<f64>], best: &Candidate) -> Option<Candidate> {
        let rows = without_detours(&best.model);
        if rows.is_empty() {
            return None;
        }
        let mut sample = Sample::new(sample.to_vec(), &best.model);
        let (_, before) = self.fit_points(&mut sample, &best.model);
        let fitted = rows.into_iter().map(|(row, model)| (row, self.fit_points(&mut sample, &model)));
        let (row, (fit, score)) = fitted.min_by(|a, b| a.1.1.total_cmp(&b.1.1)).filter(|l| l.1.1 < before)?;
        let at_mm = |i: usize| best.model.spine().segments()[2 * i + 1].start_mm;
        let (from_mm, to_mm) = (at_mm(*row.start()), at_mm(*row.end()));
        let what =
            format!("the bends between {from_mm:.0} and {to_mm:.0} mm, which lead nowhere, pulled straight");
        self.decide(what, None, before - score, true);
        Some(self.judge(fit.model))
    }

    /// Of two tubes with different numbers of bends that each find the other better, by the sections taken about them, the one
    /// that the points do, with one CLR for all bends or without.
    fn settled(&mut self, sample: &[Point3<f64>], best: Candidate, other: TubeModel) -> Candidate {
        let sound = sample.iter().filter(|p| !self.line.crowded().holds(p)).copied().collect();
        let mut points = Sample::new(sound, &best.model);
        let mut fit = |model: &TubeModel| {
            let own = self.fit_points(&mut points, model);
            let common = self.fit_points(&mut points, &with_common_radius(model));
            if common.1 < own.1 { common } else { own }
        };
        let (before, now) = (fit(&best.model), fit(&other));
        let gain = before.1 - now.1;
        if gain <= 0.0 {
            return best;
        }
        let what = format!("{} bends rather than {}, by the points", other.lra.bends.len(), best.bends());
        self.decide(what, None, gain, true);
        self.line = CentreLine::measure(sample, &now.0.model, true);
        self.judge(now.0.model)
    }

    /// Lets all sections speak where a long row of them was left out that speaks loudly against the tube: then a bend that is
    /// missing makes the tube's own points look like strangers'.
    fn listen(&mut self, sample: &[Point3<f64>], model: &TubeModel) {
        if self.line.silence_mm() < SILENT_RADII * model.tube_radius_mm {
            return;
        }
        let all = CentreLine::measure(sample, model, false);
        let chi2 = |line: &CentreLine| line.cost(model) / line.noise_mm.powi(2) / self.correlation;
        let left_out = all.count - self.line.count;
        if chi2(&all) - chi2(&self.line) > LOUD * left_out {
            self.line = all;
        }
    }

    /// Bends that know their own CLR.
    fn knowing_their_radius(&self, best: &Candidate) -> usize {
        let solved = Solved::new(&self.line, &best.model, &best.parameters, self.prior);
        let variance = self.line.noise_mm.powi(2) * self.correlation;
        let knows = |(j, p): (usize, &Parameter)| match p {
            Parameter::BendRadius(i) => {
                let limit_mm = KNOWN_RADIUS * best.model.lra.bends[*i].radius_mm;
                solved.inverse[(j, j)] * variance < limit_mm * limit_mm
            }
            _ => false,
        };
        best.parameters.iter().enumerate().filter(|p| knows(*p)).count()
    }

    /// What is handed on.
    fn structure(self, model: TubeModel) -> Structure {
        let held = lengths(&self.line, &model, self.correlation, self.prior);
        let (noise_mm, prior, decisions) = (self.line.noise_mm, self.prior, self.decisions);
        let undecided = undecided::of(self.undecided, &model);
        let (correlation, crowded) = (self.correlation, self.line.crowded().clone());
        Structure { noise_mm, correlation, crowded, prior, held, undecided, decisions, model }
    }

    /// The structure fitted to the points themselves, or another that they find better, without the bends that they do not confirm:
    /// a section of few points may have taken some that are not the tube's for its own.
    fn confirmed(mut self, points: &[Point3<f64>], model: TubeModel, other: Option<TubeModel>) -> Structure {
        let sound = points.iter().filter(|p| !self.line.crowded().holds(p)).copied().collect();
        let mut sample = Sample::new(sound, &model);
        let known = model.flattening.clone();
        let (mut best, mut score) = self.fit_walls(&mut sample, &model);
        let other = other.map(|model| self.fit_walls(&mut sample, &model)).filter(|o| o.1 < score);
        if let Some(other) = other {
            self.decide("the tube as found before".to_owned(), None, score - other.1, true);
            self.line = CentreLine::measure(points, &other.0.model, true);
            (best, score) = other;
        }
        loop {
            let fewer = self.with_fewer(&best, &known);
            let fitted = fewer.into_iter().map(|(what, model)| (what, self.fit_walls(&mut sample, &model)));
            let least = fitted.min_by(|a, b| a.1.1.total_cmp(&b.1.1)).filter(|l| l.1.1 < score);
            let Some((what, better)) = least else {
                return self.structure(TubeModel { flattening: known, ..best.model });
            };
            let what = format!("{what}, not confirmed by the points, taken back");
            self.decide(what, None, score - better.1, true);
            (best, score) = better;
        }
    }

    /// The tube without one of the bends that the points may not confirm; in words what goes.
    fn with_fewer(&self, best: &Fit, known: &Flattening) -> Vec<(String, TubeModel)> {
        let model = TubeModel { flattening: known.clone(), ..best.model.clone() };
        let bends = &model.lra.bends;
        let bearable = DOUBT * self.price(5, 1) * self.correlation;
        let uncertain = |i: usize| {
            let at = best.parameters.iter().position(|p| *p == Parameter::Angle(i));
            at.is_some_and(|j| bends[i].angle_rad.powi(2) < bearable * best.covariance[(j, j)])
        };
        let spine = model.spine();
        let at_mm = |i: usize| spine.segments()[2 * i + 1].start_mm;
        let is_doubtful = |i: usize| {
            is_beside_an_end(&model, i)
                || uncertain(i)
                || *known != Flattening::NONE && may_be_a_wall(&model, i)
        };
        let dropped = (0..bends.len())
            .filter(|&i| is_doubtful(i))
            .map(|i| (format!("the bend at {:.0} mm", at_mm(i)), without_bend(&model, i)));
        let pairs = shallow_pairs(&model).into_iter().filter_map(|i| {
            let what = format!("two bends at {:.0} and {:.0} mm", at_mm(i - 1), at_mm(i));
            Some((what, merged(&model, i)?))
        });
        dropped.chain(pairs).collect()
    }

    fn fit_points(&self, sample: &mut Sample, model: &TubeModel) -> (Fit, f64) {
        let noise_mm = self.line.noise_mm;
        let cutoff_mm = CUTOFF_SIGMAS * noise_mm;
        let found = fit(sample, model, Effort { cutoff_mm, rounds: 0, steps: FULL_STEPS, prior: self.prior });
        let misfit = 2.0 * found.cost / (noise_mm * noise_mm) / self.correlation;
        let score = misfit + self.price(found.parameters.len(), model.lra.bends.len());
        (found, score)
    }

    /// The same with the outer walls free where some are flat: a wall for which a bend stands shows only without that bend.
    fn fit_walls(&self, sample: &mut Sample, model: &TubeModel) -> (Fit, f64) {
        let flattening = if model.flattening == Flattening::NONE { Flattening::NONE } else { freed(model) };
        self.fit_points(sample, &TubeModel { flattening, ..model.clone() })
    }
}

/// Whether a bend is so near to a larger one that it may stand for that one's flat wall.
fn may_be_a_wall(model: &TubeModel, i: usize) -> bool {
    let bends = &model.lra.bends;
    let is_hiding = |k: usize, between: usize| {
        bends[between].length_mm < model.tube_radius_mm && bends[k].angle_rad > bends[i].angle_rad
    };
    (i > 0 && is_hiding(i - 1, i)) || (i + 1 < bends.len() && is_hiding(i + 1, i + 1))
}

/// Whether a bend is so near to an end that burr, bore and face may be in its sections.
fn is_beside_an_end(model: &TubeModel, i: usize) -> bool {
    let near_mm = UNCONFIRMED_RADII * model.tube_radius_mm;
    let bends = &model.lra.bends;
    (i == 0 && bends[0].length_mm < near_mm) || (i + 1 == bends.len() && model.lra.last_length_mm < near_mm)
}

fn radius_prior(model: &TubeModel) -> Option<RadiusPrior> {
    let radius_mm = mean_radius_mm(model)?;
    Some(RadiusPrior { radius_mm, spread_mm: RADIUS_SPREAD * radius_mm })
}
