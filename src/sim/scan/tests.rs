//! The simulated scan against what can be said about it without ray casting.

use super::*;
use crate::tube::Bend;

fn bend(length_mm: f64, rotation_deg: f64, angle_deg: f64, radius_mm: f64) -> Bend {
    let (rotation_rad, angle_rad) = (rotation_deg.to_radians(), angle_deg.to_radians());
    Bend { length_mm, rotation_rad, angle_rad, radius_mm }
}

/// Two bends in two planes.
fn bracket(scale: f64) -> TubeShape {
    let bends =
        vec![bend(100.0 * scale, 0.0, 90.0, 50.0 * scale), bend(80.0 * scale, 70.0, 200.0, 40.0 * scale)];
    TubeShape::round(Lra { bends, last_length_mm: 120.0 * scale }, 25.0 * scale)
}

/// A hairpin in the x-y plane: legs at y = 0 and y = 100.
fn hairpin() -> TubeShape {
    TubeShape::round(Lra { bends: vec![bend(200.0, 0.0, 180.0, 50.0)], last_length_mm: 200.0 }, 20.0)
}

/// No noise, no outliers, own coordinates.
fn clean(points: usize) -> ScanSettings {
    ScanSettings {
        density: Density::Points(points),
        noise_mm: 0.0,
        outlier_share: 0.0,
        random_pose: false,
        ..ScanSettings::default()
    }
}

#[test]
fn a_seed_is_a_scan_to_the_last_bit_whatever_the_number_of_threads() {
    let settings = ScanSettings {
        views: 2,
        missing_patches: 3,
        table: true,
        v_blocks: true,
        pass_drift_mm: 0.1,
        density: Density::Points(4000),
        ..ScanSettings::default()
    };
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let three = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    let a = one.install(|| scan(&bracket(1.0), &settings, 42));
    assert_eq!(a, three.install(|| scan(&bracket(1.0), &settings, 42)));
    assert_ne!(a.points, scan(&bracket(1.0), &settings, 43).points);
}

#[test]
fn without_noise_every_point_lies_exactly_on_the_tube() {
    for scale in [0.08, 1.0, 4.0] {
        let shape = bracket(scale);
        let settings = ScanSettings { random_pose: true, views: 3, ..clean(3000) };
        let got = scan(&shape, &settings, 1);
        assert!(got.points.len() > 1500, "{}", got.points.len());
        for p in &got.points {
            let off = got.spine.closest(p).distance_mm - shape.od_mm / 2.0;
            assert!(off.abs() < 1e-6, "{off} mm off at {p}, scale {scale}");
        }
    }
}

#[test]
fn the_wanted_number_of_points_is_about_met() {
    for wanted in [3000, 50_000] {
        let got = scan(&bracket(1.0), &clean(wanted), 1).points.len();
        assert!((0.7..1.2).contains(&(got as f64 / wanted as f64)), "{got} for {wanted}");
    }
    let steps = Density::Spacing { along_mm: 0.5, between_mm: 1.0 };
    let got = scan(&hairpin(), &ScanSettings { density: steps, ..clean(0) }, 1).points.len();
    // Silhouette of the hairpin: 20 mm times its length, less what is too grazing at both sides.
    let silhouette = 20.0 * (400.0 + 50.0 * std::f64::consts::PI) / 0.5;
    assert!((0.88..0.99).contains(&(got as f64 / silhouette)), "{got} of {silhouette}");
}

#[test]
fn only_the_side_towards_the_scanner_is_seen() {
    // Seen along -z; the hand wavers by up to 4 degrees, the limit of incidence is 78.
    let settings = ScanSettings { sight: Some(-Vector3::z()), ..clean(20_000) };
    let got = scan(&hairpin(), &settings, 5);
    let steepest =
        got.points.iter().map(|p| (p - got.spine.closest(p).point).z / 10.0).fold(f64::INFINITY, f64::min);
    let limit = (78f64 + 4.5).to_radians().cos();
    assert!(steepest > limit, "{steepest}");
    assert!(steepest < limit + 0.12, "seen up to near the limit: {steepest}");
}

#[test]
fn a_hairpin_seen_edge_on_hides_its_far_leg() {
    let far = |scan: &SimulatedScan| scan.points.iter().filter(|p| p.y > 80.0 && p.x < 190.0).count();
    let near = |scan: &SimulatedScan| scan.points.iter().filter(|p| p.y < 20.0 && p.x < 190.0).count();
    // Along +y the leg at y = 0 stands before the one at y = 100; wavering lets its rim peep out.
    let edge_on = scan(&hairpin(), &ScanSettings { sight: Some(Vector3::y()), ..clean(20_000) }, 5);
    assert!(near(&edge_on) > 2000);
    assert!(far(&edge_on) < near(&edge_on) / 3, "{} of {}", far(&edge_on), near(&edge_on));
    // Whatever is seen of it is not behind the near leg.
    for p in edge_on.points.iter().filter(|p| p.y > 80.0 && p.x < 190.0 && p.x > 10.0) {
        assert!(p.z.abs() > 2.0, "seen through the near leg: {p}");
    }
    let broad = scan(&hairpin(), &ScanSettings { sight: Some(Vector3::z()), ..clean(20_000) }, 5);
    assert!(far(&broad) as f64 > 0.9 * near(&broad) as f64);
}

#[test]
fn the_ends_are_cut_square_and_open() {
    let tube = TubeShape::round(Lra { bends: vec![], last_length_mm: 200.0 }, 20.0);
    // Slanting into the end at x = 0: neither cap nor inside may show.
    let sight = Some(Vector3::new(1.0, 0.0, -1.0));
    let got = scan(&tube, &ScanSettings { sight, ..clean(30_000) }, 5);
    let from = got.points.iter().map(|p| p.x).fold(f64::INFINITY, f64::min);
    let to = got.points.iter().map(|p| p.x).fold(f64::NEG_INFINITY, f64::max);
    assert!((0.0..0.5).contains(&from) && (199.5..=200.0).contains(&to), "{from} to {to}");
    assert!(got.points.iter().all(|p| (p.y.hypot(p.z) - 10.0).abs() < 1e-6));
    // Straight into the end: there is nothing to see.
    let into = scan(&tube, &ScanSettings { sight: Some(Vector3::x()), ..clean(3000) }, 5);
    assert!(into.points.len() < 30, "{}", into.points.len());
}

#[test]
fn noise_is_as_asked_at_normal_incidence_and_grows_towards_grazing() {
    let tube = TubeShape::round(Lra { bends: vec![], last_length_mm: 500.0 }, 50.0);
    let sight = Some(-Vector3::z());
    let settings = ScanSettings { sight, noise_mm: 0.05, ..clean(60_000) };
    let got = scan(&tube, &settings, 5);
    let spread = |low: f64, high: f64| {
        let along: Vec<f64> = got
            .points
            .iter()
            .filter_map(|p| {
                let sine = p.y / 25.0;
                let cosine = (1.0 - sine * sine).sqrt();
                // Off the surface, measured along the ray.
                (low..high).contains(&cosine).then(|| (p.y.hypot(p.z) - 25.0) / cosine)
            })
            .collect();
        assert!(along.len() > 1000);
        (along.iter().map(|v| v * v).sum::<f64>() / along.len() as f64).sqrt()
    };
    let (normal, grazing) = (spread(0.97, 1.0), spread(0.45, 0.55));
    assert!((normal / 0.05 - 1.0).abs() < 0.05, "{normal}");
    assert!((grazing / 0.1 - 1.0).abs() < 0.15, "{grazing}");
}

#[test]
fn outliers_come_in_the_share_asked_for_and_are_off_the_surface() {
    let settings = ScanSettings { outlier_share: 0.03, ..clean(40_000) };
    let got = scan(&bracket(1.0), &settings, 9);
    let share = got.count(PointKind::Outlier) as f64 / got.points.len() as f64;
    assert!((share - 0.03).abs() < 0.005, "{share}");
    let off = |p: &Point3<f64>| (got.spine.closest(p).distance_mm - 12.5).abs();
    for (p, kind) in got.points.iter().zip(&got.kinds) {
        assert_eq!(*kind == PointKind::Outlier, off(p) > 1e-6, "{kind:?} at {p}");
    }
    assert!(got.points.iter().any(|p| off(p) > 50.0), "some fly far");
}

#[test]
fn patches_leave_holes() {
    let whole = scan(&bracket(1.0), &clean(20_000), 9);
    let holed = scan(&bracket(1.0), &ScanSettings { missing_patches: 8, ..clean(20_000) }, 9);
    assert!(holed.points.len() < whole.points.len() * 98 / 100);
    assert!(holed.points.len() > whole.points.len() / 2);
}

#[test]
fn table_and_v_blocks_touch_the_tube_from_outside() {
    let settings = ScanSettings { table: true, v_blocks: true, sight: Some(-Vector3::z()), ..clean(20_000) };
    let got = scan(&hairpin(), &settings, 9);
    let around: Vec<_> =
        got.points.iter().zip(&got.kinds).filter(|(_, k)| **k == PointKind::Surroundings).collect();
    assert!(around.len() > 2000);
    let gap = |p: &Point3<f64>| got.spine.closest(p).distance_mm - 10.0;
    let closest = around.iter().map(|(p, _)| gap(p)).fold(f64::INFINITY, f64::min);
    assert!(closest > -1e-9, "nothing within the tube: {closest}");
    // The table lies 10 mm under the tube, the blocks' tops reach nearly to its middle.
    let table = around.iter().filter(|(p, _)| (p.z + 20.0).abs() < 1e-6).count();
    let tops = around.iter().filter(|(p, _)| (p.z + 2.0).abs() < 1e-6).count();
    assert!(table > 1000 && tops > 100, "{table} on the table, {tops} on blocks");
    assert_eq!(got.count(PointKind::Outlier), 0);
    // Without blocks the tube lies on the table.
    let flat = scan(&hairpin(), &ScanSettings { v_blocks: false, ..settings }, 9);
    let lowest = flat.points.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
    assert!((lowest + 10.0).abs() < 1e-6, "{lowest}");
}

#[test]
fn oval_bends_are_oval_in_the_middle_and_round_at_both_ends() {
    let mut shape = hairpin();
    shape.ovality = vec![0.1];
    let broad = ScanSettings { sight: Some(-Vector3::z()), ..clean(40_000) };
    let got = scan(&shape, &broad, 5);
    let mut top: f64 = 0.0;
    for p in &got.points {
        let closest = got.spine.closest(p);
        let along_bend = closest.arc_length_mm - 200.0;
        if (10.0..50.0 * std::f64::consts::PI - 10.0).contains(&along_bend) {
            // The ellipse: half axes 9.5 in the bend's plane, 10.5 across it.
            let outward = (p - closest.point).xy().norm();
            let ellipse = (outward / 9.5).powi(2) + (p.z / 10.5).powi(2);
            assert!((ellipse - 1.0).abs() < 1e-6, "{ellipse}");
            top = top.max(p.z);
        } else if along_bend < 0.0 || closest.segment == 2 {
            assert!((closest.distance_mm - 10.0).abs() < 1e-6);
        }
    }
    assert!(top > 10.49);
}

#[test]
fn passes_see_more_sides_and_drift_apart() {
    let tube = TubeShape::round(Lra { bends: vec![], last_length_mm: 300.0 }, 20.0);
    let settings = ScanSettings { views: 4, ..clean(20_000) };
    let got = scan(&tube, &settings, 5);
    for quarter in 0..4 {
        let turn = f64::from(quarter) * std::f64::consts::FRAC_PI_2;
        let towards = Vector3::new(0.0, turn.cos(), turn.sin());
        let seen = got.points.iter().filter(|p| p.coords.dot(&towards) > 9.0).count();
        assert!(seen > 1000, "{seen} points on side {quarter}");
    }
    let drifting = scan(&tube, &ScanSettings { pass_drift_mm: 0.2, ..settings }, 5);
    let worst = drifting.points.iter().map(|p| (p.y.hypot(p.z) - 10.0).abs()).fold(0.0, f64::max);
    assert!((0.05..2.0).contains(&worst), "{worst}");
}

#[test]
fn every_tube_of_the_population_scans() {
    for seed in 0..12 {
        let mut specimen = crate::sim::population::random_tube(seed);
        specimen.settings.noise_mm = 0.0;
        specimen.settings.outlier_share = 0.0;
        let Density::Points(wanted) = specimen.settings.density else { panic!("points expected") };
        let got = scan(&specimen.shape, &specimen.settings, seed);
        assert!(got.points.len() > wanted / 4, "seed {seed}: {} of {wanted}", got.points.len());
        let round = specimen.shape.ovality.iter().all(|o| *o == 0.0);
        let tolerance = if round { 1e-6 } else { 0.031 * specimen.shape.od_mm / 2.0 };
        for p in got.points.iter().step_by(37) {
            let off = got.spine.closest(p).distance_mm - specimen.shape.od_mm / 2.0;
            assert!(off.abs() < tolerance, "seed {seed}: {off}");
        }
    }
}

#[test]
fn a_cast_ray_meets_what_small_steps_along_it_meet() {
    let shape = bracket(1.0);
    let spine = Spine::from_lra(&shape.lra, Frame::identity());
    let solid = Solid::new(&shape, &spine);
    let all: Vec<usize> = (0..5).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut outside = 0;
    for _ in 0..400 {
        let target = spine.point_at(rng.random::<f64>() * spine.length_mm());
        let mut normal = || rng.sample::<f64, _>(StandardNormal);
        let direction = Vector3::new(normal(), normal(), normal()).normalize();
        let aside = Vector3::new(normal(), normal(), normal()) * 10.0;
        let ray = solid::Ray { origin: target + aside - direction * 500.0, direction };
        // Steps of 0.2 mm up to the first point within the tube (or the ball about an end).
        let inside = |t: &f64| spine.closest(&ray.at(*t)).distance_mm < 12.5;
        let met = (0..5000).map(|i| f64::from(i) * 0.2).find(inside);
        match solid.cast(&ray, &all, 1000.0) {
            solid::Cast::Outside { t, cosine } => {
                outside += 1;
                let p = ray.at(t);
                let closest = spine.closest(&p);
                assert!((closest.distance_mm - 12.5).abs() < 1e-9);
                let slope = (p - closest.point).dot(&ray.direction) / 12.5;
                assert!((slope + cosine).abs() < 1e-4, "{slope} {cosine}");
                // Only the ball beyond an open end may be passed through.
                let met = met.unwrap();
                let passed = spine.closest(&ray.at(met)).arc_length_mm;
                let through_end = passed == 0.0 || passed == spine.length_mm();
                assert!(through_end || (t <= met && met - t < 0.2 + 1e-9), "{t} but {met}");
            }
            solid::Cast::Miss => {
                let end = |t| [0.0, spine.length_mm()].contains(&spine.closest(&ray.at(t)).arc_length_mm);
                assert!(met.is_none_or(end), "missed at {met:?}");
            }
            solid::Cast::Blocked(_) => {}
        }
    }
    assert!(outside > 200, "{outside}");
}

#[test]
fn the_crown_of_the_tube_has_no_gaps() {
    for scale in [0.1, 1.0] {
        let shape = bracket(scale);
        let got = scan(&shape, &ScanSettings { views: 3, ..clean(40_000) }, 2);
        let bins = 200;
        let mut count = vec![0; bins + 1];
        for p in &got.points {
            let share = got.spine.closest(p).arc_length_mm / got.spine.length_mm();
            count[(share * bins as f64) as usize] += 1;
        }
        let least = count[..bins].iter().min().unwrap();
        assert!(*least > 60, "{least} points in a bin that should have about 200");
    }
}

#[test]
fn jaws_touch_the_tube_from_outside() {
    for jaws in [Jaws::Grip, Jaws::Flat] {
        let settings = ScanSettings { jaws: Some(jaws), sight: Some(-Vector3::z()), ..clean(40_000) };
        let got = scan(&hairpin(), &settings, 9);
        let jaw: Vec<_> =
            got.points.iter().zip(&got.kinds).filter(|(_, k)| **k == PointKind::Surroundings).collect();
        assert!(jaw.len() > 300, "{jaws:?}: {}", jaw.len());
        let gaps = jaw.iter().map(|(p, _)| got.spine.closest(p).distance_mm - 10.0);
        let (closest, farthest) =
            gaps.fold((f64::INFINITY, 0.0), |(a, b): (f64, f64), g| (a.min(g), b.max(g)));
        assert!(closest > -1e-9 && closest < 8.0, "{jaws:?}: {closest}");
        assert!(farthest > 5.0 && farthest < 40.0, "{jaws:?}: {farthest}");
        // They hold both legs in their middle, and the tube shows between them.
        let held = |p: &Point3<f64>| (p.x - 100.0).abs() < 15.0;
        assert!(jaw.iter().all(|(p, _)| held(p)));
        let shown = got.points.iter().zip(&got.kinds).filter(|(p, k)| **k == PointKind::Tube && held(p));
        assert!(shown.count() > 300);
    }
}

#[test]
fn an_end_that_is_not_seen_has_no_points_and_other_legs_have_theirs() {
    for (last, tilt_rad) in [(true, 0.0), (false, 0.0), (true, 0.6)] {
        let unseen_end = Some(UnseenEnd { last, unseen_mm: 120.0, tilt_rad });
        let settings = ScanSettings { unseen_end, outlier_share: 0.01, ..clean(20_000) };
        let got = scan(&hairpin(), &settings, 9);
        let length = got.spine.length_mm();
        let from_end = |p: &Point3<f64>| {
            let along = got.spine.closest(p).arc_length_mm;
            if last { length - along } else { along }
        };
        let tube =
            || got.points.iter().zip(&got.kinds).filter(|(_, k)| **k == PointKind::Tube).map(|(p, _)| p);
        let closest = tube().map(from_end).fold(f64::INFINITY, f64::min);
        let slant = 10.0 * tilt_rad.tan();
        assert!((closest - (120.0 - slant)).abs() < 2.5, "{closest} at {tilt_rad}");
        // The other leg, beside it, is seen to its end.
        let other = tube().map(|p| length - from_end(p)).fold(f64::INFINITY, f64::min);
        assert!(other < 2.0, "{other}");
    }
}
