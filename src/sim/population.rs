//! Random tubes: a population to measure the reconstruction on, after paper 000's benchmark (section 8), with
//! the cases added on which methods break: shallow bends, bends beyond 180 degrees, bend on bend, mixed radii.
//!
//! Left out is what no data could tell: two bends in one plane the same way, or a shallow bend and its neighbour,
//! have a straight of a diameter between them; and every tube can be seen whole from the side it is scanned from.
//! [`random_scene`] spoils such scans in every way.

mod hard;

use std::f64::consts::PI;

use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::scan::{Density, ScanSettings, TubeShape};
use crate::tube::{Bend, Frame, Lra, Spine};

pub use hard::{Scene, random_scene};

/// One member of the population: the tube and how it is scanned.
#[derive(Debug, Clone, PartialEq)]
pub struct Specimen {
    /// The tube.
    pub shape: TubeShape,
    /// A single pass whose point spacing is 0.06 to 0.15 tube radii (3 000 to 60 000 points).
    pub settings: ScanSettings,
    /// Whether all bends have the same centre-line radius.
    pub common_clr: bool,
}

/// Draws one tube: radius 2 to 50 mm, 1 to 15 bends, CLR 1.5 to 4 diameters, no longer than 3 m, nowhere
/// touching itself. The same seed gives the same tube.
pub fn random_tube(seed: u64) -> Specimen {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let radius_mm = log_uniform(&mut rng, 2.0, 50.0);
    let common_clr = rng.random_bool(0.75);
    let mut bends = rng.random_range(1..=15);
    let (lra, sight) = loop {
        let tries = (0..100).map(|_| random_lra(&mut rng, 2.0 * radius_mm, bends, common_clr));
        let seen = |lra: Lra| is_possible(&lra, radius_mm).then(|| Some((best_sight(&lra, radius_mm)?, lra)));
        if let Some((sight, lra)) = { tries }.find_map(|lra| seen(lra).flatten()) {
            break (lra, sight);
        }
        // So many bends do not fit into 3 m at this diameter.
        bends = (bends - 1).max(1);
    };
    let oval = rng.random_bool(0.5);
    let ovality = lra.bends.iter().map(|_| if oval { rng.random_range(0.0..0.06) } else { 0.0 }).collect();
    let spacing_mm = radius_mm * log_uniform(&mut rng, 0.06, 0.15);
    let points = (2.0 * radius_mm * lra.developed_length_mm() / (spacing_mm * spacing_mm)) as usize;
    let density = Density::Points(points.clamp(3_000, 60_000));
    let settings = ScanSettings { density, sight: Some(sight), ..ScanSettings::default() };
    let shape = TubeShape { ovality, ..TubeShape::round(lra, 2.0 * radius_mm) };
    Specimen { shape, settings, common_clr }
}

/// The tube of [`random_tube`] as bends without a mandrel come out: every section oval by up to 6 %, every outer wall flattened
/// by up to 1 % of the diameter, each bend its own way; scanned the same way.
pub fn flattened_tube(seed: u64) -> Specimen {
    let specimen = random_tube(seed);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(2);
    let mut drawn =
        |most: f64| specimen.shape.lra.bends.iter().map(|_| rng.random_range(0.0..most)).collect();
    let (ovality, flattening) = (drawn(0.06), drawn(0.01));
    Specimen { shape: TubeShape { ovality, flattening, ..specimen.shape.clone() }, ..specimen }
}

/// The tube of paper 000's Results (section 8), as far as it is described there: radius 4 mm, 268 mm long, 5 bends, 6005
/// points.
pub fn papers_tube() -> Specimen {
    let bend = |length_mm, rotation_deg: f64, angle_deg: f64| Bend {
        length_mm,
        rotation_rad: rotation_deg.to_radians(),
        angle_rad: angle_deg.to_radians(),
        radius_mm: 15.0,
    };
    let bends = vec![
        bend(30.0, 0.0, 60.0),
        bend(25.0, 90.0, 45.0),
        bend(30.0, -60.0, 4.0),
        bend(25.0, 120.0, 90.0),
        bend(20.0, 180.0, 70.0),
    ];
    let mut lra = Lra { bends, last_length_mm: 0.0 };
    lra.last_length_mm = 268.0 - lra.developed_length_mm();
    let settings = ScanSettings { density: Density::Points(6005), ..ScanSettings::default() };
    Specimen { shape: TubeShape::round(lra, 8.0), settings, common_clr: true }
}

fn log_uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    rng.random_range(low.ln()..high.ln()).exp()
}

fn random_lra(rng: &mut ChaCha8Rng, od_mm: f64, bends: usize, common_clr: bool) -> Lra {
    let clr = |rng: &mut ChaCha8Rng| od_mm * rng.random_range(1.5..4.0);
    let common = clr(rng);
    let mut rows = Vec::with_capacity(bends);
    for i in 0..bends {
        let radius_mm = if common_clr { common } else { clr(rng) };
        let rotation_rad = if i == 0 { 0.0 } else { random_rotation(rng) };
        let on_bend = i > 0 && rng.random_bool(0.05);
        let length_mm = match i {
            0 => log_uniform(rng, od_mm, 15.0 * od_mm),
            // Two bends on each other in one plane would be one bend.
            _ if on_bend && rotation_rad.abs() > 0.3 => 0.0,
            _ => log_uniform(rng, 0.1 * od_mm, 10.0 * od_mm),
        };
        rows.push(Bend { length_mm, rotation_rad, angle_rad: random_angle(rng), radius_mm });
    }
    for i in 1..rows.len() {
        let shallow = rows[i - 1].angle_rad.min(rows[i].angle_rad) < SHALLOW_RAD;
        if shallow || rows[i].rotation_rad.abs() < 0.3 {
            rows[i].length_mm = rows[i].length_mm.max(od_mm);
        }
    }
    Lra { bends: rows, last_length_mm: log_uniform(rng, od_mm, 15.0 * od_mm) }
}

/// Bends below this cannot be told from a neighbour that they touch.
const SHALLOW_RAD: f64 = 0.1;

/// Sides from which a tube is looked at before one is chosen.
const SIDES: usize = 60;

/// The direction of sight from which the least is hidden; None when a stretch of a diameter is hidden from everywhere.
fn best_sight(lra: &Lra, radius_mm: f64) -> Option<Vector3<f64>> {
    let spine = Spine::from_lra(lra, Frame::identity());
    let step = radius_mm / 2.0;
    let count = (spine.length_mm() / step) as usize;
    let frames: Vec<Frame> = (0..=count).map(|i| spine.frame_at(i as f64 * step)).collect();
    let sides = (0..SIDES).map(|k| {
        // Points of a Fibonacci spiral on the sphere.
        let height = 1.0 - 2.0 * (k as f64 + 0.5) / SIDES as f64;
        let turn = k as f64 * PI * (3.0 - 5f64.sqrt());
        let ring = (1.0 - height * height).sqrt();
        Vector3::new(ring * turn.cos(), ring * turn.sin(), height)
    });
    let hidden = sides.map(|sight| (longest_hidden(&frames, &sight, radius_mm), sight));
    let (run, sight) = hidden.min_by_key(|(run, _)| *run)?;
    (run as f64 * step <= 2.0 * radius_mm).then_some(sight)
}

/// Longest run of places that another part of the tube covers or that are seen end on.
fn longest_hidden(frames: &[Frame], sight: &Vector3<f64>, radius_mm: f64) -> usize {
    let covered = |p: &Frame| {
        let tangent = p.rotation * Vector3::x();
        let covers = |q: &Frame| {
            let from = q.translation.vector - p.translation.vector;
            let towards_eye = -from.dot(sight);
            towards_eye > radius_mm && (from + sight * towards_eye).norm() < 1.5 * radius_mm
        };
        tangent.dot(sight).abs() > 0.95 || frames.iter().any(covers)
    };
    let (mut longest, mut run) = (0, 0);
    for p in frames {
        run = if covered(p) { run + 1 } else { 0 };
        longest = longest.max(run);
    }
    longest
}

/// Mostly 15 to 120 degrees; one in eight 1 to 5, one in sixteen beyond 180.
fn random_angle(rng: &mut ChaCha8Rng) -> f64 {
    let degrees: f64 = match rng.random_range(0..16) {
        0 | 1 => rng.random_range(1.0..5.0),
        2 => rng.random_range(180.0..300.0),
        _ => rng.random_range(15.0..120.0),
    };
    degrees.to_radians()
}

/// Any, with two in five in the plane of the bend before or square to it.
fn random_rotation(rng: &mut ChaCha8Rng) -> f64 {
    match rng.random_range(0..10) {
        0 => 0.0,
        1 => PI,
        2 => PI / 2.0,
        3 => -PI / 2.0,
        _ => rng.random_range(-PI..PI),
    }
}

/// Long enough to be scanned, short enough for the bender, and clear of itself.
fn is_possible(lra: &Lra, radius_mm: f64) -> bool {
    (50.0..=3000.0).contains(&lra.developed_length_mm()) && !touches_itself(lra, radius_mm)
}

/// Whether the spine comes closer to itself than 2.2 tube radii, neighbours along it apart.
fn touches_itself(lra: &Lra, radius_mm: f64) -> bool {
    let spine = Spine::from_lra(lra, Frame::identity());
    let step = radius_mm / 2.0;
    let count = (spine.length_mm() / step) as usize;
    let points: Vec<_> = (0..=count).map(|i| spine.point_at(i as f64 * step)).collect();
    // On the tightest bend (CLR 3 radii) the chord of 3 radii of arc is 2.9 radii: no false alarm.
    let neighbours = 6;
    points
        .iter()
        .enumerate()
        .any(|(i, p)| points.iter().skip(i + neighbours + 1).any(|q| (p - q).norm() < 2.2 * radius_mm))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_population_is_as_described() {
        let all: Vec<_> = (0..100).map(random_tube).collect();
        for specimen in &all {
            let TubeShape { lra, od_mm, .. } = &specimen.shape;
            assert!(lra.validate().is_ok());
            assert!((4.0..=100.0).contains(od_mm) && (1..=15).contains(&lra.bends.len()));
            assert!((50.0..=3000.0).contains(&lra.developed_length_mm()));
            assert!(lra.bends.iter().all(|b| (1.5..4.0).contains(&(b.radius_mm / od_mm))));
            assert!(!touches_itself(lra, od_mm / 2.0));
        }
        let bends = || all.iter().flat_map(|s| s.shape.lra.bends.iter());
        let share = |n: usize| n as f64 / bends().count() as f64;
        assert!(share(bends().filter(|b| b.angle_rad < 0.1).count()) > 0.05, "shallow bends");
        assert!(share(bends().filter(|b| b.angle_rad > PI).count()) > 0.01, "bends beyond 180 degrees");
        assert!(bends().filter(|b| b.length_mm == 0.0).count() > 3, "bend on bend");
        assert!(all.iter().filter(|s| s.shape.lra.bends.len() > 8).count() > 10, "many bends");
        let small = all.iter().filter(|s| s.shape.od_mm < 10.0).count();
        let large = all.iter().filter(|s| s.shape.od_mm > 40.0).count();
        assert!(small > 10 && large > 10, "{small} small, {large} large");
    }

    #[test]
    fn a_seed_is_a_tube() {
        assert_eq!(random_tube(7), random_tube(7));
        assert_ne!(random_tube(7), random_tube(8));
    }

    #[test]
    fn a_loop_touches_itself() {
        let ring = |angle: f64, rotation: f64| {
            let bend =
                |length_mm, rotation_rad| Bend { length_mm, rotation_rad, angle_rad: angle, radius_mm: 30.0 };
            Lra { bends: vec![bend(100.0, 0.0), bend(0.0, rotation)], last_length_mm: 100.0 }
        };
        assert!(touches_itself(&ring(PI, 0.0), 10.0));
        assert!(!touches_itself(&ring(PI / 2.0, 0.0), 10.0));
    }
}
