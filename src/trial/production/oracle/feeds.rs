//! The oracle's feeds: how much of the spring-back opens the arcs is all that stays; the rest is scatter, with slips.

use super::{log_normal, normalised};
use crate::sim::forming::{opened, spread};
use crate::tube::Nominal;

/// Shares that are tried.
const SHARES: usize = 31;

/// Slips that are tried, in means of their distribution: middles of ten equally likely parts.
const SLIPS: usize = 10;

/// The belief.
#[derive(Debug, Clone)]
pub struct Feeds {
    part: Nominal,
    in_arc: Vec<f64>,
    logs: Vec<f64>,
}

impl Feeds {
    /// Before the key's first part.
    pub fn new(part: &Nominal) -> Feeds {
        let [from, to] = spread::IN_ARC;
        let share = |k: usize| from + (to - from) * (k as f64 + 0.5) / SHARES as f64;
        Feeds { part: part.clone(), in_arc: (0..SHARES).map(share).collect(), logs: vec![0.0; SHARES] }
    }

    /// Another part on the same set-up.
    pub fn new_program(&mut self, part: &Nominal) {
        self.part = part.clone();
    }

    /// From mark to mark, more than fed, on the wanted bends' radii at the formed angles.
    fn growth_mm(&self, in_arc: f64, straight: usize, commanded: &[f64], formed: &[f64]) -> f64 {
        let sides = [straight.checked_sub(1), Some(straight)].into_iter().flatten();
        sides
            .map(|i| {
                let (radius_mm, straightened_mm) =
                    opened(self.part.lra.bends[i].radius_mm, commanded[i], formed[i], in_arc);
                straightened_mm + radius_mm * (formed[i] / 2.0).tan()
            })
            .sum()
    }

    /// Takes a scan in: angles and distances between marks with their sigmas.
    pub fn learn(&mut self, fed_mm: &[f64], commanded: &[f64], formed: &[f64], distances: &[(f64, f64)]) {
        for (k, in_arc) in self.in_arc.iter().enumerate() {
            for (straight, (found_mm, sigma_mm)) in distances.iter().enumerate() {
                let off = found_mm - fed_mm[straight] - self.growth_mm(*in_arc, straight, commanded, formed);
                let variance = spread::FEED_MM.powi(2) + sigma_mm * sigma_mm;
                let slipped = (0..SLIPS).map(|s| {
                    let slip_mm = -spread::SLIP_MM * (1.0 - (s as f64 + 0.5) / SLIPS as f64).ln();
                    log_normal(off + slip_mm, variance).exp() / SLIPS as f64
                });
                let usual = (1.0 - spread::SLIP_SHARE) * log_normal(off, variance).exp();
                self.logs[k] += (usual + spread::SLIP_SHARE * slipped.sum::<f64>()).max(1e-300).ln();
            }
        }
    }

    /// The feed for a wanted straight.
    pub fn command_for(&self, straight: usize, commanded: &[f64]) -> f64 {
        let bends = &self.part.lra.bends;
        let formed: Vec<f64> = bends.iter().map(|b| b.angle_rad).collect();
        let sides = [straight.checked_sub(1), Some(straight)].into_iter().flatten();
        let plain: f64 = sides.map(|i| bends[i].radius_mm * (formed[i] / 2.0).tan()).sum();
        let each = normalised(&self.logs).into_iter().zip(&self.in_arc);
        let growth: f64 =
            each.map(|(w, in_arc)| w * self.growth_mm(*in_arc, straight, commanded, &formed)).sum();
        // Slips come out short: the middle of what may come is wanted, not its mean.
        (bends[straight].length_mm + plain - growth).max(0.0)
    }
}
