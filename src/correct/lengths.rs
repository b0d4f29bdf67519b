//! How much to feed: distances of corners with the angle error taken out first, and turns of the plane.
//!
//! A bend pushes the corners at its two sides away from the fed length by its tangent length, and that grows
//! beyond the die's, since the arc opens when the tube springs back: D - L = sum of T (1 + g + k s/A) + q, with T
//! the die radius' tangent length at the *measured* angle (so an angle error is no feed error), s/A the bend's
//! spring-back over its angle, k and g common to the key, q the straight's own residual. Beside a bend of 150
//! degrees or more, whose corner runs away, the straight is measured from its tangent point. The straight after
//! the last bend is what the cut length leaves.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::belief::Belief;
use super::knowledge::JobRecord;
use crate::inspect::{Known, corners, distances, rotation};
use crate::tube::{CommandTable, Lra, MeasuredTube, wrap_angle};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Prior of k: all spring-back opens the arc (1) or a part only straightens its ends (less).
const GROWTH: Known = Known { value: 0.9, sigma: 0.2 };
/// Prior of g, what the arc grows without spring-back.
const CONSTANT_GROWTH: Known = Known { value: 0.0, sigma: 0.01 };
/// Prior of a straight's residual, its drift per part, and the feed's own scatter.
const RESIDUAL_SIGMA_MM: f64 = 0.3;
const DRIFT_MM: f64 = 0.02;
const FEED_SCATTER_MM: f64 = 0.1;
/// Beyond this many sigmas a length counts less: slip is scatter, not a feed error.
const DOUBT: f64 = 3.0;

/// The belief about one job's lengths.
#[derive(Debug, Clone)]
pub struct Lengths {
    belief: Belief,
    wanted: Lra,
    surprise_sigma_mm: Vec<f64>,
    /// By how much each straight was off beyond doubt in the last part, 0 where it was not.
    slipped_mm: Vec<f64>,
}

/// What the bends at the sides of a straight add to it: tangent lengths of the die radius, and these times s/A.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sides {
    /// Sum of T.
    pub plain_mm: f64,
    /// Sum of T s/A.
    pub sprung_mm: f64,
}

impl Lengths {
    /// What is believed before the job's first part.
    pub fn prior(wanted: &Lra, records: &[&JobRecord]) -> Lengths {
        let mut unknowns = vec![GROWTH, CONSTANT_GROWTH];
        unknowns.extend(vec![Known { value: 0.0, sigma: RESIDUAL_SIGMA_MM }; wanted.bends.len()]);
        let mut belief = Belief::new(&unknowns);
        for point in records.iter().flat_map(|r| &r.straights) {
            let row = growth_row(belief.len(), &point.sides);
            let variance = point.sigma_mm.powi(2) + RESIDUAL_SIGMA_MM.powi(2);
            belief.update(&[row], &[point.growth_mm], &DMatrix::from_element(1, 1, variance));
        }
        Lengths {
            belief,
            wanted: wanted.clone(),
            surprise_sigma_mm: vec![0.0; wanted.bends.len()],
            slipped_mm: vec![0.0; wanted.bends.len()],
        }
    }

    /// Takes in one part.
    pub fn learn(&mut self, commanded: &CommandTable, measured: &MeasuredTube) {
        for found in grown(&self.wanted, commanded, measured) {
            self.belief.loosen(2 + found.straight, DRIFT_MM);
            let row = self.row(found.straight, &found.sides);
            let mut variance = found.sigma_mm.powi(2);
            let expected = self.belief.predict(&row);
            let sigma = expected.sigma.hypot(found.sigma_mm);
            let off_mm = found.growth_mm - expected.value;
            let before_mm = std::mem::take(&mut self.slipped_mm[found.straight]);
            self.surprise_sigma_mm[found.straight] = sigma;
            if off_mm.abs() > DOUBT * sigma {
                if before_mm * off_mm > 0.0 {
                    // Twice in a row the same way: the feed has changed.
                    self.belief.loosen(2 + found.straight, off_mm);
                } else {
                    variance += (off_mm / DOUBT).powi(2) - sigma.powi(2);
                    self.slipped_mm[found.straight] = off_mm;
                }
            }
            self.belief.update(&[row], &[found.growth_mm], &DMatrix::from_element(1, 1, variance));
        }
    }

    /// By how much a straight comes out longer than fed, on the nominal's radii, at these commanded and formed
    /// angles.
    pub fn growth(&self, straight: usize, commanded_rad: &[f64], formed_rad: &[f64]) -> Known {
        let sides = sides(&self.wanted, straight, commanded_rad, formed_rad, |i| {
            self.wanted.bends[i].angle_rad < MeasuredTube::INTERSECTION_LIMIT_RAD
        });
        self.belief.predict(&self.row(straight, &sides))
    }

    /// The feed that gives the wanted straight when the bends come out right; may be negative.
    pub fn command_for(&self, straight: usize, commanded_rad: &[f64]) -> f64 {
        let formed: Vec<f64> = self.wanted.bends.iter().map(|b| b.angle_rad).collect();
        self.wanted.bends[straight].length_mm - self.growth(straight, commanded_rad, &formed).value
    }

    /// Sigma of a straight's innovation when the last part came in.
    pub fn surprise_sigma_mm(&self, straight: usize) -> f64 {
        self.surprise_sigma_mm[straight]
    }

    /// Straights (from 0) that the last part's feed missed by more than scatter explains, and by how much.
    pub fn slips(&self) -> impl Iterator<Item = (usize, f64)> {
        self.slipped_mm.iter().copied().enumerate().filter(|(_, mm)| *mm != 0.0)
    }

    fn row(&self, straight: usize, sides: &Sides) -> DVector<f64> {
        let mut row = growth_row(self.belief.len(), sides);
        row[2 + straight] = 1.0;
        row
    }
}

fn growth_row(len: usize, sides: &Sides) -> DVector<f64> {
    let mut row = DVector::zeros(len);
    row[0] = sides.sprung_mm;
    row[1] = sides.plain_mm;
    row
}

fn sides(
    wanted: &Lra,
    straight: usize,
    commanded: &[f64],
    formed: &[f64],
    corner: impl Fn(usize) -> bool,
) -> Sides {
    let mut out = Sides::default();
    let last = wanted.bends.len();
    for i in [straight.checked_sub(1), (straight < last).then_some(straight)].into_iter().flatten() {
        if corner(i) && formed[i] > 0.0 {
            let tangent = wanted.bends[i].radius_mm * (formed[i] / 2.0).tan();
            out.plain_mm += tangent;
            out.sprung_mm += tangent * (commanded[i] - formed[i]).max(0.0) / formed[i];
        }
    }
    out
}

/// One straight of one part: by how much it came out longer than fed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grown {
    /// Straight, from 0.
    pub straight: usize,
    /// Its sides.
    pub sides: Sides,
    /// Measured distance less the fed length and the die's tangent lengths.
    pub growth_mm: f64,
    /// Sigma of the measurement and the feed.
    pub sigma_mm: f64,
}

/// All fed straights that the scan knows.
pub fn grown(wanted: &Lra, commanded: &CommandTable, measured: &MeasuredTube) -> Vec<Grown> {
    let corner = corners(measured, wanted);
    let angles: Vec<f64> = commanded.bends.iter().map(|r| r.angle_rad).collect();
    let formed: Vec<f64> = measured.bends.iter().map(|b| b.angle_rad).collect();
    let one = |(straight, found): (usize, Option<Known>)| {
        let found = found?;
        let sides = sides(wanted, straight, &angles, &formed, |i| corner[i]);
        let growth_mm = found.value - commanded.bends[straight].length_mm - sides.plain_mm;
        Some(Grown { straight, sides, growth_mm, sigma_mm: found.sigma.hypot(FEED_SCATTER_MM) })
    };
    let fed = distances(measured, &corner).into_iter().take(wanted.bends.len());
    fed.enumerate().filter_map(one).collect()
}

/// By how much each bend's plane comes out off the commanded turn: backlash, a worn clamp. One offset per bend.
#[derive(Debug, Clone)]
pub struct Rotations {
    offset: Vec<Known>,
}

/// Prior of an offset, and the scatter of the axis.
const OFFSET: Known = Known { value: 0.0, sigma: 0.2 * DEGREE };
const AXIS_SCATTER_RAD: f64 = 0.1 * DEGREE;

impl Rotations {
    /// Nothing known.
    pub fn prior(bends: usize) -> Rotations {
        Rotations { offset: vec![OFFSET; bends] }
    }

    /// Takes in one part; a rotation known worse than half its tolerance says nothing.
    pub fn learn(&mut self, commanded: &CommandTable, measured: &MeasuredTube, tolerance_rad: f64) {
        for (i, offset) in self.offset.iter_mut().enumerate() {
            let Some(found) = rotation(measured, i).filter(|r| r.sigma <= tolerance_rad / 2.0) else {
                continue;
            };
            let innovation = wrap_angle(found.value - commanded.bends[i].rotation_rad) - offset.value;
            let noise = found.sigma.powi(2) + AXIS_SCATTER_RAD.powi(2);
            let prior = offset.sigma.powi(2);
            offset.value += innovation * prior / (prior + noise);
            offset.sigma = (prior * noise / (prior + noise)).sqrt();
        }
    }

    /// The turn to command for a wanted one; the first row has no plane to turn against.
    pub fn command_for(&self, bend: usize, wanted_rad: f64) -> f64 {
        if bend == 0 { wanted_rad } else { wanted_rad - self.offset[bend].value }
    }
}
