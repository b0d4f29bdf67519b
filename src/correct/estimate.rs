//! How much each bend springs back: a prior from the material, blended with what was measured.
//!
//! Law: s(c) = s90 (x1 + x2 c/90 + x3 sqrt(c/90)) + r, in degrees of the commanded angle c. x is shared by all
//! bends of the key, r is each bend's own residual in this program. The basis fits published finite-element
//! curves far better than a straight line (field notes). Every measurement is weighed with its variance, so a
//! doubtful one moves little: no further damping is needed.

use nalgebra::{DMatrix, DVector};

use super::belief::Belief;
use super::knowledge::JobRecord;
use crate::inspect::Known;
use crate::tube::{Material, Nominal};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Prior of x (field: .3 .4 .3). All of it is known to a half: materials, dies and lubrication differ, mostly upwards, and what is
/// beyond three sigmas would be cut by the step limit.
const SHAPE: [f64; 3] = [0.3, 0.4, 0.3];
const SCALE_SIGMA: f64 = 0.45;
/// How much of a 90 degree bend's is fixed, how much in proportion to the angle.
const MIX: [f64; 3] = [1.0, -1.0, 0.0];
const MIX_SIGMA: f64 = 0.15;
/// And what each is off besides.
const SHAPE_SIGMA: f64 = 0.1;
/// Prior sigma of a bend's residual.
const RESIDUAL_SIGMA_RAD: f64 = 0.10 * DEGREE;
/// Scatter from bend to bend that no table can take out.
pub(super) const BEND_SCATTER_RAD: f64 = 0.08 * DEGREE;
/// Scatter from tube to tube, common to its bends, as a share of the spring-back.
pub(super) const TUBE_SCATTER: f64 = 0.015;
/// Drift of all of x together from part to part: without it the filter stays stuck after a change of material.
const DRIFT: f64 = 0.004;
/// Another batch in the machine, unannounced: how likely that is before any part, and by how much (one sigma) all of x moves then.
const CHANGE_CHANCE: f64 = 0.12;
const CHANGE_SIGMA: f64 = 0.10;
/// Common scale of another job's spring-back: of the same batch, of another or an unknown one.
const SAME_BATCH: f64 = 0.02;
const OTHER_BATCH: f64 = 0.10;
/// Gate on |innovation| in sigmas: from the first on a measurement counts less, from the second not at all.
const DOUBT: f64 = 3.0;
const REJECT: f64 = 6.0;

/// The belief about one job's spring-back.
#[derive(Debug, Clone)]
pub struct Springback {
    belief: Belief,
    /// Usual spring-back of a 90 degree bend, per bend (its radius matters).
    s90_rad: Vec<f64>,
    /// Bends whose last measurement was rejected: the next like it is believed.
    suspect: Vec<bool>,
    /// Sigma of each bend's innovation when the last part came in.
    surprise_sigma_rad: Vec<f64>,
    /// Whether a part of this job was learned from.
    has_learned: bool,
    /// The tubes' change that the last part speaks for, if any.
    change: Option<Change>,
}

/// All bends of a tube spring back by another factor than they did: another batch, or another set-up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Change {
    /// How likely that is, 0 to 1.
    pub chance: f64,
    /// By which share of the spring-back, with its sigma.
    pub by: Known,
}

/// A measured angle that does not fit what the job showed before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outlier {
    /// Bend, from 0.
    pub bend: usize,
    /// Spring-back found.
    pub found_rad: f64,
    /// Spring-back expected, with the sigma of finding another.
    pub expected_rad: Known,
}

impl Outlier {
    /// How far off, in sigmas.
    fn off(&self) -> f64 {
        (self.found_rad - self.expected_rad.value).abs() / self.expected_rad.sigma
    }
}

impl Springback {
    /// What is believed before the job's first part. `batch` tells whose tubes the records are.
    pub fn prior(nominal: &Nominal, records: &[&JobRecord], batch: Option<&str>) -> Springback {
        let n = nominal.lra.bends.len();
        let s90_rad = nominal.lra.bends.iter().map(|b| usual_springback(nominal, b.radius_mm)).collect();
        let mut unknowns: Vec<Known> = SHAPE.map(|value| Known { value, sigma: SHAPE_SIGMA }).to_vec();
        unknowns.extend(vec![Known { value: 0.0, sigma: RESIDUAL_SIGMA_RAD }; n]);
        let mut belief = Belief::new(&unknowns);
        belief.loosen_along(&along(SHAPE, unknowns.len()), SCALE_SIGMA);
        belief.loosen_along(&along(MIX, unknowns.len()), MIX_SIGMA);
        let mut out = Springback {
            belief,
            s90_rad,
            suspect: vec![false; n],
            surprise_sigma_rad: vec![0.0; n],
            has_learned: false,
            change: None,
        };
        for record in records {
            let same = batch.is_some() && record.batch.as_deref() == batch;
            out.recall(nominal, record, if same { SAME_BATCH } else { OTHER_BATCH });
        }
        out
    }

    /// Takes in another job of this key: its bends carry residuals of their own and a common scale.
    fn recall(&mut self, nominal: &Nominal, record: &JobRecord, common: f64) {
        let points = &record.bends;
        let row = |p: &super::knowledge::BendPoint| {
            self.shape_row(usual_springback(nominal, p.radius_mm), p.commanded_rad)
        };
        let rows: Vec<DVector<f64>> = points.iter().map(row).collect();
        let values: Vec<f64> = points.iter().map(|p| p.springback_rad).collect();
        let mut noise = common_noise(&rows, &values, common);
        for (i, p) in points.iter().enumerate() {
            noise[(i, i)] += p.sigma_rad.powi(2) + RESIDUAL_SIGMA_RAD.powi(2);
        }
        self.belief.update(&rows, &values, &noise);
    }

    /// Takes in one part: commanded and measured angle per bend, and how many scans agree on it. Answers with what was rejected.
    ///
    /// Each bend is held against what the others of the same tube say (leave-one-out): that all spring back alike by more than was
    /// expected is news, that one does so alone is doubtful.
    pub fn learn(&mut self, commanded_rad: &[f64], measured: &[Known], agreed: &[usize]) -> Vec<Outlier> {
        self.belief.loosen_along(&along(SHAPE, self.belief.len()), DRIFT);
        let mut seen = Seen {
            rows: commanded_rad.iter().enumerate().map(|(i, c)| self.row(i, *c)).collect(),
            found: commanded_rad.iter().zip(measured).map(|(c, m)| c - m.value).collect(),
            variances: measured.iter().map(|m| BEND_SCATTER_RAD.powi(2) + m.sigma.powi(2)).collect(),
        };
        for (i, m) in measured.iter().enumerate() {
            self.surprise_sigma_rad[i] = self.measured_at(i, commanded_rad[i], m.sigma).sigma;
        }
        self.change = self.change_seen(&seen);
        let chance = self.change.map_or(0.0, |change| change.chance);
        let (settled, open) = (self.belief.clone(), self.opened(1.0));
        // Bends are held against each other under what is likely of both.
        self.belief = self.opened(chance);
        let sorted = self.sort_out(&mut seen, agreed);
        let heard = seen.of(&sorted.heard);
        let updated = |mut belief: Belief| {
            sorted.loose.iter().for_each(|(index, sigma)| belief.loosen(*index, *sigma));
            belief.update(&heard.rows, &heard.found, &heard.noise());
            belief
        };
        self.belief = updated(settled).mixed(&updated(open), chance);
        sorted.outliers
    }

    /// Which bends are listened to. One after the other is left out, the worst first: it spoils what the others are held against.
    fn sort_out(&mut self, seen: &mut Seen, agreed: &[usize]) -> Sorted {
        let all = 0..agreed.len();
        let (mut heard, mut outliers, mut loose) = (all.clone().collect::<Vec<_>>(), Vec::new(), Vec::new());
        let mut before = std::mem::replace(&mut self.suspect, vec![false; agreed.len()]);
        before.iter_mut().zip(agreed).for_each(|(before, scans)| *before |= *scans > 1);
        while let Some(odd) = self.oddest(seen, &heard) {
            let i = odd.bend;
            self.suspect[i] = true;
            heard.retain(|k| *k != i);
            if before[i] {
                // Twice, in two tubes or two scans, is no outlier: this bend has changed.
                loose.push((SHAPE.len() + i, odd.found_rad - odd.expected_rad.value));
            } else {
                outliers.push(odd);
            }
        }
        for expected in self.others_say(seen, &heard) {
            let off = expected.off() / DOUBT;
            if off > 1.0 {
                seen.variances[expected.bend] += expected.expected_rad.sigma.powi(2) * (off.powi(2) - 1.0);
            }
        }
        heard.extend(all.filter(|&i| self.suspect[i] && before[i]));
        Sorted { heard, outliers, loose }
    }

    /// The belief if all of x had moved by [`CHANGE_SIGMA`], or with some chance has.
    fn opened(&self, chance: f64) -> Belief {
        let mut belief = self.belief.clone();
        belief.loosen_along(&along(SHAPE, belief.len()), CHANGE_SIGMA * chance.sqrt());
        belief
    }

    /// Whether all bends together spring back by another factor than they did: both possibilities are weighed by what they make of
    /// this part (generalised pseudo-Bayes of first order, G. A. Ackerson and K. S. Fu 1970). Comes first: bends that changed
    /// together must not pass for single ones that are wrong; and those that are, far from the bends' median, have no say. None where
    /// nothing was known that could have changed.
    fn change_seen(&mut self, seen: &Seen) -> Option<Change> {
        let knew = std::mem::replace(&mut self.has_learned, true);
        if seen.rows.is_empty() || !knew {
            return None; // a straight tube, or the first one
        }
        let usual = along(SHAPE, self.belief.len());
        let factor = |row: &DVector<f64>| row.dot(&usual);
        let off: Vec<f64> = seen
            .rows
            .iter()
            .zip(&seen.found)
            .map(|(row, found)| found - self.belief.predict(row).value)
            .collect();
        let median = median(seen.rows.iter().zip(&off).map(|(row, off)| off / factor(row)).collect())?;
        let fits = |i: &usize| {
            let sigma = seen.variances[*i].sqrt().hypot(RESIDUAL_SIGMA_RAD);
            (off[*i] - median * factor(&seen.rows[*i])).abs() < REJECT * sigma
        };
        let heard = seen.of(&(0..off.len()).filter(fits).collect::<Vec<_>>());
        let per_factor: Vec<f64> = heard.rows.iter().map(factor).collect();
        let common = self.belief.common_factor(&heard.rows, &per_factor, &heard.found, &heard.noise())?;
        let density = |sigma: f64| (-0.5 * (common.value / sigma).powi(2)).exp() / sigma;
        let (changed, same) = (
            CHANGE_CHANCE * density(common.sigma.hypot(CHANGE_SIGMA)),
            (1.0 - CHANGE_CHANCE) * density(common.sigma),
        );
        let by = self.as_share(common);
        Some(Change { chance: changed / (changed + same), by })
    }

    /// Of the usual spring-back, as a share of the one believed.
    fn as_share(&self, of_usual: Known) -> Known {
        let usual = along(SHAPE, self.belief.len());
        let scale = self.belief.predict(&usual).value / usual.dot(&usual);
        let size = scale.abs().max(0.1);
        Known { value: of_usual.value / size, sigma: of_usual.sigma / size }
    }

    /// What the last part says of a change of all bends together.
    pub fn change(&self) -> Option<Change> {
        self.change
    }

    /// The bend that fits worst to what the others say, if it does not fit at all.
    fn oddest(&self, seen: &Seen, heard: &[usize]) -> Option<Outlier> {
        let all = self.others_say(seen, heard);
        all.into_iter().filter(|o| o.off() > REJECT).max_by(|a, b| a.off().total_cmp(&b.off()))
    }

    /// For each of these bends what the others let expect, and what was found.
    fn others_say(&self, seen: &Seen, heard: &[usize]) -> Vec<Outlier> {
        let own = seen.of(heard);
        let left_out = self.belief.leave_one_out(&own.rows, &own.found, &own.noise());
        let one = |(&bend, expected_rad): (&usize, Known)| Outlier {
            bend,
            found_rad: seen.found[bend],
            expected_rad,
        };
        heard.iter().zip(left_out).map(one).collect()
    }

    /// Spring-back of a bend at a commanded angle, never negative, with the sigma of the estimate.
    pub fn at(&self, bend: usize, commanded_rad: f64) -> Known {
        let found = self.belief.predict(&self.row(bend, commanded_rad));
        Known { value: found.value.clamp(0.0, commanded_rad.max(0.0)), ..found }
    }

    /// The same with the scatter of the next tube in the sigma.
    pub fn next_at(&self, bend: usize, commanded_rad: f64) -> Known {
        self.measured_at(bend, commanded_rad, 0.0)
    }

    /// The angle to command for a wanted one: the fixed point c = wanted + s(c), held where the law would be
    /// steeper than metal is (gain of formed over commanded angle in [0.8, 1.02]).
    pub fn command_for(&self, bend: usize, wanted_rad: f64) -> f64 {
        let mut c = wanted_rad;
        for _ in 0..60 {
            let next = wanted_rad + self.at(bend, c).value;
            if (next - c).abs() < 1e-12 {
                break;
            }
            // A contraction by at most 0.2 converges to 1e-12 within 20 rounds; half steps tame the rest.
            c = if (next - c).abs() > 0.2 * c.max(0.02) { (c + next) / 2.0 } else { next };
        }
        c
    }

    /// Sigma of a bend's innovation when the last part came in: what a correction may have to move.
    pub fn surprise_sigma_rad(&self, bend: usize) -> f64 {
        self.surprise_sigma_rad[bend]
    }

    /// The same by the law that all bends of the key share, without what is this bend's own.
    pub fn law_at(&self, bend: usize, commanded_rad: f64) -> Known {
        let found = self.belief.predict(&self.shape_row(self.s90_rad[bend], commanded_rad));
        Known { value: found.value.clamp(0.0, commanded_rad.max(0.0)), ..found }
    }

    /// The law's coefficients x, in units of [`Springback::usual_rad`].
    pub fn coefficients(&self) -> [Known; 3] {
        std::array::from_fn(|i| self.belief.unknown(i))
    }

    /// Usual spring-back of a 90 degree bend: s90 of the law.
    pub fn usual_rad(&self, bend: usize) -> f64 {
        self.s90_rad[bend]
    }

    /// Number of bends.
    pub fn bends(&self) -> usize {
        self.s90_rad.len()
    }

    fn measured_at(&self, bend: usize, commanded_rad: f64, sigma: f64) -> Known {
        let found = self.at(bend, commanded_rad);
        let scatter = BEND_SCATTER_RAD.hypot(TUBE_SCATTER * found.value);
        Known { value: found.value, sigma: found.sigma.hypot(scatter).hypot(sigma) }
    }

    fn row(&self, bend: usize, commanded_rad: f64) -> DVector<f64> {
        let mut row = self.shape_row(self.s90_rad[bend], commanded_rad);
        row[SHAPE.len() + bend] = 1.0;
        row
    }

    fn shape_row(&self, s90_rad: f64, commanded_rad: f64) -> DVector<f64> {
        let mut row = DVector::zeros(self.belief.len());
        let share = (commanded_rad / (90.0 * DEGREE)).max(0.0);
        row.rows_mut(0, 3).copy_from_slice(&[s90_rad, s90_rad * share, s90_rad * share.sqrt()]);
        row
    }
}

/// What becomes of a tube's bends.
struct Sorted {
    /// They are learned from.
    heard: Vec<usize>,
    /// They are not.
    outliers: Vec<Outlier>,
    /// What has changed: which unknown, and by how much it is open again.
    loose: Vec<(usize, f64)>,
}

/// What one tube's bends show.
struct Seen {
    /// Of the unknowns.
    rows: Vec<DVector<f64>>,
    /// Spring-back.
    found: Vec<f64>,
    /// Of each by itself.
    variances: Vec<f64>,
}

impl Seen {
    /// Some of the bends.
    fn of(&self, bends: &[usize]) -> Seen {
        Seen {
            rows: bends.iter().map(|&i| self.rows[i].clone()).collect(),
            found: bends.iter().map(|&i| self.found[i]).collect(),
            variances: bends.iter().map(|&i| self.variances[i]).collect(),
        }
    }

    /// Each bend's own, and what a tube's bends have in common.
    fn noise(&self) -> DMatrix<f64> {
        let mut noise = common_noise(&self.rows, &self.found, TUBE_SCATTER);
        self.variances.iter().enumerate().for_each(|(i, v)| noise[(i, i)] += v);
        noise
    }
}

/// A direction of x among all unknowns.
fn along(shape: [f64; 3], unknowns: usize) -> DVector<f64> {
    let mut direction = DVector::zeros(unknowns);
    direction.rows_mut(0, SHAPE.len()).copy_from_slice(&shape);
    direction
}

/// Of an even number the middle of the middle two, of none none.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let (below, above) = (values.get(values.len().saturating_sub(1) / 2)?, values.get(values.len() / 2)?);
    Some(0.5 * (below + above))
}

/// Of what all bends of a tube have in common: a share of their spring-back. Not of what each was found to be: the fit would
/// then lean on those that scattered low, and come out below them all (R. W. Peelle's puzzle, 1987).
fn common_noise(rows: &[DVector<f64>], found: &[f64], share: f64) -> DMatrix<f64> {
    if rows.is_empty() {
        return DMatrix::zeros(0, 0);
    }
    let usual = along(SHAPE, rows[0].len());
    let expected: Vec<f64> = rows.iter().map(|row| row.dot(&usual)).collect();
    let shares = found.iter().zip(&expected).map(|(found, expected)| found / expected);
    let factor = median(shares.collect()).unwrap_or_default();
    let column = DVector::from_vec(expected) * (factor * share);
    &column * column.transpose()
}

/// Spring-back of a 90 degree bend: the material's usual one, moved by what the beam formula says of this
/// radius against the usual one's 2 D.
pub(super) fn usual_springback(nominal: &Nominal, radius_mm: f64) -> f64 {
    let elastic = |radius_mm: f64| {
        90.0 * DEGREE * elastic_share(&nominal.material, nominal.od_mm, nominal.wall_mm, radius_mm)
    };
    let usual_radius_mm = 2.0 * nominal.od_mm;
    let moved = nominal.material.usual_springback_rad + elastic(radius_mm) - elastic(usual_radius_mm);
    moved.max(0.3 * DEGREE)
}

/// What a bend of the part springs back by when nothing but its material is known: the law before anything was learned.
pub(super) fn usual_at(nominal: &Nominal, bend: usize) -> f64 {
    let bend = &nominal.lra.bends[bend];
    let share = bend.angle_rad / (90.0 * DEGREE);
    usual_springback(nominal, bend.radius_mm) * (SHAPE[0] + SHAPE[1] * share + SHAPE[2] * share.sqrt())
}

/// Elastic share of a bend angle, eta = M R / (E I), for a thin-walled tube bent fully plastic in a material
/// that hardens as K eps^n: (4/pi) (K/E) (R/r)^(1-n) times the section's integral of sin^(1+n), which runs
/// nearly straight from 1 (n = 0) to pi/4 (n = 1).
fn elastic_share(material: &Material, od_mm: f64, wall_mm: f64, radius_mm: f64) -> f64 {
    use std::f64::consts::FRAC_PI_4;
    let n = material.hardening_exponent;
    let middle_mm = (od_mm - wall_mm) / 2.0;
    let section = 1.0 - (1.0 - FRAC_PI_4) * n;
    let modulus = material.strength_coefficient_mpa / material.youngs_modulus_mpa;
    modulus * (radius_mm / middle_mm).powf(1.0 - n) * section / FRAC_PI_4
}
