//! Inspection as a user relies on it: what is accepted, what is refused, and what is said about it.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

mod common;

use std::fs;

use assert_cmd::Command;
use benderd::cloud::write_scan;
use benderd::config::{Document, Materials, parse_part};
use benderd::inspect::{Inspection, Place, State, Verdict, inspect, judge};
use benderd::sim::scan::{self, Density, ScanSettings, TubeShape};
use benderd::tube::{Alignment, Bend, Lra, MeasuredTube, Nominal};
use common::measured;
use proptest::prelude::*;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

fn bracket() -> Nominal {
    let text = include_str!("../config/parts/bracket-17.toml");
    parse_part(&Document::new("bracket-17.toml", text), &Materials::shipped().unwrap()).unwrap()
}

fn look(tube: &Lra) -> Inspection {
    inspect(&measured(tube, 0.02), &bracket()).unwrap()
}

fn worst(inspection: &Inspection) -> f64 {
    inspection.points.iter().map(|p| p.deviation_mm).fold(0.0, f64::max)
}

#[test]
fn the_nominal_tube_is_in_tolerance() {
    let found = look(&bracket().lra);
    assert_eq!(found.verdict, Verdict::InTolerance, "{}", found.advice);
    assert_eq!(found.points.len(), 15);
    assert!(worst(&found) < 1e-6 && !found.turned_round && found.direction_clear);
    assert!(found.points.iter().all(|p| p.sigma_mm > 0.001 && p.sigma_mm < 0.2));
}

#[test]
fn a_scan_from_the_other_end_is_turned_round() {
    let mut tube = bracket().lra;
    tube.bends[2].angle_rad += 0.004;
    let (forward, backward) = (look(&tube), look(&tube.reversed()));
    assert!(backward.turned_round && backward.direction_clear);
    assert_eq!(forward.verdict, backward.verdict);
    for (a, b) in forward.points.iter().zip(&backward.points) {
        assert!((a.deviation_mm - b.deviation_mm).abs() < 1e-6, "{a:?} {b:?}");
    }
}

#[test]
fn a_settled_direction_is_not_questioned() {
    let mut turned = measured(&bracket().lra.reversed(), 0.02);
    turned.reversed = Some(true);
    let found = inspect(&turned, &bracket()).unwrap();
    assert!(!found.turned_round);
    assert_eq!(found.verdict, Verdict::WrongPart);
}

#[test]
fn the_other_hand_is_named_whichever_end_comes_first() {
    for tube in [bracket().lra.mirrored(), bracket().lra.mirrored().reversed()] {
        let found = look(&tube);
        assert_eq!(found.verdict, Verdict::WrongHand);
        assert!(found.points.is_empty() && found.advice.contains("mirror"), "{found:?}");
    }
}

#[test]
fn a_flat_part_has_no_hand() {
    let mut nominal = bracket();
    let rotations = [0.0, 180.0, 180.0, 0.0_f64];
    nominal.lra.bends.iter_mut().zip(rotations).for_each(|(b, r)| b.rotation_rad = r.to_radians());
    let mut tube = nominal.lra.mirrored();
    tube.bends[2].rotation_rad += 0.3_f64.to_radians(); // wraps past 180
    let found = inspect(&measured(&tube, 0.02), &nominal).unwrap();
    assert_eq!(found.verdict, Verdict::InTolerance, "{}", found.advice);
    assert!((found.bends[2].rotation_deg.deviation.unwrap() - 0.3).abs() < 1e-9);
}

#[test]
fn a_missing_or_extra_bend_is_named() {
    for missing in 0..4 {
        let mut tube = bracket().lra;
        tube.bends[missing].angle_rad = 0.0;
        for tube in [tube.merged(), tube.merged().reversed()] {
            let found = look(&tube);
            assert_eq!(found.verdict, Verdict::WrongPart);
            let note = format!("3 bends instead of 4: bend {} is missing", missing + 1);
            assert!(found.notes.contains(&note), "{:?}", found.notes);
            assert!(found.points.is_empty() && found.bends.is_empty());
        }
    }
    let mut tube = bracket().lra;
    let extra = Bend { length_mm: 60.0, angle_rad: 0.5, ..tube.bends[1] };
    tube.bends.insert(2, Bend { rotation_rad: 0.4, ..extra });
    tube.bends[3].length_mm = 20.0 - 50.8 * 0.5_f64.tan();
    tube.bends[3].rotation_rad -= 0.4;
    let mut exact = bracket().lra;
    exact.bends[2].length_mm = tube.bends[2].length_mm + tube.bends[3].length_mm;
    let mut nominal = bracket();
    nominal.lra = exact;
    tube.bends[3].length_mm = tube.bends[3].length_mm.max(0.0);
    let found = inspect(&measured(&tube, 0.02), &nominal).unwrap();
    assert!(found.notes.iter().any(|n| n.contains("bend 3 is too many")), "{:?}", found.notes);
    let two = Lra { bends: bracket().lra.bends[..2].to_vec(), last_length_mm: 100.0 };
    assert!(look(&two).notes.contains(&"2 bends instead of 4".to_owned()));
}

#[test]
fn equal_bends_leave_open_which_one_is_missing() {
    let bend = Bend { length_mm: 100.0, rotation_rad: 0.0, angle_rad: 1.0, radius_mm: 50.8 };
    let mut nominal = bracket();
    nominal.lra = Lra { bends: vec![bend; 3], last_length_mm: 100.0 };
    // Skipping the first or the last gives mirror-like tubes that only the (trimmed) ends tell apart.
    let tube = Lra { bends: vec![bend; 2], last_length_mm: 150.0 };
    let found = inspect(&measured(&tube, 0.02), &nominal).unwrap();
    assert!(found.notes.contains(&"2 bends instead of 3".to_owned()), "{:?}", found.notes);
}

#[test]
fn angles_are_judged_with_a_guard_band() {
    // Tolerance 0.5 degrees; a loose envelope so that the angle alone decides.
    let verdict = |off_deg: f64, sigma_deg: f64| {
        let mut nominal = bracket();
        nominal.tolerance.envelope_mm = 10.0;
        let mut tube = nominal.lra.clone();
        tube.bends[1].angle_rad += off_deg.to_radians();
        inspect(&measured(&tube, sigma_deg), &nominal).unwrap().verdict
    };
    assert_eq!(verdict(0.45, 0.02), Verdict::InTolerance);
    assert_eq!(verdict(0.45, 0.05), Verdict::Uncertain);
    assert_eq!(verdict(-0.55, 0.05), Verdict::Uncertain);
    assert_eq!(verdict(-0.55, 0.02), Verdict::OutOfTolerance);
    assert_eq!(judge(0.5 - 2.0 * 0.125, 0.5, 0.125), State::In);
    assert_eq!(judge(0.5 - 2.0 * 0.125 + 1e-9, 0.5, 0.125), State::Uncertain);
    assert_eq!(judge(-0.75, 0.5, 0.125), State::Uncertain);
    assert_eq!(judge(-0.75 - 1e-9, 0.5, 0.125), State::Out);
}

#[test]
fn a_doubtful_length_or_turn_leaves_the_decision_to_the_check_points() {
    // Found in the loop with simulated scans: an end known to 0.2 mm, off by 0.5 where 0.8 is allowed.
    let mut tube = bracket().lra;
    tube.bends[0].length_mm -= 0.5;
    let mut scan = measured(&tube, 0.02);
    scan.intersection_sigma_mm[0] = Some(0.2);
    let found = inspect(&scan, &bracket()).unwrap();
    assert_eq!(found.bends[0].length_mm.state, Some(State::Uncertain));
    assert_eq!(found.verdict, Verdict::InTolerance, "{}", found.advice);
    // Out for certain is out, though every check point is within 1.5 mm.
    tube.bends[0].length_mm -= 0.5;
    let found = inspect(&measured(&tube, 0.02), &bracket()).unwrap();
    assert!(found.points.iter().all(|p| p.state == State::In));
    assert_eq!(found.verdict, Verdict::OutOfTolerance);
    assert!(
        found.advice.contains("length of straight 1 is off by -1.00 (tolerance 0.8)"),
        "{}",
        found.advice
    );
}

/// The same corners with other radii.
fn grown(tube: &Lra, share: f64) -> Lra {
    let mut out = tube.clone();
    let n = tube.bends.len();
    let extra = |i: usize| tube.bends[i].radius_mm * share * (tube.bends[i].angle_rad / 2.0).tan();
    for i in 0..n {
        out.bends[i].radius_mm *= 1.0 + share;
        out.bends[i].length_mm -= extra(i) + if i > 0 { extra(i - 1) } else { 0.0 };
    }
    out.last_length_mm -= extra(n - 1);
    out
}

#[test]
fn a_grown_radius_alone_moves_no_straight() {
    let tube = grown(&bracket().lra, 0.04);
    let found = look(&tube);
    assert_eq!(found.verdict, Verdict::InTolerance, "{}", found.advice);
    assert!(worst(&found) < 1e-6);
    assert!((found.bends[0].radius_mm.deviation.unwrap() - 0.04 * 50.8).abs() < 1e-9);
    // Another program's file without intersection distances says the same.
    let mut foreign = measured(&tube, 0.02);
    foreign.intersection_mm.clear();
    foreign.intersection_sigma_mm.clear();
    let found = inspect(&foreign, &bracket()).unwrap();
    assert!(worst(&found) < 1e-6 && found.verdict == Verdict::InTolerance);
}

#[test]
fn what_is_unknown_is_left_out_and_said() {
    let mut scan = measured(&bracket().lra, 0.02);
    scan.bends[0].length_mm = None;
    scan.intersection_mm[0] = None;
    let found = inspect(&scan, &bracket()).unwrap();
    let places = |straight: usize| -> Vec<Place> {
        found.points.iter().filter(|p| p.straight == straight).map(|p| p.place).collect()
    };
    assert_eq!(places(1), [Place::End], "the unseen end and the middle that hangs on it");
    assert_eq!(places(2), [Place::Start, Place::Middle, Place::End]);
    assert_eq!(found.verdict, Verdict::Uncertain);
    assert!(found.notes.iter().any(|n| n.contains("straight 1 is not known")), "{:?}", found.notes);

    // An unknown rotation breaks the tube: bends 1-2 and 3-4 cannot be laid over each other.
    let mut scan = measured(&bracket().lra, 0.02);
    scan.bends[2].rotation_rad = None;
    let found = inspect(&scan, &bracket()).unwrap();
    let straights: Vec<usize> = found.points.iter().map(|p| p.straight).collect();
    assert_eq!(straights, [1, 1, 1, 2, 2, 2, 3, 3, 3]);
    assert_eq!(found.bends[2].rotation_deg.measured, None);
    // A radius that is not known does not matter while the corners are.
    let mut scan = measured(&bracket().lra, 0.02);
    scan.bends.iter_mut().for_each(|b| b.radius_mm = None);
    assert_eq!(inspect(&scan, &bracket()).unwrap().verdict, Verdict::InTolerance);
}

#[test]
fn an_unknown_value_does_not_hide_a_known_fault() {
    let mut tube = bracket().lra;
    tube.bends[3].angle_rad += 0.02;
    let mut scan = measured(&tube, 0.02);
    scan.bends[0].length_mm = None;
    scan.intersection_mm[0] = None;
    let found = inspect(&scan, &bracket()).unwrap();
    assert_eq!(found.verdict, Verdict::OutOfTolerance);
    assert!(found.advice.contains("bend 4"), "{}", found.advice);
}

#[test]
fn each_alignment_holds_its_own_straights() {
    let mut tube = bracket().lra;
    tube.bends[1].angle_rad += 1.0_f64.to_radians();
    let with = |alignment| {
        let mut nominal = bracket();
        nominal.tolerance.alignment = alignment;
        inspect(&measured(&tube, 0.02), &nominal).unwrap()
    };
    let at = |found: &Inspection, straight| {
        found.points.iter().filter(|p| p.straight == straight).map(|p| p.deviation_mm).fold(0.0, f64::max)
    };
    let (a, b) = (with(Alignment::AEnd), with(Alignment::BEnd));
    assert!(at(&a, 1) < 1e-3 && at(&a, 5) > 3.0, "{} {}", at(&a, 1), at(&a, 5));
    assert!(at(&b, 5) < 1e-3 && at(&b, 1) > 3.0, "{} {}", at(&b, 1), at(&b, 5));
    let (best, fixture) = (with(Alignment::BestFit), with(Alignment::Fixture));
    let ends = |found: &Inspection| at(found, 1).max(at(found, 5));
    assert!(ends(&fixture) < ends(&best) && worst(&best) < worst(&a), "{fixture:?}");
    assert!(with(Alignment::Weighted).rms_mm.unwrap() > 0.0);
}

#[test]
fn an_alignment_on_an_unmeasured_straight_is_no_comparison() {
    let mut nominal = bracket();
    nominal.tolerance.alignment = Alignment::AEnd;
    let mut scan = measured(&nominal.lra, 0.02);
    scan.bends[1].rotation_rad = None; // the longer part hangs on bends 2 to 4
    let found = inspect(&scan, &nominal).unwrap();
    let first: Vec<_> = found.points.iter().filter(|p| p.straight == 1).collect();
    assert!(first.is_empty() && found.verdict == Verdict::Uncertain, "{found:?}");
    assert!(found.points.is_empty() && found.notes.iter().any(|n| n.contains("alignment")));
}

#[test]
fn another_part_is_not_a_badly_bent_one() {
    let mut tube = bracket().lra;
    tube.bends[1].angle_rad += 25.0_f64.to_radians();
    let found = look(&tube);
    assert_eq!(found.verdict, Verdict::WrongPart);
    assert!(found.advice.contains("bend 2: 70.0 degrees instead of 45.0"), "{}", found.advice);
    // Titanium's spring-back on all bends is still this part.
    let mut tube = bracket().lra;
    tube.bends.iter_mut().for_each(|b| b.angle_rad *= 0.9);
    assert_eq!(look(&tube).verdict, Verdict::OutOfTolerance);
}

#[test]
fn half_turns_zero_angle_rows_and_straight_tubes() {
    let bend = |length_mm, rotation: f64, angle: f64| Bend {
        length_mm,
        rotation_rad: rotation.to_radians(),
        angle_rad: angle.to_radians(),
        radius_mm: 50.8,
    };
    let mut nominal = bracket();
    nominal.lra = Lra { bends: vec![bend(100.0, 0.0, 180.0), bend(80.0, 90.0, 60.0)], last_length_mm: 150.0 };
    let found = inspect(&measured(&nominal.lra, 0.02), &nominal).unwrap();
    assert_eq!((found.verdict, found.points.len()), (Verdict::InTolerance, 9), "{}", found.advice);
    assert!(worst(&found) < 1e-6);
    let merged = nominal.lra.clone();
    nominal.lra.bends[1].length_mm = 50.0;
    nominal.lra.bends.insert(1, bend(30.0, 0.0, 0.0));
    assert_eq!(inspect(&measured(&merged, 0.02), &nominal).unwrap().verdict, Verdict::InTolerance);
    nominal.lra = Lra { bends: vec![], last_length_mm: 500.0 };
    assert_eq!(inspect(&measured(&nominal.lra, 0.02), &nominal).unwrap().verdict, Verdict::InTolerance);
    let short = Lra { bends: vec![], last_length_mm: 480.0 };
    assert_eq!(inspect(&measured(&short, 0.02), &nominal).unwrap().verdict, Verdict::OutOfTolerance);
}

#[test]
fn point_sigmas_agree_with_repeated_scans() {
    let nominal = bracket();
    let exact = measured(&nominal.lra, 0.05);
    let stated = inspect(&exact, &nominal).unwrap();
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
    let mut draw = move || -> f64 { StandardNormal.sample(&mut rng) };
    const SCANS: usize = 2000;
    let mut square = [0.0; 15];
    for _ in 0..SCANS {
        let mut scan = exact.clone();
        for b in &mut scan.bends {
            b.angle_rad += draw() * b.angle_sigma_rad;
            b.rotation_rad = b.rotation_rad.map(|r| r + draw() * b.rotation_sigma_rad.unwrap());
        }
        scan.intersection_mm.iter_mut().for_each(|d| *d = d.map(|d| d + 0.02 * draw()));
        let found = inspect(&scan, &nominal).unwrap();
        for (s, p) in square.iter_mut().zip(&found.points) {
            *s += p.deviation_mm.powi(2) / SCANS as f64;
        }
    }
    for (s, p) in square.iter().zip(&stated.points) {
        // Three axes together scatter between 1 and sqrt(3) times the worst axis.
        let ratio = s.sqrt() / p.sigma_mm;
        assert!((0.9..1.8).contains(&ratio), "{ratio} {p:?}");
    }
}

#[test]
fn impossible_measurements_are_refused_with_the_place() {
    let refused = |change: fn(&mut MeasuredTube)| {
        let mut scan = measured(&bracket().lra, 0.02);
        change(&mut scan);
        inspect(&scan, &bracket()).unwrap_err().to_string()
    };
    assert!(refused(|s| s.bends[1].angle_rad = f64::NAN).contains("row 2: angle_deg is NaN"));
    assert!(refused(|s| s.bends[3].length_mm = Some(f64::INFINITY)).contains("row 4: length_mm is inf"));
    assert!(refused(|s| s.bends[0].radius_mm = Some(-3.0)).contains("row 1: radius_mm is -3"));
    assert!(refused(|s| s.bends[0].angle_sigma_rad = -1.0).contains("angle_sigma_deg"));
    assert!(refused(|s| s.intersection_mm.truncate(2)).contains("2 values, expected none or 5"));
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_measurement_panics(
        angles in prop::collection::vec(0.0..359.0_f64, 0..6),
        lengths in prop::collection::vec(prop::option::of(-5.0..300.0), 6),
        rotations in prop::collection::vec(prop::option::of(-400.0..400.0_f64), 6),
        radii in prop::collection::vec(prop::option::of(0.01..300.0), 6),
        alignment in 0..5,
    ) {
        let mut nominal = bracket();
        let all = [Alignment::BestFit, Alignment::AEnd, Alignment::BEnd, Alignment::Weighted, Alignment::Fixture];
        nominal.tolerance.alignment = all[alignment as usize];
        let mut tube = bracket().lra;
        let row = tube.bends[0];
        tube.bends = angles.iter().map(|a| Bend { angle_rad: a.to_radians(), ..row }).collect();
        let mut scan = measured(&tube, 0.05);
        for (i, b) in scan.bends.iter_mut().enumerate() {
            b.length_mm = lengths[i];
            b.rotation_rad = rotations[i].map(f64::to_radians);
            b.radius_mm = radii[i];
        }
        scan.intersection_mm.clear();
        scan.intersection_sigma_mm.clear();
        let found = inspect(&scan, &nominal).unwrap();
        prop_assert!(!found.advice.is_empty());
        prop_assert!(angles.len() == 4 || found.verdict == Verdict::WrongPart);
        prop_assert!(found.points.iter().all(|p| p.deviation_mm.is_finite() && p.sigma_mm.is_finite()));
    }
}

#[test]
fn the_command_prints_a_table_and_a_verdict() {
    let dir = tempfile::tempdir().unwrap();
    let part = concat!(env!("CARGO_MANIFEST_DIR"), "/config/parts/bracket-17.toml");
    let run = |tube: &Lra, json: bool| {
        let file = dir.path().join("scan.json");
        fs::write(&file, serde_json::to_string(&measured(tube, 0.02)).unwrap()).unwrap();
        let mut command = Command::cargo_bin("benderd").unwrap();
        command.arg("inspect").arg(&file).args(["--nominal", part]);
        if json {
            command.arg("--json");
        }
        let out = command.output().unwrap();
        (out.status.code(), String::from_utf8(out.stdout).unwrap())
    };
    let (code, text) = run(&bracket().lra, false);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!(text.lines().last(), Some("in tolerance"));
    let mut tube = bracket().lra;
    tube.bends[1].angle_rad -= 2.0_f64.to_radians();
    let (code, text) = run(&tube, false);
    assert_eq!(code, Some(1));
    let last = text.lines().last().unwrap();
    assert!(last.starts_with("out of tolerance: ") && last.ends_with("; correct the table"), "{text}");
    assert!(text.contains("OUT") && text.contains("-2.000"), "{text}");
    let (code, text) = run(&tube, true);
    let value: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!((code, value["verdict"].as_str()), (Some(1), Some("out_of_tolerance")));
    assert!((value["bends"][1]["angle_deg"]["deviation"].as_f64().unwrap() + 2.0).abs() < 1e-9);
}

#[test]
fn the_command_inspects_a_scan() {
    let dir = tempfile::tempdir().unwrap();
    let part = concat!(env!("CARGO_MANIFEST_DIR"), "/config/parts/bracket-17.toml");
    let file = dir.path().join("scan.ply");
    let mut tube = bracket().lra;
    tube.bends[1].angle_rad -= 2.0_f64.to_radians();
    let shape = TubeShape::round(tube.reversed(), 25.4);
    let settings = ScanSettings { density: Density::Points(30_000), views: 2, ..ScanSettings::default() };
    write_scan(&file, &scan::scan(&shape, &settings, 1).cloud()).unwrap();
    let mut command = Command::cargo_bin("benderd").unwrap();
    let out = command.arg("inspect").arg(&file).args(["--nominal", part, "--json"]).output().unwrap();
    assert_eq!(out.status.code(), Some(1), "{}", String::from_utf8_lossy(&out.stderr));
    let found: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(found["verdict"], "out_of_tolerance");
    let off = found["bends"][1]["angle_deg"]["deviation"].as_f64().unwrap();
    assert!((off + 2.0).abs() < 0.1, "{found}");
}

#[test]
fn the_command_refuses_what_is_no_measurement() {
    let dir = tempfile::tempdir().unwrap();
    let part = concat!(env!("CARGO_MANIFEST_DIR"), "/config/parts/bracket-17.toml");
    let file = dir.path().join("scan.json");
    fs::write(&file, "{\"bends\": 3}").unwrap();
    let out =
        Command::cargo_bin("benderd").unwrap().arg("inspect").arg(&file).args(["--nominal", part]).output();
    let out = out.unwrap();
    assert_eq!(out.status.code(), Some(2));
    let text = String::from_utf8(out.stderr).unwrap();
    assert!(text.contains("scan.json") && text.contains("line 1"), "{text}");
}
