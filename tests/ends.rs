//! The ends of simulated tubes, measured by the whole reconstruction: how far off, and how honest about it.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use benderd::reconstruct::{Options, Reconstruction, reconstruct};
use benderd::sim::scan::{Burr, Density, EndShape, ScanSettings, SimulatedScan, TubeShape, scan};
use benderd::tube::{Bend, Lra};
use nalgebra::Point3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// One bend between straights of 60 to 150 mm.
fn tube(rng: &mut ChaCha8Rng) -> TubeShape {
    let angle_rad = rng.random_range(0.6..1.8);
    let bend =
        Bend { length_mm: rng.random_range(60.0..150.0), rotation_rad: 0.0, angle_rad, radius_mm: 40.0 };
    let lra = Lra { bends: vec![bend], last_length_mm: rng.random_range(60.0..150.0) };
    let mut end = || {
        let cut_rad = rng.random_range(0.0..5f64).to_radians();
        let burr = Burr { height_mm: 0.2, from_rad: rng.random_range(0.0..6.0), over_rad: 0.8 };
        EndShape {
            cut_rad,
            longest_rad: rng.random_range(0.0..6.0),
            burr: rng.random_bool(0.3).then_some(burr),
        }
    };
    let ends = [end(), end()];
    let wall_mm = if rng.random_bool(0.5) { 1.5 } else { 0.0 };
    TubeShape { wall_mm, ends, ..TubeShape::round(lra, 20.0) }
}

fn measure(scanned: &SimulatedScan) -> Reconstruction {
    reconstruct(&scanned.cloud(), &Options::default()).unwrap()
}

/// (error, sigma) of both end straights; the scan may be read from either end.
fn length_errors(found: &Reconstruction, truth: &Lra) -> [(f64, f64); 2] {
    let m = &found.measured;
    let values = [
        (m.bends[0].length_mm.unwrap(), m.bends[0].length_sigma_mm.unwrap()),
        (m.last_length_mm.unwrap(), m.last_length_sigma_mm.unwrap()),
    ];
    let wanted = [truth.bends[0].length_mm, truth.last_length_mm];
    let pairs = |order: [usize; 2]| [0, 1].map(|k| (values[k].0 - wanted[order[k]], values[k].1));
    let off = |pairs: &[(f64, f64); 2]| pairs[0].0.abs() + pairs[1].0.abs();
    let (forward, backward) = (pairs([0, 1]), pairs([1, 0]));
    if off(&forward) < off(&backward) { forward } else { backward }
}

#[test]
fn two_thirds_of_the_lengths_lie_within_one_sigma() {
    let mut within = [0; 2];
    let mut sum = 0.0;
    let tubes = 30;
    for seed in 0..tubes {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let shape = tube(&mut rng);
        let settings = ScanSettings {
            density: Density::Points(rng.random_range(4_000..20_000)),
            views: rng.random_range(1..=4),
            noise_mm: rng.random_range(0.01..0.08),
            ..ScanSettings::default()
        };
        for (error, sigma) in length_errors(&measure(&scan(&shape, &settings, seed)), &shape.lra) {
            within[0] += u32::from(error.abs() < sigma);
            within[1] += u32::from(error.abs() < 2.0 * sigma);
            sum += error / sigma;
        }
    }
    // Binomial of 60: 68 % is 41 +- 3.6, 95.5 % is 57 +- 1.6; the mean is 0 +- 0.13.
    assert!((30..=52).contains(&within[0]) && within[1] >= 52, "{within:?}");
    assert!((sum / (2.0 * tubes as f64)).abs() < 0.5, "{sum}");
}

#[test]
fn a_straight_that_runs_out_of_the_scan_is_not_given_a_length() {
    let lra = Lra {
        bends: vec![Bend { length_mm: 120.0, rotation_rad: 0.0, angle_rad: 1.2, radius_mm: 40.0 }],
        last_length_mm: 80.0,
    };
    let settings = ScanSettings { random_pose: false, views: 3, ..ScanSettings::default() };
    let mut scanned = scan(&TubeShape::round(lra, 20.0), &settings, 7);
    // The scan's window, 30 degrees off the tube's section, 40 mm from the first end.
    let window = |p: &Point3<f64>| p.x > 40.0 + 0.577 * p.y || p.y > 30.0;
    scanned.points.retain(window);
    let measured = measure(&scanned).measured;
    let lengths = [measured.bends[0].length_mm, measured.last_length_mm];
    let known: Vec<f64> = lengths.iter().flatten().copied().collect();
    assert_eq!(known.len(), 1, "{lengths:?}");
    assert!((known[0] - 80.0).abs() < 0.5);
    let warning = measured.warnings.iter().find(|w| w.contains("the scan stops before the tube does"));
    let warning = warning.unwrap_or_else(|| panic!("{:?}", measured.warnings));
    let least = warning.split("at least ").nth(1).and_then(|w| w.split(' ').next()).unwrap();
    assert!((least.parse::<f64>().unwrap() - 80.0).abs() < 1.0, "{warning}");
}
