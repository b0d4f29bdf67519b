//! The oracle's rotations: the backlash is all that stays.

use super::{log_normal, normalised};
use crate::sim::forming::{lag_after, spread};
use crate::tube::{CommandTable, Nominal, wrap_angle};

/// Backlashes that are tried.
const TRIED: usize = 11;

/// The belief.
#[derive(Debug, Clone)]
pub struct Turns {
    backlash_rad: Vec<f64>,
    logs: Vec<f64>,
}

impl Turns {
    /// Before the key's first part.
    pub fn new() -> Turns {
        let [from, to] = spread::BACKLASH_RAD;
        let tried = |k: usize| from + (to - from) * (k as f64 + 0.5) / TRIED as f64;
        Turns { backlash_rad: (0..TRIED).map(tried).collect(), logs: vec![0.0; TRIED] }
    }

    /// By how much each turn is off with a backlash.
    fn off(wanted: &[f64], backlash_rad: f64) -> Vec<f64> {
        let mut lag_rad = 0.0;
        let turn = |commanded: &f64| {
            let before = lag_rad;
            lag_rad = lag_after(*commanded, before, backlash_rad);
            lag_rad - before
        };
        wanted.iter().map(turn).collect()
    }

    /// Takes a scan in: rotations with their sigmas; the first has none.
    pub fn learn(&mut self, commanded: &CommandTable, measured: &[(f64, f64)]) {
        let turns: Vec<f64> = commanded.bends.iter().map(|row| row.rotation_rad).collect();
        for (k, backlash_rad) in self.backlash_rad.iter().enumerate() {
            let off = Turns::off(&turns, *backlash_rad);
            for i in 1..turns.len() {
                let (found, sigma) = measured[i];
                let left = wrap_angle(found - turns[i] - off[i]);
                self.logs[k] += log_normal(left, spread::TURN_RAD.powi(2) + sigma * sigma);
            }
        }
    }

    /// The turns to command for a part.
    pub fn commands_for(&self, part: &Nominal) -> Vec<f64> {
        let wanted: Vec<f64> = part.lra.bends.iter().map(|b| b.rotation_rad).collect();
        let mut out = wanted.clone();
        for (weight, backlash_rad) in normalised(&self.logs).into_iter().zip(&self.backlash_rad) {
            let off = Turns::off(&wanted, *backlash_rad);
            out.iter_mut().zip(off).for_each(|(turn, off)| *turn -= weight * off);
        }
        out
    }
}
