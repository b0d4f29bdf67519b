//! The measuring measured: what is counted as what.

use super::*;
use crate::tube::Lra;

fn value(kind: Kind, error: f64, sigma: f64) -> Value {
    Value { kind, row: 1, error: Some(error), sigma: Some(sigma), bound: Some(0.1) }
}

#[test]
fn coverage_counts_what_lies_within() {
    let mut values: Vec<Value> =
        [0.5, -0.9, 1.0, 1.1, -1.9, 2.0, 2.1, -7.0].map(|e| value(Kind::Angle, 0.1 * e, 0.1)).into();
    let unknown = Value { error: None, sigma: None, ..values[0] };
    values.extend([unknown, Value { sigma: None, ..values[0] }]);
    assert_eq!(coverage(values.iter()), Coverage { count: 8, one: 3.0 / 8.0, two: 6.0 / 8.0 });
    let e = errors(values.iter());
    assert_eq!((e.given, e.not_given), (9, 1));
    assert!(
        (e.median - 0.11).abs() < 1e-12 && (e.most - 0.7).abs() < 1e-12 && (e.largest - 0.7).abs() < 1e-12
    );
}

#[test]
fn errors_over_their_bounds_are_taken_where_there_is_a_bound() {
    let mut values = vec![value(Kind::Length, 0.3, 1.0), value(Kind::Length, -0.1, 1.0)];
    values.push(Value { bound: None, ..value(Kind::Length, 9.0, 1.0) });
    assert!((rms_over_bound(values.iter()).unwrap() - 5f64.sqrt()).abs() < 1e-12);
    assert_eq!(rms_over_bound([].iter()), None);
}

#[test]
fn silently_wrong_is_far_off_and_said_to_be_certain() {
    assert!(value(Kind::Angle, 0.31, 0.05).is_silently_wrong());
    assert!(!value(Kind::Angle, 0.29, 0.001).is_silently_wrong(), "too little to harm");
    assert!(!value(Kind::Angle, 3.0, 0.51).is_silently_wrong(), "announced");
    assert!(!value(Kind::Clr, 3.0, 0.01).is_silently_wrong(), "harms by its corner only");
    assert!(!Value { error: None, ..value(Kind::Angle, 3.0, 0.01) }.is_silently_wrong());
}

#[test]
fn a_measurement_is_judged_in_the_direction_that_fits() {
    let folder = std::env::temp_dir();
    let case = run(Set::Paper, 0, Known::Nothing, &folder).unwrap();
    assert_eq!(case.judgement.verdict, Verdict::Right);
    let count = |kind| case.judgement.values.iter().filter(|v| v.kind == kind).count();
    assert_eq!(Kind::ALL.map(count), [5, 4, 4, 2, 4, 2, 5, 1]);
    let worst =
        |kind| case.judgement.values.iter().filter(move |v| v.kind == kind).map(|v| v.error.unwrap().abs());
    assert!(worst(Kind::Angle).all(|e| e < 0.5) && worst(Kind::Intersection).all(|e| e < 0.5));
    // A bound that is far from the errors' size is not their bound.
    let over = rms_over_bound(case.judgement.values.iter().filter(|v| v.kind != Kind::Clr)).unwrap();
    assert!((0.3..4.0).contains(&over), "{over}");
}

#[test]
fn targets_are_missed_by_the_case() {
    let case = |verdict| Case {
        seed: 1,
        tube_radius_mm: 5.0,
        bends: 1,
        round: true,
        points: 100,
        nuisances: String::new(),
        elapsed_ms: 1.0,
        judgement: Judgement { verdict, values: vec![value(Kind::Angle, 0.1, 0.1)] },
        guidance: None,
    };
    let mut tally = Tally { cases: (0..30).map(|_| case(Verdict::Right)).collect() };
    assert_eq!(tally.misses(Set::Thirty), Vec::<String>::new());
    assert!(totals(&tally, Set::Thirty).ends_with("targets met"));
    tally.cases[3] = case(Verdict::WrongCount(2));
    assert_eq!(tally.misses(Set::Thirty), ["29 right, wanted 30"]);
    tally.cases[3] = case(Verdict::SilentlyWrong);
    assert_eq!(tally.misses(Set::Thirty).len(), 2);
    tally.cases[3] = case(Verdict::Right);
    tally.cases[3].judgement.values[0].error = Some(0.8);
    assert!(tally.misses(Set::Thirty)[0].starts_with("angle deg 1.7"), "{:?}", tally.misses(Set::Thirty));
}

#[test]
fn an_end_that_was_not_scanned_is_not_asked_for() {
    let two_bends = || -> Vec<Value> {
        let rows =
            [(Kind::EndLength, 1), (Kind::EndIntersection, 1), (Kind::Length, 2), (Kind::EndLength, 3)];
        let rest = [(Kind::EndIntersection, 3), (Kind::Angle, 1), (Kind::Clr, 1)];
        rows.into_iter().chain(rest).map(|(kind, row)| Value { row, ..value(kind, 9.0, 0.1) }).collect()
    };
    for (last, gone) in [(true, 3), (false, 1)] {
        let mut values = two_bends();
        let end = UnseenEnd { last, unseen_mm: 10.0, tilt_rad: 0.0 };
        judge::leave_out_unseen(&mut values, &end, 2);
        assert_eq!(values.len(), 5);
        assert!(values.iter().all(|v| v.row != gone || matches!(v.kind, Kind::Angle | Kind::Clr)));
    }
}

#[test]
fn the_table_says_what_it_is_of() {
    let case = run(Set::Paper, 4, Known::Nothing, Path::new(".")).unwrap();
    let table = markdown(&Tally { cases: vec![case] }, Set::Paper);
    assert!(table.starts_with("Set `paper`, seeds 4 to 4: 1 right of 1;"), "{table}");
    assert_eq!(table.lines().filter(|l| l.starts_with('|')).count(), 2 + Kind::ALL.len());
    assert!(Set::from_str("thirty") == Ok(Set::Thirty) && Set::from_str("soft").is_err());
}

#[test]
fn wrong_nominals_are_wrong_in_what_they_say() {
    let turned = |lra: &Lra| lra.bends.iter().map(|b| b.angle_rad).sum::<f64>();
    for seed in 0..20 {
        let shape = random_tube(seed).shape;
        let (n, right) = (shape.lra.bends.len(), drawn(&shape, seed).nominal);
        assert_eq!(right.lra.bends.len(), n);
        assert!(
            right.lra.validate().is_ok() && turned(&right.lra) > turned(&shape.lra) - 0.01 * n as f64,
            "sprung back"
        );
        let bends = |wrong: Wrong| {
            let lra = wrong.of(&right, seed)?.lra;
            assert!(lra.validate().is_ok());
            Some(lra.bends.len())
        };
        assert!(bends(Wrong::Mirrored).is_none_or(|b| b == n));
        assert!(bends(Wrong::BendMissing).is_none_or(|b| b == n + 1));
        assert_eq!(bends(Wrong::BendTooMany), (n > 1).then(|| n - 1));
        assert_eq!(bends(Wrong::OtherPart), Some(random_tube(seed + 1).shape.lra.bends.len()));
    }
    let flat = random_tube(0).shape;
    let mut lra = flat.lra.clone();
    lra.bends.iter_mut().for_each(|b| b.rotation_rad = 0.0);
    let flat = drawn(&TubeShape { lra, ..flat }, 0).nominal;
    assert!(Wrong::Mirrored.of(&flat, 0).is_none(), "its own mirror image");
}

#[test]
fn with_the_nominal_all_is_told() {
    let case = run(Set::Paper, 2, Known::Nominal, &std::env::temp_dir()).unwrap();
    let guidance = case.guidance.clone().unwrap();
    assert_eq!((guidance.taken, guidance.against), (Some(Taken::Undoubted), false));
    assert!(guidance.alarms.is_empty() && guidance.wrong.len() == Wrong::ALL.len());
    assert!(guidance.wrong.iter().all(|(_, answer)| *answer == Answer::Recognised), "{guidance:?}");
    let table = markdown(&Tally { cases: vec![case] }, Set::Paper);
    assert!(table.contains("without asking the free search 1,"), "{table}");
    assert!(table.ends_with("| another part | 1 | 1 | 0 | 0 | 0 |"), "{table}");
}
