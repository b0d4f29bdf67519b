//! The part as drawn: nominal LRA, tube, die, tolerance. Read from part files by `config`.

use serde::Serialize;

use super::{Lra, Material};

/// The named way in which measured and nominal are laid over each other before points are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
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
    /// Whether a tube of this radius cannot be the part, whatever its shape.
    pub fn is_other_tube(&self, tube_radius_mm: f64) -> bool {
        (2.0 * tube_radius_mm - self.od_mm).abs() > OTHER_TUBE_SHARE * self.od_mm
    }
}
