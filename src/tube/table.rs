//! The bending table that a machine is told: lengths, rotations, angles; the radius is the die's.

use serde::{Deserialize, Serialize};

use super::{Bend, Lra, TubeError, deg};

/// One commanded row.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommandRow {
    /// Feed before the bend, >= 0.
    pub length_mm: f64,
    /// Turn of the plane of bend.
    #[serde(rename = "rotation_deg", with = "deg")]
    pub rotation_rad: f64,
    /// Angle that the bend arm is driven to (springs back to less).
    #[serde(rename = "angle_deg", with = "deg")]
    pub angle_rad: f64,
}

/// A table for the machine. Its JSON form is the contract of `benderd correct`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommandTable {
    /// Rows in feed order.
    pub bends: Vec<CommandRow>,
    /// What is left after the last bend; the cut length decides it, not the feed.
    pub last_length_mm: f64,
}

impl CommandTable {
    /// The table that would be right if nothing sprang back.
    pub fn from_lra(lra: &Lra) -> CommandTable {
        let row = |b: &Bend| CommandRow {
            length_mm: b.length_mm,
            rotation_rad: b.rotation_rad,
            angle_rad: b.angle_rad,
        };
        CommandTable { bends: lra.bends.iter().map(row).collect(), last_length_mm: lra.last_length_mm }
    }

    /// The tube that this table describes on a die without spring-back; `radii_mm` one per bend (missing ones
    /// take the last given).
    pub fn to_lra(&self, radii_mm: &[f64]) -> Lra {
        let radius = |i: usize| radii_mm.get(i).or(radii_mm.last()).copied().unwrap_or(0.0);
        let bend = |(i, r): (usize, &CommandRow)| Bend {
            length_mm: r.length_mm,
            rotation_rad: r.rotation_rad,
            angle_rad: r.angle_rad,
            radius_mm: radius(i),
        };
        Lra { bends: self.bends.iter().enumerate().map(bend).collect(), last_length_mm: self.last_length_mm }
    }

    /// What another table has otherwise, value by value, by more than a step (length in mm, angle in radians); lasts straights aside.
    pub fn differences(&self, found: &CommandTable, (step_mm, step_rad): (f64, f64)) -> Vec<String> {
        /// What writing values down and reading them back may leave.
        const ROUNDING: f64 = 1e-6;
        if self.bends.len() != found.bends.len() {
            return vec![format!("{} bends instead of {}", found.bends.len(), self.bends.len())];
        }
        let mut out = Vec::new();
        for (i, (own, found)) in self.bends.iter().zip(&found.bends).enumerate() {
            let degree = 1.0_f64.to_radians();
            let values = [
                ("feed", own.length_mm, found.length_mm, step_mm, "mm", 1.0),
                ("rotation", own.rotation_rad, found.rotation_rad, step_rad, "degrees", degree),
                ("angle", own.angle_rad, found.angle_rad, step_rad, "degrees", degree),
            ];
            for (what, own, found, step, unit, size) in values {
                if (own - found).abs() > step + ROUNDING {
                    let (own, found) = (own / size, found / size);
                    out.push(format!("{what} {} is {found:.2} {unit} instead of {own:.2}", i + 1));
                }
            }
        }
        out
    }

    /// Refuses what no machine can be told (see [`Lra::validate`]).
    pub fn validate(&self) -> Result<(), TubeError> {
        self.to_lra(&[1.0]).validate()
    }
}
