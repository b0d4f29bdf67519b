//! How far to turn: what the plane of each bend comes out off the commanded turn.
//!
//! Backlash lets the head stand behind its last move by half of b: a turn comes out off by the change of that, so by its own and
//! the last move's direction. b belongs to the key; what is left over, r_i, to the bend in this program (field notes:
//! "Backlash shows as an offset that depends on direction"). A rotation known worse than half its tolerance says nothing.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::belief::Belief;
use super::knowledge::JobRecord;
use crate::inspect::{Known, rotation};
use crate::tube::{CommandTable, Lra, MeasuredTube, deg, wrap_angle};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Prior of b and of a bend's own, and the scatter of the axis.
const BACKLASH: Known = Known { value: 0.1 * DEGREE, sigma: 0.1 * DEGREE };
const RESIDUAL: Known = Known { value: 0.0, sigma: 0.04 * DEGREE };
pub(super) const AXIS_SCATTER_RAD: f64 = 0.08 * DEGREE;
/// What a bend's own drifts by per part.
const DRIFT_RAD: f64 = 0.005 * DEGREE;
/// Beyond this many sigmas a rotation counts less.
const DOUBT: f64 = 3.0;

/// The belief.
#[derive(Debug, Clone)]
pub struct Rotations {
    belief: Belief,
    /// By how much a turn comes out off per backlash, for each bend.
    per_backlash: Vec<f64>,
    /// By how much each came out off beyond doubt in the last part, 0 where it did not.
    odd_rad: Vec<f64>,
}

/// One turn, for the knowledge of its key.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TurnPoint {
    /// By how much it would come out off per backlash.
    pub per_backlash: f64,
    /// Measured less commanded turn.
    #[serde(rename = "off_deg", with = "deg")]
    pub off_rad: f64,
    /// Sigma of that mean.
    #[serde(rename = "sigma_deg", with = "deg")]
    pub sigma_rad: f64,
}

impl Rotations {
    /// What is believed before the job's first part.
    pub fn prior(wanted: &Lra, records: &[&JobRecord]) -> Rotations {
        let mut unknowns = vec![BACKLASH];
        unknowns.extend(vec![RESIDUAL; wanted.bends.len()]);
        let mut belief = Belief::new(&unknowns);
        for point in records.iter().flat_map(|record| &record.turns) {
            let mut row = DVector::zeros(belief.len());
            row[0] = point.per_backlash;
            let variance = point.sigma_rad.powi(2) + RESIDUAL.sigma.powi(2);
            belief.update(&[row], &[point.off_rad], &DMatrix::from_element(1, 1, variance));
        }
        let turns: Vec<f64> = wanted.bends.iter().map(|b| b.rotation_rad).collect();
        Rotations { belief, per_backlash: per_backlash(&turns), odd_rad: vec![0.0; turns.len()] }
    }

    /// Takes in one part.
    pub fn learn(&mut self, commanded: &CommandTable, measured: &MeasuredTube, tolerance_rad: f64) {
        for (i, point) in turned(commanded, measured, tolerance_rad) {
            self.belief.loosen(1 + i, DRIFT_RAD);
            let mut row = DVector::zeros(self.belief.len());
            (row[0], row[1 + i]) = (point.per_backlash, 1.0);
            let expected = self.belief.predict(&row);
            let off_rad = point.off_rad - expected.value;
            let doubtful = off_rad.abs() / (DOUBT * expected.sigma.hypot(point.sigma_rad));
            let before_rad = std::mem::take(&mut self.odd_rad[i]);
            let mut variance = point.sigma_rad.powi(2);
            if doubtful > 1.0 && before_rad * off_rad > 0.0 {
                // Twice in a row the same way: the axis has changed.
                self.belief.loosen(1 + i, off_rad);
            } else if doubtful > 1.0 {
                variance += (off_rad / DOUBT).powi(2);
                self.odd_rad[i] = off_rad;
            }
            self.belief.update(&[row], &[point.off_rad], &DMatrix::from_element(1, 1, variance));
        }
    }

    /// The head's backlash.
    pub fn backlash(&self) -> Known {
        self.belief.unknown(0)
    }

    /// The turn to command for a wanted one; the first row has no plane to turn against.
    pub fn command_for(&self, bend: usize, wanted_rad: f64) -> f64 {
        wanted_rad - self.next_off(bend).value
    }

    /// By how much the next tube's turn comes out off the commanded one, with the axis's scatter in the sigma; 0 in the first row.
    pub fn next_off(&self, bend: usize) -> Known {
        if bend == 0 {
            return Known { value: 0.0, sigma: 0.0 };
        }
        let mut row = DVector::zeros(self.belief.len());
        (row[0], row[1 + bend]) = (self.per_backlash[bend], 1.0);
        let off = self.belief.predict(&row);
        Known { sigma: off.sigma.hypot(AXIS_SCATTER_RAD), ..off }
    }
}

/// By how much each turn comes out off per backlash: the head stands half of it behind its last move.
fn per_backlash(turns: &[f64]) -> Vec<f64> {
    let mut behind = 0.0;
    let one = |turn: &f64| {
        let before = behind;
        if *turn != 0.0 {
            behind = -0.5 * turn.signum();
        }
        behind - before
    };
    turns.iter().map(one).collect()
}

/// All turns of a part that are known well enough: bend, from 0, and what came of it.
pub fn turned(
    commanded: &CommandTable,
    measured: &MeasuredTube,
    tolerance_rad: f64,
) -> Vec<(usize, TurnPoint)> {
    let turns: Vec<f64> = commanded.bends.iter().map(|row| row.rotation_rad).collect();
    let one = |(i, per_backlash): (usize, f64)| {
        let found = rotation(measured, i).filter(|r| r.sigma <= tolerance_rad / 2.0)?;
        let off_rad = wrap_angle(found.value - turns[i]);
        Some((i, TurnPoint { per_backlash, off_rad, sigma_rad: found.sigma.hypot(AXIS_SCATTER_RAD) }))
    };
    per_backlash(&turns).into_iter().enumerate().filter_map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_is_off_by_the_change_of_what_the_head_stands_behind() {
        // The same way twice is on spot the second time; a change of way costs all of it; no turn changes nothing.
        let turns = [0.0, 1.0, 0.5, -0.3, 0.0, -0.2, 0.7].map(f64::to_radians);
        assert_eq!(per_backlash(&turns), [0.0, -0.5, 0.0, 1.0, 0.0, 0.0, -1.0]);
    }
}
