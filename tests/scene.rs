//! What a user relies on when the scan shows more than one tube and nothing else: tables and V-blocks are taken out,
//! of several tubes the largest is taken or the nominal's, and what is no tube is refused with the reason.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::f64::consts::TAU;
use std::path::Path;
use std::time::{Duration, Instant};

use benderd::cloud::PointCloud;
use benderd::config::{Materials, load_part};
use benderd::recognize::find_planes;
use benderd::reconstruct::moderate::moderate;
use benderd::reconstruct::scene::{Scene, look};
use benderd::reconstruct::{ReconstructError, crust};
use benderd::sim::population::random_tube;
use benderd::sim::scan::{Density, PointKind, ScanSettings, SimulatedScan, TubeShape, scan};
use benderd::tube::{Bend, Lra, Nominal, Spine};
use nalgebra::{Point3, Vector3};

fn nominal() -> Nominal {
    load_part(Path::new("config/parts/bracket-17.toml"), &Materials::shipped().unwrap()).unwrap()
}

fn bracket(points: usize, seed: u64) -> SimulatedScan {
    let part = nominal();
    let settings = ScanSettings { density: Density::Points(points), ..ScanSettings::default() };
    scan(&TubeShape::round(part.lra, part.od_mm), &settings, seed)
}

/// Two legs and a bend.
fn elbow(od_mm: f64, leg_mm: f64, seed: u64) -> SimulatedScan {
    let bend = Bend { length_mm: leg_mm, rotation_rad: 0.0, angle_rad: 1.2, radius_mm: 2.0 * od_mm };
    let lra = Lra { bends: vec![bend], last_length_mm: 0.7 * leg_mm };
    let settings = ScanSettings { density: Density::Points(5_000), ..ScanSettings::default() };
    scan(&TubeShape::round(lra, od_mm), &settings, seed)
}

fn cloud(points: &[Point3<f64>]) -> PointCloud {
    PointCloud::from_points(points)
}

/// Reproducible numbers from 0 to 1.
fn numbers(mut state: u64) -> impl FnMut() -> f64 {
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Largest distance of the polygon's vertices from the spine, and of the spine's places from the polygon.
fn distances(found: &Scene, spine: &Spine) -> (f64, f64) {
    let fine = spine.sampled(0.02 * found.radius_mm);
    let from_spine = |p: &Point3<f64>| fine.iter().map(|q| (p - q).norm()).fold(f64::INFINITY, f64::min);
    let from_polygon = |p: &Point3<f64>| {
        let edge = |w: &[Point3<f64>]| {
            let along = w[1] - w[0];
            let share = ((p - w[0]).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
            (w[0] + along * share - p).norm()
        };
        found.polygon.windows(2).map(edge).fold(f64::INFINITY, f64::min)
    };
    let off = found.polygon.iter().map(from_spine).fold(0.0, f64::max);
    let missed = spine.sampled(0.5 * found.radius_mm).iter().map(from_polygon).fold(0.0, f64::max);
    (off, missed)
}

/// Every vertex within 0.2 tube radii of the true spine, nine in ten within 0.05; of the spine at most the last
/// radius at an end is not covered; no plane is seen on a tube.
#[test]
fn the_polygon_follows_the_spine_of_the_population() {
    for seed in 0..12 {
        let tube = random_tube(seed);
        let scan = scan(&tube.shape, &tube.settings, seed);
        let found = look(&scan.cloud(), None).unwrap();
        let r = found.radius_mm;
        assert!((2.0 * r / tube.shape.od_mm - 1.0).abs() < 0.01, "seed {seed}: radius {r}");
        let (off, missed) = distances(&found, &scan.spine);
        assert!(off < 0.2 * r && missed < r, "seed {seed}: off {off}, missed {missed} of radius {r}");
        let fine = scan.spine.sampled(0.02 * r);
        let near = |p: &&Point3<f64>| fine.iter().any(|q| (*p - q).norm() < 0.05 * r);
        let share = found.polygon.iter().filter(near).count() as f64 / found.polygon.len() as f64;
        assert!(share > 0.9, "seed {seed}: {share}");
        assert!(found.faces.is_empty() && found.warnings.is_empty() && found.own.is_none(), "seed {seed}");
    }
}

#[test]
fn no_plane_is_seen_on_a_tube_of_any_radius() {
    for seed in 0..60 {
        let tube = random_tube(seed);
        let whole = moderate(&scan(&tube.shape, &tube.settings, seed).cloud());
        let points: Vec<Point3<f64>> = whole.cloud.iter().collect();
        assert!(find_planes(&points, whole.spacing_mm).is_empty(), "seed {seed}");
    }
}

#[test]
fn a_table_and_v_blocks_are_taken_out_and_the_tubes_points_are_told() {
    for (seed, views) in [(0, 1), (2, 3), (9, 1), (10, 2)] {
        let tube = random_tube(seed);
        let settings = ScanSettings { views, table: true, v_blocks: true, ..tube.settings };
        let scan = scan(&tube.shape, &settings, seed);
        let found = look(&scan.cloud(), None).unwrap();
        let (off, missed) = distances(&found, &scan.spine);
        let r = found.radius_mm;
        // Beside a V-block its flanks pull at the cylinders.
        assert!(off < 0.25 * r && missed < r, "seed {seed}: off {off}, missed {missed} of radius {r}");
        assert!(!found.faces.is_empty());
        let own = found.own.unwrap();
        let of = |kind| own.iter().filter(|&&i| scan.kinds[i as usize] == kind).count();
        assert!(of(PointKind::Tube) as f64 > 0.99 * scan.count(PointKind::Tube) as f64, "seed {seed}");
        let others = scan.count(PointKind::Surroundings) as f64;
        assert!((of(PointKind::Surroundings) as f64) < 0.1 * others, "seed {seed}");
    }
}

/// Nineteen points in twenty are the table's, which the tube touches all along.
#[test]
fn a_thin_tube_on_a_large_table() {
    let tube = elbow(6.0, 90.0, 3);
    let mut next = numbers(5);
    let frame = tube.spine.frame_at(0.0);
    let normal = frame.rotation * Vector3::z();
    let lowest = tube.points.iter().map(|p| p.coords.dot(&normal)).fold(f64::INFINITY, f64::min);
    let middle = tube.spine.point_at(60.0);
    let corner = middle - normal * (middle.coords.dot(&normal) - lowest);
    let mut points = tube.points.clone();
    for _ in 0..19 * tube.points.len() {
        let (x, y, z) = (next() - 0.5, next() - 0.5, next() - 0.5);
        points.push(corner + frame.rotation * Vector3::new(500.0 * x, 500.0 * y, 0.06 * z));
    }
    let found = look(&cloud(&points), None).unwrap();
    assert!((found.radius_mm - 3.0).abs() < 0.03, "{}", found.radius_mm);
    assert_eq!(found.faces.len(), 1);
    assert!(found.faces[0].normal.cross(&normal).norm() < 1e-3);
    let (off, missed) = distances(&found, &tube.spine);
    assert!(off < 0.6 && missed < 3.0, "off {off}, missed {missed}");
}

#[test]
fn of_several_tubes_the_largest_is_taken_or_the_nominals() {
    let (large, part) = (elbow(40.0, 300.0, 1), bracket(8_000, 2));
    let mut points = large.points.clone();
    points.extend(part.points.iter().map(|p| p + Vector3::new(0.0, 0.0, 2_000.0)));
    let free = look(&cloud(&points), None).unwrap();
    assert!((free.radius_mm - 20.0).abs() < 0.2, "{}", free.radius_mm);
    assert!(free.warnings.len() == 1 && free.warnings[0].contains("2 separate tubes"), "{:?}", free.warnings);
    let own = free.own.unwrap();
    assert!(
        own.iter().all(|&i| (i as usize) < large.points.len()),
        "the other tube's points are not its own"
    );
    let guided = look(&cloud(&points), Some(&nominal())).unwrap();
    assert!((guided.radius_mm - 12.7).abs() < 0.13, "{}", guided.radius_mm);
    assert!(guided.warnings[0].contains("most like the nominal"), "{:?}", guided.warnings);
}

#[test]
fn what_is_no_tube_is_refused() {
    let mut next = numbers(1);
    let mut any = |n: usize, f: &dyn Fn(f64, f64, f64) -> Point3<f64>| -> PointCloud {
        cloud(&(0..n).map(|_| f(next(), next(), next())).collect::<Vec<_>>())
    };
    let noise = any(20_000, &|x, y, z| Point3::new(x, y, z) * 100.0);
    let boxed = any(20_000, &|x, y, z| {
        let (u, v, face) = (100.0 * x, 60.0 * y, (z * 6.0) as i32);
        match face {
            0 => Point3::new(u, v, 0.0),
            1 => Point3::new(u, v, 80.0),
            2 => Point3::new(u, 0.0, v * 80.0 / 60.0),
            3 => Point3::new(u, 60.0, v * 80.0 / 60.0),
            4 => Point3::new(0.0, v, u * 0.8),
            _ => Point3::new(100.0, v, u * 0.8),
        }
    });
    let ball = any(20_000, &|x, y, _| {
        let (height, turn) = (2.0 * x - 1.0, TAU * y);
        let ring = (1.0 - height * height).sqrt();
        Point3::new(ring * turn.cos(), ring * turn.sin(), height) * 40.0
    });
    for (name, cloud) in [("noise", noise), ("box", boxed), ("ball", ball)] {
        let found = look(&cloud, None);
        assert!(
            matches!(found, Err(ReconstructError::NoTube { .. })),
            "{name}: {:?}",
            found.map(|f| f.radius_mm)
        );
    }
}

#[test]
fn a_ring_has_no_ends() {
    let mut next = numbers(2);
    let at = |turn: f64, around: f64| {
        let ring = 100.0 + 10.0 * around.cos();
        Point3::new(ring * turn.cos(), ring * turn.sin(), 10.0 * around.sin())
    };
    let points: Vec<Point3<f64>> = (0..20_000).map(|_| at(TAU * next(), TAU * next())).collect();
    let found = look(&cloud(&points), None);
    assert!(matches!(found, Err(ReconstructError::Ring { .. })), "{:?}", found.map(|f| f.polygon.len()));
}

/// Five hundred points on the bracket lie 0.6 tube radii apart: too few, and the error says so.
#[test]
fn a_cloud_of_five_hundred_points_works_or_says_what_is_missing() {
    for seed in 0..5 {
        match look(&bracket(500, seed).cloud(), None) {
            Ok(found) => assert!((found.radius_mm - 12.7).abs() < 0.3, "{}", found.radius_mm),
            Err(error) => assert!(error.to_string().contains("dense"), "{error}"),
        }
    }
}

/// Pieces of tube in any place, as a box of bolts: many, none better than another.
#[test]
fn a_box_of_pieces_ends_soon_with_a_reason() {
    let mut next = numbers(3);
    let mut points = Vec::new();
    for _ in 0..120 {
        let at = Point3::new(next(), next(), next()) * 600.0;
        let axis = Vector3::new(next() - 0.5, next() - 0.5, next() - 0.5).normalize();
        let u = axis.cross(&Vector3::new(0.3, 0.5, 0.8)).normalize();
        let v = axis.cross(&u);
        for _ in 0..600 {
            let (along, turn) = (40.0 * next(), TAU * next());
            points.push(at + axis * along + (u * turn.cos() + v * turn.sin()) * 5.0);
        }
    }
    let started = Instant::now();
    let found = look(&cloud(&points), None);
    assert!(started.elapsed() < Duration::from_secs(20), "{:?}", started.elapsed());
    let said = matches!(found, Err(ReconstructError::SeveralTubes { .. } | ReconstructError::NoTube { .. }));
    assert!(said, "{:?}", found.map(|f| f.polygon.len()));
}

#[test]
fn thousands_of_pieces_are_joined_in_little_time() {
    use benderd::reconstruct::mls::SpinePoint;
    let mut next = numbers(4);
    let mut any = || {
        let tangent = Vector3::new(next() - 0.5, next() - 0.5, next() - 0.5).normalize();
        SpinePoint { point: Point3::new(next(), next(), next()) * 300.0, tangent, rms_mm: 0.0 }
    };
    let points: Vec<SpinePoint> = (0..5_000).map(|_| any()).collect();
    let started = Instant::now();
    let chains = crust::connect(&points, 3.0, 10.0);
    assert!(started.elapsed() < Duration::from_secs(20), "{:?}", started.elapsed());
    assert_eq!(chains.iter().map(Vec::len).sum::<usize>(), points.len(), "every point is in one chain");
}
