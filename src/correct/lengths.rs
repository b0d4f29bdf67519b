//! How much to feed: distances of corners with the angle error taken out first.
//!
//! A bend pushes the corners at its two sides away from the fed length by its tangent length T, and that grows beyond the
//! die's when the tube springs back: a share a of the spring-back s opens the arc, whose length R c stays, from the die's
//! radius R to R c / (c - a s), c the commanded angle; the rest straightens both its ends by R (1 - a) s / 2 each. So
//! D - L = sum of T (1 + g) + what opens and straightens at a + q, at the *measured* angles (an angle error is no feed
//! error), with a and g common to the key, q the straight's own. Beside a bend of 150 degrees or more, whose corner
//! runs away, the straight is measured from its tangent point. The straight after the last bend is what the cut length
//! leaves. Linear in a about its usual value; the field notes give the lengths, the geometry is elementary.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::belief::Belief;
use super::knowledge::JobRecord;
use crate::inspect::{Known, corners, distances};
use crate::tube::{CommandTable, Lra, MeasuredTube, deg};

/// Usual share of the spring-back that opens the arc, and what is believed of the key's about it.
const USUAL_SHARE: f64 = 0.65;
const SHARE: Known = Known { value: 0.0, sigma: 0.15 };
/// Prior of g, what the arc grows without spring-back.
const CONSTANT_GROWTH: Known = Known { value: 0.0, sigma: 0.002 };
/// Prior of a straight's residual, its drift per part, and the feed's own scatter.
const RESIDUAL_SIGMA_MM: f64 = 0.08;
const DRIFT_MM: f64 = 0.01;
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

/// A bend at one side of a straight, whose corner counts.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Side {
    /// The die's radius.
    pub radius_mm: f64,
    /// Commanded angle.
    #[serde(rename = "commanded_deg", with = "deg")]
    pub commanded_rad: f64,
    /// Formed angle.
    #[serde(rename = "formed_deg", with = "deg")]
    pub formed_rad: f64,
}

impl Side {
    /// T on the die's radius.
    fn tangent_mm(&self) -> f64 {
        self.radius_mm * (self.formed_rad / 2.0).tan()
    }

    /// What opening and straightening add at this share.
    fn sprung_mm(&self, share: f64) -> f64 {
        let springback = (self.commanded_rad - self.formed_rad).clamp(0.0, 0.5 * self.commanded_rad);
        let opened_mm = self.radius_mm * self.commanded_rad / (self.commanded_rad - share * springback);
        self.tangent_mm() * (opened_mm / self.radius_mm - 1.0) + opened_mm * (1.0 - share) * springback / 2.0
    }

    /// The same by how much more per share.
    fn per_share_mm(&self) -> f64 {
        const STEP: f64 = 0.1;
        (self.sprung_mm(USUAL_SHARE + STEP) - self.sprung_mm(USUAL_SHARE - STEP)) / (2.0 * STEP)
    }
}

impl Lengths {
    /// What is believed before the job's first part.
    pub fn prior(wanted: &Lra, records: &[&JobRecord]) -> Lengths {
        let mut unknowns = vec![SHARE, CONSTANT_GROWTH];
        unknowns.extend(vec![Known { value: 0.0, sigma: RESIDUAL_SIGMA_MM }; wanted.bends.len()]);
        let mut belief = Belief::new(&unknowns);
        for point in records.iter().flat_map(|r| &r.straights) {
            let row = growth_row(belief.len(), &point.sides);
            let variance = point.sigma_mm.powi(2) + RESIDUAL_SIGMA_MM.powi(2);
            let value = point.growth_mm - usual_mm(&point.sides);
            belief.update(&[row], &[value], &DMatrix::from_element(1, 1, variance));
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
            let value = found.growth_mm - usual_mm(&found.sides);
            let off_mm = value - expected.value;
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
            self.belief.update(&[row], &[value], &DMatrix::from_element(1, 1, variance));
        }
    }

    /// By how much a straight comes out longer than fed, on the nominal's radii, at these commanded and formed
    /// angles.
    pub fn growth(&self, straight: usize, commanded_rad: &[f64], formed_rad: &[f64]) -> Known {
        let sides = sides(&self.wanted, straight, commanded_rad, formed_rad, |i| {
            self.wanted.bends[i].angle_rad < MeasuredTube::INTERSECTION_LIMIT_RAD
        });
        let more = self.belief.predict(&self.row(straight, &sides));
        Known { value: more.value + usual_mm(&sides), sigma: more.sigma }
    }

    /// The same with the feed's scatter in the sigma.
    pub fn next_growth(&self, straight: usize, commanded_rad: &[f64], formed_rad: &[f64]) -> Known {
        let growth = self.growth(straight, commanded_rad, formed_rad);
        Known { sigma: growth.sigma.hypot(FEED_SCATTER_MM), ..growth }
    }

    /// The feed that gives the wanted straight when the bends come out right; may be negative.
    pub fn command_for(&self, straight: usize, commanded_rad: &[f64]) -> f64 {
        let formed: Vec<f64> = self.wanted.bends.iter().map(|b| b.angle_rad).collect();
        self.wanted.bends[straight].length_mm - self.growth(straight, commanded_rad, &formed).value
    }

    /// Share of the spring-back that opens the arc.
    pub fn share(&self) -> Known {
        let more = self.belief.unknown(0);
        Known { value: USUAL_SHARE + more.value, ..more }
    }

    /// What the arc grows without spring-back, as a share of its radius.
    pub fn constant_growth(&self) -> Known {
        self.belief.unknown(1)
    }

    /// Sigma of a straight's innovation when the last part came in.
    pub fn surprise_sigma_mm(&self, straight: usize) -> f64 {
        self.surprise_sigma_mm[straight]
    }

    /// Straights (from 0) that the last part's feed missed by more than scatter explains, and by how much.
    pub fn slips(&self) -> impl Iterator<Item = (usize, f64)> {
        self.slipped_mm.iter().copied().enumerate().filter(|(_, mm)| *mm != 0.0)
    }

    fn row(&self, straight: usize, sides: &[Side]) -> DVector<f64> {
        let mut row = growth_row(self.belief.len(), sides);
        row[2 + straight] = 1.0;
        row
    }
}

fn growth_row(len: usize, sides: &[Side]) -> DVector<f64> {
    let mut row = DVector::zeros(len);
    row[0] = sides.iter().map(Side::per_share_mm).sum();
    row[1] = sides.iter().map(Side::tangent_mm).sum();
    row
}

/// What the sides add at the usual share, beyond the die's tangent lengths.
fn usual_mm(sides: &[Side]) -> f64 {
    sides.iter().map(|side| side.sprung_mm(USUAL_SHARE)).sum()
}

fn sides(
    wanted: &Lra,
    straight: usize,
    commanded: &[f64],
    formed: &[f64],
    corner: impl Fn(usize) -> bool,
) -> Vec<Side> {
    let last = wanted.bends.len();
    let both = [straight.checked_sub(1), (straight < last).then_some(straight)].into_iter().flatten();
    let side = |i: usize| Side {
        radius_mm: wanted.bends[i].radius_mm,
        commanded_rad: commanded[i].max(formed[i]),
        formed_rad: formed[i],
    };
    both.filter(|&i| corner(i) && formed[i] > 0.0).map(side).collect()
}

/// One straight of one part: by how much it came out longer than fed.
#[derive(Debug, Clone, PartialEq)]
pub struct Grown {
    /// Straight, from 0.
    pub straight: usize,
    /// Its sides.
    pub sides: Vec<Side>,
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
        let tangents_mm: f64 = sides.iter().map(Side::tangent_mm).sum();
        let growth_mm = found.value - commanded.bends[straight].length_mm - tangents_mm;
        Some(Grown { straight, sides, growth_mm, sigma_mm: found.sigma.hypot(FEED_SCATTER_MM) })
    };
    let fed = distances(measured, &corner).into_iter().take(wanted.bends.len());
    fed.enumerate().filter_map(one).collect()
}
