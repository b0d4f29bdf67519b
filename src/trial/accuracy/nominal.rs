//! Nominals for a simulated scan: the part as drawn before this tube sprang back, and wrong ones that a cell may be given
//! by mistake.

use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::sim::population::random_tube;
use crate::sim::scan::TubeShape;
use crate::tube::{Bend, Frame, Lra, Nominal, Spine};

/// Each angle springs back by this share of it, and is off by up to so much more either way.
const SPRINGBACK: std::ops::Range<f64> = 0.01..0.04;
const ANGLE_DEG: f64 = 0.3;

/// Rotations and lengths are off by up to this much either way.
const ROTATION_DEG: f64 = 0.2;
const LENGTH_MM: f64 = 0.5;

/// A nominal's bend has at least this angle.
const LEAST_ANGLE_DEG: f64 = 0.1;

/// A tube whose straights all point less than this out of one plane is its own mirror image.
const FLAT_DEG: f64 = 10.0;

/// The bend that a nominal has and the tube lacks: its angle; a straight of a diameter is left on either side, or it might
/// be its neighbour's.
const ADDED_DEG: std::ops::Range<f64> = 20.0..90.0;
const LEAST_ADDED_DEG: f64 = 10.0;

/// A part as drawn, and whether it is drawn from the other end than the simulated tube.
#[derive(Debug, Clone)]
pub struct Drawn {
    /// The part.
    pub nominal: Nominal,
    /// Drawn from the tube's last end.
    pub reversed: bool,
}

/// In what a nominal is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wrong {
    /// The other hand.
    Mirrored,
    /// It has a bend that the tube lacks.
    BendMissing,
    /// It lacks a bend that the tube has.
    BendTooMany,
    /// It is another part, of a tube of the same diameter.
    OtherPart,
}

impl Wrong {
    /// All, in the order of the table.
    pub const ALL: [Wrong; 4] = [Wrong::Mirrored, Wrong::BendMissing, Wrong::BendTooMany, Wrong::OtherPart];

    /// In words, of the tube beside its nominal.
    pub fn name(self) -> &'static str {
        match self {
            Wrong::Mirrored => "mirror image",
            Wrong::BendMissing => "a bend missing",
            Wrong::BendTooMany => "a bend too many",
            Wrong::OtherPart => "another part",
        }
    }

    /// The words in the warning that says so.
    pub fn words(self) -> &'static str {
        match self {
            Wrong::Mirrored => "looks like the mirror image",
            Wrong::BendMissing => "of the nominal is missing",
            Wrong::BendTooMany => "a bend that the nominal lacks",
            Wrong::OtherPart => "another part",
        }
    }

    /// The right nominal made wrong; None where that is no other tube or cannot be.
    pub fn of(self, right: &Nominal, seed: u64) -> Option<Nominal> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed);
        let lra = match self {
            Wrong::Mirrored => is_handed(&right.lra).then(|| right.lra.mirrored()),
            Wrong::BendMissing => with_a_bend(right, &mut rng),
            Wrong::BendTooMany => without_a_bend(&right.lra, &mut rng),
            Wrong::OtherPart => Some(another(right.od_mm, seed + 1)),
        };
        lra.map(|lra| Nominal { lra, ..right.clone() })
    }
}

/// The part as drawn of which forming made this tube, from either end.
pub fn drawn(shape: &TubeShape, seed: u64) -> Drawn {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xd7a3);
    let mut off = |most: f64| rng.random_range(-most..most);
    let mut lra = shape.lra.clone();
    for bend in &mut lra.bends {
        bend.length_mm = (bend.length_mm + off(LENGTH_MM)).max(0.0);
        bend.rotation_rad += off(ROTATION_DEG.to_radians());
        bend.angle_rad += off(ANGLE_DEG.to_radians());
    }
    lra.last_length_mm = (lra.last_length_mm + off(LENGTH_MM)).max(0.0);
    for bend in &mut lra.bends {
        let angle_rad = bend.angle_rad / (1.0 - rng.random_range(SPRINGBACK));
        bend.angle_rad = angle_rad.max(LEAST_ANGLE_DEG.to_radians());
    }
    let reversed = rng.random_bool(0.5);
    let lra = if reversed { lra.reversed() } else { lra };
    Drawn { nominal: Nominal::of_table(lra, shape.od_mm, shape.wall_mm), reversed }
}

/// Whether the mirror image is another tube.
fn is_handed(lra: &Lra) -> bool {
    let spine = Spine::from_lra(lra, Frame::identity());
    let straights = spine.segments().iter().step_by(2);
    let directions = straights.map(|s| s.start.rotation * Vector3::x());
    let spread: Matrix3<f64> = directions.map(|d| d * d.transpose()).sum();
    let out_of_plane = spread.symmetric_eigenvalues().min().max(0.0).sqrt();
    out_of_plane > FLAT_DEG.to_radians().sin()
}

/// With one bend more in its longest inner straight, or last one; None where that is too short for a bend.
fn with_a_bend(part: &Nominal, rng: &mut ChaCha8Rng) -> Option<Lra> {
    let lra = &part.lra;
    let n = lra.bends.len();
    let inner = (1..n).max_by(|a, b| lra.bends[*a].length_mm.total_cmp(&lra.bends[*b].length_mm));
    let at = inner.unwrap_or(n);
    let straight_mm = lra.bends.get(at).map_or(lra.last_length_mm, |b| b.length_mm);
    let radius_mm = lra.bends.first()?.radius_mm;
    let most_rad = (straight_mm - 2.0 * part.od_mm) / radius_mm;
    let angle_rad = rng.random_range(ADDED_DEG).to_radians().min(most_rad);
    if angle_rad < LEAST_ADDED_DEG.to_radians() {
        return None;
    }
    let rest_mm = straight_mm - radius_mm * angle_rad;
    let length_mm = part.od_mm + rng.random_range(0.0..1.0) * (rest_mm - 2.0 * part.od_mm);
    let rotation_rad = rng.random_range(-3.0..3.0);
    let mut out = lra.clone();
    match out.bends.get_mut(at) {
        Some(next) => {
            next.length_mm = rest_mm - length_mm;
            next.rotation_rad -= rotation_rad;
        }
        None => out.last_length_mm = rest_mm - length_mm,
    }
    out.bends.insert(at, Bend { length_mm, rotation_rad, angle_rad, radius_mm });
    Some(out)
}

/// With one bend left straight; None where it is the only one.
fn without_a_bend(lra: &Lra, rng: &mut ChaCha8Rng) -> Option<Lra> {
    let n = lra.bends.len();
    let at = rng.random_range(0..n.max(1));
    let mut out = lra.clone();
    let gone = out.bends.get_mut(at).filter(|_| n > 1)?;
    gone.length_mm += gone.radius_mm * gone.angle_rad;
    gone.angle_rad = 0.0;
    Some(out.merged())
}

/// The table of another part, scaled to this diameter: otherwise the diameter alone would tell.
fn another(od_mm: f64, seed: u64) -> Lra {
    let other = random_tube(seed).shape;
    let scale = od_mm / other.od_mm;
    let mut lra = other.lra;
    for bend in &mut lra.bends {
        bend.length_mm *= scale;
        bend.radius_mm *= scale;
    }
    lra.last_length_mm *= scale;
    lra
}
