//! The part as drawn: nominal LRA, tube, die, tolerance. Read from part files by `config`.

use serde::{Deserialize, Serialize};

use super::{Lra, Material};

/// The named way in which measured and nominal are laid over each other before points are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Alignment {
    /// Least squares over all tangent points and middles.
    #[default]
    BestFit,
    /// First straight on first straight.
    AEnd,
    /// Last straight on last straight.
    BEnd,
    /// Least squares weighted by straight length.
    Weighted,
    /// Least squares over the two end straights, as a gauge holds the tube.
    Fixture,
}

impl std::fmt::Display for Alignment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Alignment::BestFit => "best-fit",
            Alignment::AEnd => "a-end",
            Alignment::BEnd => "b-end",
            Alignment::Weighted => "weighted",
            Alignment::Fixture => "fixture",
        })
    }
}

/// How far off is still good.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Radius of the sphere around each tangent point after alignment.
    pub envelope_mm: f64,
    /// Bend angle.
    pub angle_rad: f64,
    /// Turn between planes.
    pub rotation_rad: f64,
    /// Straight length.
    pub length_mm: f64,
    /// How the tubes are laid over each other.
    pub alignment: Alignment,
}

/// One part's nominal.
#[derive(Debug, Clone, PartialEq)]
pub struct Nominal {
    /// Part name; also the program's name at the machine.
    pub name: String,
    /// Outer diameter.
    pub od_mm: f64,
    /// Wall thickness.
    pub wall_mm: f64,
    /// What it is made of.
    pub material: Material,
    /// The die's centre-line radius.
    pub die_clr_mm: f64,
    /// The wanted tube; radius per bend (the die's unless the part says otherwise).
    pub lra: Lra,
    /// What is accepted.
    pub tolerance: Tolerance,
}

/// A diameter that is off by more than this share is another tube's: mill tolerances are below one in a hundred.
const OTHER_TUBE_SHARE: f64 = 0.05;

impl Nominal {
    /// A part of this table for where only its shape matters: mild steel, usual tolerances, the first bend's die.
    pub fn of_table(lra: Lra, od_mm: f64, wall_mm: f64) -> Nominal {
        let material = Material {
            key: "steel".to_owned(),
            youngs_modulus_mpa: 2e5,
            yield_mpa: 250.0,
            strength_coefficient_mpa: 500.0,
            hardening_exponent: 0.2,
            usual_springback_rad: 0.03,
        };
        let (angle_rad, rotation_rad) = (0.3f64.to_radians(), 0.5f64.to_radians());
        let alignment = Alignment::BestFit;
        let tolerance = Tolerance { envelope_mm: 1.0, angle_rad, rotation_rad, length_mm: 0.5, alignment };
        let die_clr_mm = lra.bends.first().map_or(od_mm, |b| b.radius_mm);
        Nominal { name: "part".to_owned(), od_mm, wall_mm, material, die_clr_mm, lra, tolerance }
    }

    /// Whether a tube of this radius cannot be the part, whatever its shape.
    pub fn is_other_tube(&self, tube_radius_mm: f64) -> bool {
        (2.0 * tube_radius_mm - self.od_mm).abs() > OTHER_TUBE_SHARE * self.od_mm
    }
}
