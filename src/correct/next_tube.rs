//! The tube that a table is expected to give, laid over the nominal.

use nalgebra::{DMatrix, Matrix3};

use super::replay::Model;
use crate::inspect::Overlay;
use crate::tube::{CommandTable, Lra, Nominal, wrap_angle};

/// The mean of the next tubes at one table.
#[derive(Debug, Clone)]
pub struct NextTube {
    /// On the nominal's radii.
    pub lra: Lra,
    /// Over the nominal by the part's alignment.
    pub overlay: Overlay,
}

impl NextTube {
    /// For a table of as many bends as the part; None where its values make no tube.
    pub fn new(model: &Model, nominal: &Nominal, table: &CommandTable) -> Option<NextTube> {
        let mut lra = model.expected(nominal, table);
        for (i, bend) in lra.bends.iter_mut().enumerate() {
            bend.rotation_rad += model.rotations.next_off(i).value;
        }
        let overlay = Overlay::new(&lra, &nominal.lra, nominal.tolerance.alignment)?;
        Some(NextTube { lra, overlay })
    }

    /// Formed less wanted: length, rotation, angle of each bend; the first row's turn is none.
    pub fn own_off(&self, nominal: &Nominal) -> Vec<f64> {
        let both = self.lra.bends.iter().zip(&nominal.lra.bends).enumerate();
        let off = both.map(|(i, (b, n))| {
            let turn = if i > 0 { wrap_angle(b.rotation_rad - n.rotation_rad) } else { 0.0 };
            [b.length_mm - n.length_mm, turn, b.angle_rad - n.angle_rad]
        });
        off.flatten().collect()
    }

    /// The check point that is farthest off (index in the overlay), and by how much.
    pub fn worst_point(&self) -> (usize, f64) {
        let off = self.overlay.off_mm.iter().map(|off| off.norm()).enumerate();
        off.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, 0.0))
    }

    /// The bend (from 0) whose angle is farthest off, and by how much.
    pub fn worst_angle(&self, nominal: &Nominal) -> (usize, f64) {
        let angles = self.own_off(nominal).into_iter().skip(2).step_by(3).enumerate();
        angles.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs())).unwrap_or((0, 0.0))
    }

    /// The largest deviation of what a tube is accepted on, over its tolerance: check points and angles.
    pub fn share(&self, nominal: &Nominal) -> f64 {
        let tolerance = &nominal.tolerance;
        let angle = self.worst_angle(nominal).1.abs() / tolerance.angle_rad;
        angle.max(self.worst_point().1 / tolerance.envelope_mm)
    }

    /// By how much each value of the next tube may be off from the mean, one sigma: what is not known, and what scatters from tube
    /// to tube.
    pub fn sigmas(&self, model: &Model, table: &CommandTable) -> Vec<f64> {
        let commanded: Vec<f64> = table.bends.iter().map(|row| row.angle_rad).collect();
        let formed: Vec<f64> = self.lra.bends.iter().map(|b| b.angle_rad).collect();
        let one = |i: usize| {
            [
                model.lengths.next_growth(i, &commanded, &formed).sigma,
                model.rotations.next_off(i).sigma,
                model.springback.next_at(i, commanded[i]).sigma,
            ]
        };
        (0..commanded.len()).flat_map(one).collect()
    }

    /// The same for the check points, each in its worst direction; the values as independent of each other.
    pub fn point_sigmas(&self, moves: &DMatrix<f64>, sigmas: &[f64]) -> Vec<f64> {
        let one = |k: usize| {
            let mut spread = Matrix3::zeros();
            for (column, sigma) in sigmas.iter().enumerate() {
                let moved = moves.fixed_view::<3, 1>(3 * k, column) * *sigma;
                spread += moved * moved.transpose();
            }
            spread.symmetric_eigenvalues().max().max(0.0).sqrt()
        };
        (0..self.overlay.off_mm.len()).map(one).collect()
    }

    /// What a value formed gains per value commanded.
    pub fn gains(&self, model: &Model, table: &CommandTable) -> Vec<f64> {
        const STEP_RAD: f64 = 1e-4;
        let one = |(i, row): (usize, &crate::tube::CommandRow)| {
            let springback = |more| model.springback.at(i, row.angle_rad + more).value;
            [1.0, 1.0, 1.0 - (springback(STEP_RAD) - springback(-STEP_RAD)) / (2.0 * STEP_RAD)]
        };
        table.bends.iter().enumerate().flat_map(one).collect()
    }
}
