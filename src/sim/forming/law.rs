//! What a set-up springs back on average, before scatter: from the beam formula with a fixed part, or read from curves of a file.
//!
//! Nothing here is shared with `correct`: the loop is tested on worlds that it does not know.

use std::f64::consts::FRAC_PI_2;
use std::sync::Arc;

use super::curves::Curve;
use crate::tube::Nominal;

/// Over this bend angle the fixed part of spring-back builds up.
const FIXED_PART_ANGLE_RAD: f64 = 12.0 * std::f64::consts::PI / 180.0;

/// Mean spring-back of one set-up, before the factors of key, batch and tube.
#[derive(Debug, Clone, PartialEq)]
pub enum Law {
    /// In proportion to the angle, as the beam formula has it, and a part that even a long bend has on top.
    Beam {
        /// That part.
        fixed_rad: f64,
    },
    /// As a curve says.
    Curve(Arc<Curve>),
}

impl Law {
    /// Commanded minus formed angle of a bend with this [`elastic_share`].
    pub fn springback_rad(&self, elastic_share: f64, commanded_rad: f64) -> f64 {
        match self {
            Law::Beam { fixed_rad } => {
                let fixed = fixed_rad * (1.0 - (-commanded_rad / FIXED_PART_ANGLE_RAD).exp());
                fixed + elastic_share * commanded_rad
            }
            Law::Curve(curve) => curve.at_rad(commanded_rad),
        }
    }
}

/// Elastic recovery over bend angle, M R / (E I), with the moment integrated over a thin-walled section that
/// is elastic up to yield and hardens as K eps^n beyond.
pub fn elastic_share(part: &Nominal, radius_mm: f64) -> f64 {
    const STEPS: u32 = 64;
    let m = &part.material;
    let middle_mm = (part.od_mm - part.wall_mm) / 2.0;
    let stress_mpa = |strain: f64| {
        let elastic = m.youngs_modulus_mpa * strain;
        if elastic < m.yield_mpa {
            elastic
        } else {
            m.yield_mpa.max(m.strength_coefficient_mpa * strain.powf(m.hardening_exponent)).min(elastic)
        }
    };
    let slice = |k: u32| {
        let height_mm = middle_mm * (FRAC_PI_2 * (f64::from(k) + 0.5) / f64::from(STEPS)).sin();
        stress_mpa(height_mm / radius_mm) * height_mm
    };
    let sum: f64 = (0..STEPS).map(slice).sum();
    let moment = 4.0 * middle_mm * part.wall_mm * sum * FRAC_PI_2 / f64::from(STEPS);
    let stiffness = m.youngs_modulus_mpa * std::f64::consts::PI * middle_mm.powi(3) * part.wall_mm;
    moment * radius_mm / stiffness
}
