//! The tube vocabulary against published pipes, brute force and its own symmetries; part files against mistakes.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::f64::consts::PI;
use std::path::Path;

use benderd::config::{Document, Materials, load_part, parse_part};
use benderd::tube::align::{Pair, register};
use benderd::tube::{
    Bend, ControlPolygon, Corner, Frame, Lra, MeasuredBend, MeasuredTube, Spine, TubeError, Ybc, YbcRow,
    wrap_angle,
};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use proptest::prelude::*;

/// length_mm, rotation_deg, angle_deg, radius_mm.
type Row = (f64, f64, f64, f64);

fn lra(rows: &[Row], last_length_mm: f64) -> Lra {
    let bend = |&(length_mm, rotation_deg, angle_deg, radius_mm): &Row| Bend {
        length_mm,
        rotation_rad: rotation_deg.to_radians(),
        angle_rad: angle_deg.to_radians(),
        radius_mm,
    };
    Lra { bends: rows.iter().map(bend).collect(), last_length_mm }
}

fn polygon(points: &[[f64; 3]], radius_mm: f64) -> ControlPolygon {
    ControlPolygon { corners: points.iter().map(|p| Corner { point: Point3::from(*p), radius_mm }).collect() }
}

/// Equal tubes: the first row's rotation does not count, the others wrap.
fn assert_same(found: &Lra, wanted: &Lra, length_mm: f64, angle_deg: f64) {
    assert_eq!(found.bends.len(), wanted.bends.len(), "{found:?}\n{wanted:?}");
    for (i, (f, w)) in found.bends.iter().zip(&wanted.bends).enumerate() {
        assert!((f.length_mm - w.length_mm).abs() <= length_mm, "length {i}: {f:?} {w:?}");
        assert!((f.radius_mm - w.radius_mm).abs() <= length_mm, "radius {i}: {f:?} {w:?}");
        assert!((f.angle_rad - w.angle_rad).abs().to_degrees() <= angle_deg, "angle {i}: {f:?} {w:?}");
        let turn = wrap_angle(f.rotation_rad - w.rotation_rad).to_degrees();
        assert!(i == 0 || turn.abs() <= angle_deg, "rotation {i}: off by {turn}: {f:?} {w:?}");
    }
    assert!((found.last_length_mm - wanted.last_length_mm).abs() <= length_mm, "{found:?}\n{wanted:?}");
}

// ---- worked cases of published pipes

#[test]
fn pipe_published_as_xyz_and_as_lra() {
    // Worked case 1: a CAD vendor's help page prints both forms of one pipe.
    let xyz = polygon(
        &[
            [0.0, 0.0, 0.0],
            [0.0, 0.0, 1495.39],
            [0.0, 10100.0, 1495.39],
            [0.0, 10100.0, 3989.39],
            [5718.30, 10136.89, 3989.39],
        ],
        560.0,
    );
    let published = lra(
        &[(935.39, 0.0, 90.0, 560.0), (8980.0, 180.0, 90.0, 560.0), (1374.0, 90.37, 90.0, 560.0)],
        5158.42,
    );
    let (found, start) = xyz.to_lra().unwrap();
    assert_same(&found, &published, 0.005, 0.005);
    assert!((found.developed_length_mm() - 19086.747).abs() < 0.005);
    let back = ControlPolygon::from_lra(&found, start).unwrap();
    for (b, x) in back.corners.iter().zip(&xyz.corners) {
        assert!((b.point - x.point).norm() < 1e-8, "{b:?} {x:?}");
    }
}

/// Where two lines come closest: the midpoint of the shortest connection.
fn meet(a: [[f64; 3]; 2], b: [[f64; 3]; 2]) -> [f64; 3] {
    let (p, q) = (Point3::from(a[0]), Point3::from(b[0]));
    let (u, v) = (Point3::from(a[1]) - p, Point3::from(b[1]) - q);
    let (uu, uv, vv, w) = (u.dot(&u), u.dot(&v), v.dot(&v), p - q);
    let det = uu * vv - uv * uv;
    let s = (uv * v.dot(&w) - vv * u.dot(&w)) / det;
    let t = (uu * v.dot(&w) - uv * u.dot(&w)) / det;
    ((p + u * s).coords * 0.5 + (q + v * t).coords * 0.5).into()
}

#[test]
fn pipe_given_by_its_straights() {
    // Worked case 2: coordinates rounded to 1 mm, so lengths are good to about 2 mm and angles to half a degree.
    let straights = [
        [[314.0, -512.0, -145.0], [314.0, -338.0, -145.0]],
        [[238.0, -262.0, -145.0], [45.0, -262.0, -145.0]],
        [[-8.0, -240.0, -145.0], [-92.0, -156.0, -145.0]],
        [[-108.0, -64.0, -91.0], [-66.0, -22.0, -31.0]],
        [[0.0, 0.0, 0.0], [285.0, 0.0, 0.0]],
    ];
    let mut points = vec![straights[0][0]];
    points.extend(straights.windows(2).map(|w| meet(w[0], w[1])));
    points.push(straights[4][1]);
    let (found, _) = polygon(&points, 76.0).to_lra().unwrap();
    let published = lra(
        &[
            (174.0, 0.0, 90.0, 76.0),
            (193.0, 180.0, 45.0, 76.0),
            (119.0, -45.0, 90.0, 76.0),
            (84.0, 35.264, 60.0, 76.0),
        ],
        285.0,
    );
    assert_same(&found, &published, 2.0, 1.0);
}

#[test]
fn mixed_radii_with_a_half_turn() {
    // Worked case 3: first straight along +x, first bend towards +y.
    let tube = lra(&[(100.0, 0.0, 90.0, 30.0), (50.0, 90.0, 180.0, 50.0)], 150.0);
    let spine = Spine::from_lra(&tube, Frame::identity());
    let points: Vec<Point3<f64>> = spine.straights().iter().flat_map(|s| [s.start, s.end]).collect();
    let wanted = [
        [0.0, 0.0, 0.0],
        [100.0, 0.0, 0.0],
        [130.0, 30.0, 0.0],
        [130.0, 80.0, 0.0],
        [130.0, 80.0, 100.0],
        [130.0, -70.0, 100.0],
    ];
    for (found, wanted) in points.iter().zip(&wanted) {
        assert!((found - Point3::from(*wanted)).norm() < 1e-10, "{found} {wanted:?}");
    }
    assert!((spine.length_mm() - 504.2035).abs() < 1e-4);
    let refused = ControlPolygon::from_lra(&tube, Frame::identity()).unwrap_err();
    assert!(matches!(refused, TubeError::NoCorner { bend: 2, .. }));
    assert!(refused.to_string().contains("180.000 degrees"), "{refused}");
}

#[test]
fn shop_recipes_survive_every_form() {
    // Worked case 4: feed / bend / plane; the second recipe's last row is its tail, the first has none.
    let recipes: [&[(f64, f64, f64)]; 2] = [
        &[
            (126.0, 48.0, 0.0),
            (394.0, 40.0, 90.0),
            (210.0, 56.0, 0.0),
            (400.0, 55.0, 180.0),
            (470.0, 50.0, -180.0),
            (295.0, 90.0, -90.0),
        ],
        &[
            (85.0, 90.0, 90.0),
            (754.0, 90.0, 0.0),
            (614.0, 48.0, 0.0),
            (973.0, 20.0, 0.0),
            (769.0, 30.0, 35.0),
            (171.0, 90.0, 0.0),
            (300.0, 0.0, 0.0),
        ],
    ];
    for (recipe, (bends, tail)) in recipes.iter().zip([(6, 0.0), (6, 300.0)]) {
        let row = |&(y_mm, angle_deg, plane_deg): &(f64, f64, f64)| YbcRow {
            y_mm,
            b_rad: plane_deg.to_radians(),
            c_rad: angle_deg.to_radians(),
            radius_mm: 60.0,
        };
        let ybc = Ybc { rows: recipe.iter().map(row).collect() };
        let tube = Lra::from(&ybc);
        assert_eq!((tube.bends.len(), tube.last_length_mm), (bends, tail));
        assert_eq!(Lra::from(&Ybc::from(&tube)), tube);
        let (found, _) = ControlPolygon::from_lra(&tube, Frame::identity()).unwrap().to_lra().unwrap();
        assert_same(&found, &tube, 1e-8, 1e-8);
    }
}

// ---- properties

fn row(angle_deg: impl Strategy<Value = f64>) -> impl Strategy<Value = Row> {
    let length = prop_oneof![1 => Just(0.0), 6 => 0.0..400.0];
    (length, -180.0..180.0, angle_deg, 5.0..120.0)
}

/// Tubes with a corner at every bend.
fn cornered() -> impl Strategy<Value = Lra> {
    (prop::collection::vec(row(1.0..179.0), 0..7), 0.0..300.0)
        .prop_map(|(rows, tail)| lra(&rows, tail))
        .prop_filter("a tube has some length", |l| l.developed_length_mm() > 1.0)
}

/// Any tube: angles 0, over 180 and lengths 0 included.
fn any_tube() -> impl Strategy<Value = Lra> {
    let angle = prop_oneof![1 => Just(0.0), 1 => Just(180.0), 6 => 0.5..350.0];
    (prop::collection::vec(row(angle), 0..6), prop_oneof![1 => Just(0.0), 4 => 0.0..300.0])
        .prop_map(|(rows, tail)| lra(&rows, tail))
}

fn motion() -> impl Strategy<Value = Isometry3<f64>> {
    let three = || prop::array::uniform3(-3.0..3.0);
    (three(), three()).prop_map(|(t, r)| Isometry3::new(Vector3::from(t) * 300.0, Vector3::from(r)))
}

/// The pose from which the tube's reversed table retraces the same curve.
fn from_the_other_end(spine: &Spine) -> Frame {
    let last = spine.segments()[spine.segments().len() - 1];
    last.frame_at(last.length_mm) * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), PI)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn lra_to_xyz_and_back(tube in cornered(), at in motion()) {
        let xyz = ControlPolygon::from_lra(&tube, at).unwrap();
        let (found, start) = xyz.to_lra().unwrap();
        let tail_of_nothing = tube.bends.is_empty();
        prop_assert!(tail_of_nothing || found.bends.len() == tube.bends.len());
        assert_same(&found, &tube, 1e-5, 1e-5);
        let again = ControlPolygon::from_lra(&found, start).unwrap();
        for (a, b) in again.corners.iter().zip(&xyz.corners) {
            prop_assert!((a.point - b.point).norm() < 1e-4 * (1.0 + b.point.coords.norm()));
        }
    }

    #[test]
    fn lra_to_ybc_and_back(tube in any_tube()) {
        prop_assert_eq!(&Lra::from(&Ybc::from(&tube)), &tube);
    }

    #[test]
    fn reversing_twice_changes_nothing(tube in any_tube()) {
        let mut wanted = tube.clone();
        if let Some(first) = wanted.bends.first_mut() {
            first.rotation_rad = 0.0;
        }
        prop_assert_eq!(&tube.reversed().reversed(), &wanted);
    }

    #[test]
    fn reversed_table_is_the_same_curve(tube in any_tube(), at in motion()) {
        let spine = Spine::from_lra(&tube, at);
        let back = Spine::from_lra(&tube.reversed(), from_the_other_end(&spine));
        let total = spine.length_mm();
        prop_assert!((back.length_mm() - total).abs() < 1e-9 * (1.0 + total));
        for k in 0..=60 {
            let s = total * f64::from(k) / 60.0;
            let gap = (spine.point_at(s) - back.point_at(total - s)).norm();
            prop_assert!(gap < 1e-8 * (1.0 + total), "at {s}: {gap}");
        }
    }

    #[test]
    fn reversal_keeps_the_signs_of_rotations(tube in any_tube()) {
        let mut forward: Vec<f64> = tube.bends.iter().skip(1).map(|b| b.rotation_rad).collect();
        forward.reverse();
        let backward: Vec<f64> = tube.reversed().bends.iter().skip(1).map(|b| b.rotation_rad).collect();
        prop_assert_eq!(forward, backward);
    }

    #[test]
    fn mirrored_table_is_the_mirror_image(tube in any_tube()) {
        let spine = Spine::from_lra(&tube, Frame::identity());
        let other = Spine::from_lra(&tube.mirrored(), Frame::identity());
        // The first row's plane turns too; seen from it, the mirror is the x-y plane.
        for k in 0..=40 {
            let s = spine.length_mm() * f64::from(k) / 40.0;
            let (a, b) = (spine.point_at(s), other.point_at(s));
            prop_assert!((a - Point3::new(b.x, b.y, -b.z)).norm() < 1e-8 * (1.0 + spine.length_mm()));
        }
        prop_assert_eq!(tube.mirrored().mirrored(), tube);
    }

    #[test]
    fn moving_the_start_moves_the_tube(tube in any_tube(), at in motion(), by in motion()) {
        let moved = Spine::from_lra(&tube, at).moved(&by);
        let direct = Spine::from_lra(&tube, by * at);
        for k in 0..=20 {
            let s = moved.length_mm() * f64::from(k) / 20.0;
            prop_assert!((moved.point_at(s) - direct.point_at(s)).norm() < 1e-8);
        }
    }

    #[test]
    fn zero_angle_rows_do_not_change_the_curve(tube in any_tube()) {
        let (all, merged) =
            (Spine::from_lra(&tube, Frame::identity()), Spine::from_lra(&tube.merged(), Frame::identity()));
        for k in 0..=40 {
            let s = all.length_mm() * f64::from(k) / 40.0;
            prop_assert!((all.point_at(s) - merged.point_at(s)).norm() < 1e-8 * (1.0 + s));
        }
    }

    #[test]
    fn position_and_direction_are_continuous(tube in any_tube(), at in motion()) {
        let spine = Spine::from_lra(&tube, at);
        let tightest = tube.bends.iter().map(|b| b.radius_mm).fold(f64::INFINITY, f64::min);
        for joint in spine.segments() {
            let (before, after) = (spine.frame_at(joint.start_mm - 1e-4), spine.frame_at(joint.start_mm + 1e-4));
            prop_assert!((before.translation.vector - after.translation.vector).norm() < 2.1e-4);
            let (u, v) = (before * Vector3::x(), after * Vector3::x());
            prop_assert!(u.cross(&v).norm() < 1e-9 + 2.5e-4 / tightest && u.dot(&v) > 0.0);
            let exact = joint.frame_at(0.0).translation.vector;
            prop_assert!((spine.point_at(joint.start_mm).coords - exact).norm() < 1e-8);
        }
    }

    #[test]
    fn closest_point_agrees_with_sampling(
        tube in any_tube(), at in motion(), p in prop::array::uniform3(-400.0..400.0)
    ) {
        const STEP_MM: f64 = 0.25;
        let spine = Spine::from_lra(&tube, at);
        let near = at * Point3::from(p);
        let brute = spine.sampled(STEP_MM).iter().map(|q| (near - q).norm()).fold(f64::INFINITY, f64::min);
        let found = spine.closest(&near);
        prop_assert!(found.distance_mm <= brute + 1e-9, "{} {brute}", found.distance_mm);
        prop_assert!(found.distance_mm >= brute - STEP_MM / 2.0 - 1e-9, "{} {brute}", found.distance_mm);
        prop_assert!(((near - found.point).norm() - found.distance_mm).abs() < 1e-9);
        prop_assert!((spine.point_at(found.arc_length_mm) - found.point).norm() < 1e-8);
        let segment = &spine.segments()[found.segment];
        let along = found.arc_length_mm - segment.start_mm;
        prop_assert!((-1e-9..=segment.length_mm + 1e-9).contains(&along));
    }

    #[test]
    fn registration_finds_any_motion_of_any_points(
        points in prop::collection::vec(prop::array::uniform3(-500.0..500.0), 1..9),
        flat in prop::array::uniform3(0.0..1.0), by in motion()
    ) {
        // `flat` squeezes the points towards a plane, a line or one point.
        let squeeze = |v: f64, f: f64| if f < 0.3 { 0.0 } else { v };
        let pairs: Vec<Pair> = points
            .iter()
            .map(|p| {
                let from = Point3::new(squeeze(p[0], flat[0]), squeeze(p[1], flat[1]), squeeze(p[2], flat[2]));
                Pair { from, to: by * from, weight: 1.0 }
            })
            .collect();
        let found = register(&pairs).unwrap();
        prop_assert!(found.rms_mm < 1e-6, "rms {}", found.rms_mm);
        let turn = found.motion.rotation.to_rotation_matrix();
        prop_assert!((turn.matrix().determinant() - 1.0).abs() < 1e-9);
    }
}

#[test]
fn measured_tube_reversed_is_its_table_reversed() {
    let tube = lra(&[(10.0, 0.0, 90.0, 30.0), (20.0, 40.0, 60.0, 31.0), (30.0, -70.0, 45.0, 32.0)], 40.0);
    let bend = |b: &Bend| MeasuredBend {
        length_mm: Some(b.length_mm),
        length_sigma_mm: Some(b.length_mm / 1000.0),
        rotation_rad: Some(b.rotation_rad),
        rotation_sigma_rad: Some(b.rotation_rad.abs() / 1000.0),
        angle_rad: b.angle_rad,
        angle_sigma_rad: 0.001,
        radius_mm: Some(b.radius_mm),
        radius_sigma_mm: Some(0.05),
        ovality: Some(b.radius_mm / 1000.0),
        ovality_sigma: Some(0.001),
        flattening: Some(b.radius_mm / 5000.0),
        flattening_sigma: Some(0.001),
    };
    let json = serde_json::json!({
        "tube_radius_mm": 10.0, "last_length_mm": 40.0, "last_length_sigma_mm": 0.04,
        "bends": tube.bends.iter().map(bend).collect::<Vec<_>>(),
        "intersection_mm": [1.0, 2.0, null, 4.0], "intersection_sigma_mm": [0.1, 0.2, null, 0.4],
        "decisions": [
            {"what": "two bends instead of one", "bend": 1, "gain": 123.4, "kept": true},
            {"what": "one CLR for all bends", "gain": -7.5, "kept": false},
        ],
    });
    let measured: MeasuredTube = serde_json::from_value(json).unwrap();
    let back = measured.reversed();
    assert_same(&back.lra_or(None), &tube.reversed(), 1e-9, 1e-7);
    assert_eq!(back.intersection_mm, [Some(4.0), None, Some(2.0), Some(1.0)]);
    assert_eq!(back.bends[1].length_sigma_mm, Some(0.03), "a sigma travels with its value");
    assert_eq!(back.bends[0].rotation_sigma_rad, Some(0.0));
    assert_eq!(
        (back.bends[2].ovality, back.bends[2].flattening),
        (Some(0.03), Some(0.006)),
        "a section belongs to its bend"
    );
    let about: Vec<Option<usize>> = back.decisions.iter().map(|d| d.bend).collect();
    assert_eq!(about, [Some(3), None], "a decision goes with its bend");
    assert_eq!(back.reversed(), measured);
}

/// A real scan that began within its first bend: the closest point once panicked.
#[test]
fn a_straight_slightly_below_zero_has_a_closest_point() {
    let tube = lra(&[(-0.11, 0.0, 90.0, 30.0)], 40.0);
    let spine = Spine::from_lra(&tube, Frame::identity());
    let near = spine.closest(&Point3::new(-0.05, 1.0, 0.0));
    assert!(near.distance_mm < 1.01, "{near:?}");
}

// ---- polygons that are none

#[test]
fn impossible_polygons_are_refused_with_the_place() {
    let too_close = polygon(&[[0.0; 3], [50.0, 0.0, 0.0], [50.0, 60.0, 0.0], [0.0, 60.0, 0.0]], 40.0);
    let text = too_close.to_lra().unwrap_err().to_string();
    assert!(text.contains("corner 2 and 3") && text.contains("80.000") && text.contains("60.000"), "{text}");
    let fold = polygon(&[[0.0; 3], [50.0, 0.0, 0.0], [10.0, 0.0, 0.0]], 5.0);
    assert!(matches!(fold.to_lra(), Err(TubeError::Fold { corner: 2 })));
    assert!(matches!(
        polygon(&[[1.0; 3], [1.0; 3]], 5.0).to_lra(),
        Err(TubeError::TooFewPoints { found: 1 })
    ));
}

#[test]
fn polygons_with_unusable_numbers_are_refused() {
    for bad in [f64::NAN, f64::INFINITY] {
        let points = polygon(&[[0.0; 3], [bad, 0.0, 0.0], [50.0, 60.0, 0.0]], 4.0);
        assert!(points.to_lra().is_err(), "point {bad}");
    }
    for bad in [f64::NAN, f64::INFINITY, -4.0, 0.0] {
        let radius = polygon(&[[0.0; 3], [50.0, 0.0, 0.0], [50.0, 60.0, 0.0]], bad);
        assert!(radius.to_lra().is_err(), "radius {bad}");
    }
}

// ---- part files

const PART: &str = include_str!("../config/parts/bracket-17.toml");

fn complaint(change: impl Fn(&str) -> String) -> String {
    let text = change(PART);
    assert_ne!(text, PART, "the change must hit something");
    let materials = Materials::shipped().unwrap();
    parse_part(&Document::new("parts/x.toml", text), &materials).unwrap_err().to_string()
}

fn line_of(needle: &str) -> usize {
    1 + PART.lines().position(|l| l.contains(needle)).unwrap()
}

#[test]
fn a_mistake_in_a_part_file_is_named_with_its_place() {
    let replaced = |from: &'static str, to: &'static str| complaint(move |t| t.replacen(from, to, 1));
    let has = |text: &str, parts: &[&str]| {
        for part in parts {
            assert!(text.contains(part), "{part:?} is missing in: {text}");
        }
    };
    let line = |needle: &str| format!("line {}", line_of(needle));

    let text = replaced("angle_deg = 45.0", "angle_deg = 400");
    has(&text, &["parts/x.toml", &line("angle_deg = 45.0"), "bend 2 angle_deg", "400", "0 to 359"]);
    let text = replaced("material = \"304\"", "material = \"cheese\"");
    has(&text, &["parts/x.toml", &line("material"), "tube.material", "cheese", "304, 316l"]);
    let text = replaced("wall_mm = 1.65", "wall_mm = 1.65\nwal_mm = 2");
    has(&text, &["parts/x.toml", "line 7", "wal_mm", "expected one of", "wall_mm"]);
    let text = replaced("od_mm = 25.4", "");
    has(&text, &["parts/x.toml", "line", "missing field `od_mm`"]);
    let text = replaced("envelope_mm = 1.5", "");
    has(&text, &["parts/x.toml", "missing field `envelope_mm`"]);
    let text = replaced("length_mm = 150.0", "length_mm = \"long\"");
    has(&text, &["parts/x.toml", &line("length_mm = 150.0"), "string", "long"]);
    for bad in ["nan", "inf", "-inf", "-0.1", "100000.1"] {
        let text = complaint(|t| t.replacen("length_mm = 150.0", &format!("length_mm = {bad}"), 1));
        has(&text, &[&line("length_mm = 150.0"), "bend 2 length_mm", "0 to 100000"]);
    }
    let text = replaced("clr_mm = 50.8", "clr_mm = 12.6");
    has(&text, &[&line("clr_mm"), "die.clr_mm", "12.6", "12.7 to 100000"]);
    let text = replaced("wall_mm = 1.65", "wall_mm = 12.8");
    has(&text, &["tube.wall_mm", "0.05 to 12.7"]);
    let text = replaced("length_mm = 0.8", "length_mm = 0.8\nalignment = \"best\"");
    has(&text, &["best", "best-fit", "fixture"]);
}

#[test]
fn limits_of_a_part_file_are_inside() {
    let materials = Materials::shipped().unwrap();
    let text = PART.replacen("angle_deg = 45.0", "angle_deg = 359.0", 1).replacen("150.0", "0.0", 1);
    let part = parse_part(&Document::new("x", text), &materials).unwrap();
    assert_eq!(part.lra.bends[1].angle_rad, 359.0_f64.to_radians());
    assert!(part.lra.validate().is_ok());
}

#[test]
fn every_shipped_part_parses() {
    let materials = Materials::shipped().unwrap();
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/parts");
    let mut seen = 0;
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "toml") {
            let part = load_part(&path, &materials).unwrap_or_else(|e| panic!("{e}"));
            assert!(part.lra.validate().is_ok(), "{}", path.display());
            seen += 1;
        }
    }
    assert!(seen > 0);
    for key in ["steel", "e355", "304", "316l", "6061-t6", "ti-3al-2.5v"] {
        assert!(materials.get(key).is_some(), "{key}");
    }
}
