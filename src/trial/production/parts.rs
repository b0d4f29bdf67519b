//! Parts for campaigns: six bends drawn at random, as a shop would program them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::sim::forming::curves::Curve;
use crate::tube::{Alignment, Bend, Lra, Material, Nominal, Tolerance};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Bends of each part.
pub const BENDS: usize = 6;

/// Tube and die.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stock {
    /// Outer diameter.
    pub od_mm: f64,
    /// Wall.
    pub wall_mm: f64,
    /// The die's centre-line radius.
    pub clr_mm: f64,
}

impl Stock {
    /// An inch on a die of two diameters.
    pub const INCH: Stock = Stock { od_mm: 25.4, wall_mm: 1.65, clr_mm: 50.8 };

    /// What a curve was made with.
    pub fn of(curve: &Curve) -> Stock {
        Stock { od_mm: curve.od_mm, wall_mm: curve.wall_mm, clr_mm: curve.clr_mm }
    }
}

/// A part; of this developed length where one is given.
pub fn part(material: &Material, stock: Stock, length_mm: Option<f64>, seed: u64) -> Nominal {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xbe4d);
    let bend = |_| Bend {
        length_mm: rng.random_range(60.0..300.0),
        rotation_rad: rng.random_range(-180.0..180.0) * DEGREE,
        angle_rad: rng.random_range(15.0..120.0) * DEGREE,
        radius_mm: stock.clr_mm,
    };
    let mut lra = Lra { bends: (0..BENDS).map(bend).collect(), last_length_mm: 150.0 };
    if let Some(length_mm) = length_mm {
        let arcs: f64 = lra.bends.iter().map(|b| b.radius_mm * b.angle_rad).sum();
        let stretch = (length_mm - arcs) / (lra.developed_length_mm() - arcs);
        lra.bends.iter_mut().for_each(|b| b.length_mm *= stretch);
        lra.last_length_mm *= stretch;
    }
    let tolerance = Tolerance {
        envelope_mm: 1.0,
        angle_rad: 0.5 * DEGREE,
        rotation_rad: 0.5 * DEGREE,
        length_mm: 0.8,
        alignment: Alignment::BestFit,
    };
    let (material, name) = (material.clone(), format!("random-{seed}"));
    let Stock { od_mm, wall_mm, clr_mm } = stock;
    Nominal { name, od_mm, wall_mm, material, die_clr_mm: clr_mm, lra, tolerance }
}

/// Another part of the same tube on the same die, with as many bends: what may lie on the same bench.
pub fn other(part: &Nominal, seed: u64) -> Nominal {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x07e4);
    let mut out = part.clone();
    for bend in &mut out.lra.bends {
        bend.length_mm = rng.random_range(60.0..300.0);
        bend.rotation_rad = rng.random_range(-180.0..180.0) * DEGREE;
        bend.angle_rad = rng.random_range(15.0..120.0) * DEGREE;
    }
    out
}
