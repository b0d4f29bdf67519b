//! The measured centre line and what is searched on it: derivatives against finite differences, evidence against truth.

use nalgebra::{DVector, Point3, Vector3};
use proptest::prelude::*;

use super::evidence::Solved;
use super::fit::{Data, RESOLVED, RadiusPrior, Way, descend};
use super::flattening::freed;
use super::model::{Flattening, Parameter, TubeModel, Wall};
use super::moves::{
    doubled, drawn_apart, is_one, merged, shallow_pairs, with_wide_doubled, without_bend, without_detours,
};
use super::normal;
use super::reach::reaching;
use super::sections::CentreLine;
use crate::tube::{Bend, Frame, Lra};

fn bend(length_mm: f64, rotation_rad: f64, angle_rad: f64) -> Bend {
    Bend { length_mm, rotation_rad, angle_rad, radius_mm: 40.0 }
}

fn tube(bends: Vec<Bend>) -> TubeModel {
    let start = Frame::new(Vector3::new(5.0, -7.0, 30.0), Vector3::new(0.4, -1.0, 0.3));
    TubeModel::round(start, Lra { bends, last_length_mm: 120.0 }, 10.0)
}

fn three_bends() -> TubeModel {
    let mut model = tube(vec![bend(100.0, 0.0, 1.2), bend(60.0, 1.0, 0.9), bend(45.0, -0.7, 0.05)]);
    model.ovality_mm = vec![-0.3, -0.2, 0.0];
    model
}

/// Points of half the surface of a round tube, off by a fixed pattern of the given size.
fn points(model: &TubeModel, noise_mm: f64) -> Vec<Point3<f64>> {
    let spine = model.spine();
    let place = |i: usize| {
        let along = (i as f64 * 0.618_034).fract() * spine.length_mm();
        let around = 2.6 * ((i as f64 * 0.414_214).fract() - 0.5);
        // Near enough to normal: the sum of three uniform numbers.
        let off: f64 = [0.731, 0.303, 0.557].iter().map(|s| (i as f64 * s).fract() - 0.5).sum();
        let radius = model.tube_radius_mm + 2.0 * noise_mm * off;
        spine.frame_at(along) * Point3::new(0.0, radius * around.cos(), radius * around.sin())
    };
    (0..12_000).map(place).collect()
}

fn round_of(model: &TubeModel) -> TubeModel {
    TubeModel { ovality_mm: vec![0.0; model.lra.bends.len()], ..model.clone() }
}

fn way(noise_mm: f64) -> Way {
    Way { cutoff_mm: f64::INFINITY, noise_mm, steps: 60, goal: f64::INFINITY, resolved: RESOLVED }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn the_gradient_is_that_of_finite_differences(seed in 0u64..1000, common in any::<bool>()) {
        let mut model = three_bends();
        model.common_radius = common;
        let line = CentreLine::measure(&points(&round_of(&model), 0.03), &round_of(&model), true);
        let parameters = model.parameters();
        // Somewhere near the base, the same for the same seed.
        let away = DVector::from_fn(parameters.len(), |j, _| {
            1e-3 * (((seed + 1) * (j as u64 + 3) % 17) as f64 / 17.0 - 0.5)
        });
        let model = model.moved(&parameters, &away);
        let cost = |m: &TubeModel| (&line).pass(m, f64::INFINITY).cost;
        let pass = (&line).pass(&model, f64::INFINITY);
        let (matrix, gradient) = normal::equations(&pass.moments, &model, &parameters);
        for j in 0..parameters.len() {
            let h = 1e-5;
            let at = |d: f64| {
                let step = DVector::from_fn(parameters.len(), |k, _| if k == j { d } else { 0.0 });
                cost(&model.moved(&parameters, &step))
            };
            let numeric = (at(h) - at(-h)) / (2.0 * h);
            // The ramp of the ovality and the base's curvature are left out of the derivatives.
            let scale = 0.03 * (2.0 * pass.cost * matrix[(j, j)]).sqrt() + 1e-6;
            prop_assert!((gradient[j] - numeric).abs() < scale, "{:?}: {} {numeric}", parameters[j], gradient[j]);
        }
    }
}

#[test]
fn the_noise_is_the_sections_own_whatever_the_structure() {
    let truth = round_of(&three_bends());
    let points = points(&truth, 0.03);
    let right = CentreLine::measure(&points, &truth, true);
    // A base without the shallow bend: off by up to 0.05 rad times the rest of the tube.
    let wrong = CentreLine::measure(&points, &without_bend(&truth, 2), false);
    assert!((wrong.noise_mm / right.noise_mm - 1.0).abs() < 0.3, "{} {}", wrong.noise_mm, right.noise_mm);
    assert!(right.correlation(&truth) < 1.2);
}

#[test]
fn a_bend_that_the_model_lacks_shows_as_a_joint_where_it_is() {
    let truth = round_of(&three_bends());
    let less = without_bend(&truth, 2);
    let points = points(&truth, 0.03);
    let line = CentreLine::measure(&points, &less, false);
    let parameters = less.parameters();
    let noise_mm = line.noise_mm;
    let fitted = descend(&mut &line, less, &parameters, None, way(noise_mm)).model;
    let joints = Solved::new(&line, &fitted, &parameters, None).joints(&line, &fitted, &parameters, noise_mm);
    let best = joints.iter().max_by(|a, b| a.gain.total_cmp(&b.gain)).unwrap();
    let arc = truth.spine().segments()[5];
    assert!(best.gain > 100.0, "{best:?}");
    assert!((best.at_mm - arc.start_mm).abs() < 20.0, "{best:?} {}", arc.start_mm);
    // About the right tube no joint is worth its four values.
    let line = CentreLine::measure(&points, &truth, true);
    let parameters = truth.parameters();
    let fitted = descend(&mut &line, truth, &parameters, None, way(noise_mm)).model;
    let joints = Solved::new(&line, &fitted, &parameters, None).joints(&line, &fitted, &parameters, noise_mm);
    assert!(joints.iter().all(|j| j.gain < 30.0), "{:?}", joints.iter().map(|j| j.gain).fold(0.0, f64::max));
}

#[test]
fn a_fit_to_the_sections_finds_the_tube() {
    let truth = round_of(&three_bends());
    let points = points(&truth, 0.03);
    let parameters = truth.parameters();
    let off = DVector::from_fn(parameters.len(), |j, _| if j < 6 { 0.0 } else { 0.01 * (j % 3) as f64 });
    let start = truth.moved(&parameters, &off);
    let line = CentreLine::measure(&points, &truth, true);
    let found = descend(&mut &line, start, &parameters, None, way(0.03)).model;
    for (a, b) in found.lra.bends.iter().zip(&truth.lra.bends) {
        assert!((a.angle_rad - b.angle_rad).abs() < 2e-4, "{a:?} {b:?}");
    }
}

#[test]
fn shallow_bends_in_two_planes_merge_into_their_joint_turn() {
    let model = tube(vec![bend(100.0, 0.0, 0.08), bend(20.0, 1.2, 0.06), bend(80.0, 0.3, 1.0)]);
    let one = merged(&model, 1).unwrap();
    assert_eq!(one.lra.bends.len(), 2);
    let angle = (0.08f64.powi(2) + 0.06f64.powi(2) + 2.0 * 0.08 * 0.06 * 1.2f64.cos()).sqrt();
    assert!((one.lra.bends[0].angle_rad - angle).abs() < 1e-12);
    // What follows keeps its length, and its place but for what the turns' order changes.
    assert!((one.spine().length_mm() - model.spine().length_mm()).abs() < 1e-9);
    let (a, b) = (one.spine(), model.spine());
    assert!((a.point_at(a.length_mm()) - b.point_at(b.length_mm())).norm() < 1.5);
}

#[test]
fn end_straights_reach_as_far_as_their_points() {
    let whole = tube(vec![bend(100.0, 0.0, 1.2), bend(60.0, 1.0, 0.9)]);
    let mut points = points(&whole, 0.03);
    // Flying points beyond the end are no tube.
    let spine = whole.spine();
    points.extend([15.0, 40.0].map(|x| spine.frame_at(spine.length_mm()) * Point3::new(x, 10.0, 0.0)));
    let mut short = whole.clone();
    short.lra.last_length_mm -= 70.0;
    short.lra.bends[0].length_mm -= 40.0;
    short.start *= Frame::translation(40.0, 0.0, 0.0);
    let out = reaching(&short, &points);
    let at = [(0.0, 0.0), (out.spine().length_mm(), spine.length_mm())];
    for (found, right) in at {
        let off = (out.spine().point_at(found) - spine.point_at(right)).norm();
        assert!(off <= 5.0, "half a radius at most: {off}");
    }
    assert_eq!(out.lra.bends[1], short.lra.bends[1], "what lies between stays");
}

#[test]
fn all_wide_bends_are_doubled_and_no_others() {
    let mut model = tube(vec![bend(100.0, 0.0, 1.2), bend(60.0, 1.0, 0.08), bend(45.0, -0.7, 1.1)]);
    model.lra.bends[1].radius_mm = 400.0;
    let out = with_wide_doubled(&model);
    assert_eq!(out.lra.bends.len(), 4);
    assert_eq!(Some(out), doubled(&model, 1));
    assert_eq!(with_wide_doubled(&without_bend(&model, 1)).lra.bends.len(), 2);
}

#[test]
fn arcs_that_are_all_ramp_are_round_by_rule() {
    // A quarter of the radius of 10 mm on a CLR of 40: 0.0625 rad.
    for (angle, oval) in [(0.062, false), (0.063, true)] {
        let mut model = tube(vec![bend(100.0, 0.0, angle)]);
        model.ovality_mm = vec![-0.2];
        let free = model.parameters().contains(&Parameter::Ovality(0));
        assert_eq!((free, model.may_be_oval(0)), (oval, oval));
        assert_eq!(model.settled().ovality_mm[0] != 0.0, oval);
    }
}

#[test]
fn a_bend_has_the_flattening_of_the_wall_seen_nearest_to_it() {
    let mut model = three_bends();
    assert_eq!(model.flattenings_mm(), [0.0; 3]);
    let [first, _, last] = model.middles()[..] else { panic!("three bends") };
    let wall = |at, flat_mm| Wall { at, flat_mm };
    model.flattening = Flattening::Known(vec![wall(last, -0.1), wall(first, -0.3)]);
    // The last bend is too short to have any.
    model.lra.bends[2].angle_rad = 0.05;
    assert_eq!(model.flattenings_mm(), [-0.3, -0.1, 0.0]);
    // Taken for each bend's own they stay.
    model.flattening = freed(&model);
    assert_eq!(model.flattenings_mm(), [-0.3, -0.1, 0.0]);
    assert!(model.parameters().contains(&Parameter::Flattening(1)));
}

#[test]
fn a_straight_of_nothing_is_a_trap_that_drawing_apart_leaves() {
    let mut truth = tube(vec![bend(100.0, 0.0, 0.9), bend(6.0, std::f64::consts::PI, 1.3)]);
    truth.common_radius = true;
    let points = points(&truth, 0.02);
    let line = CentreLine::measure(&points, &truth, true);
    let mut start = truth.clone();
    start.lra.bends[1].length_mm = 0.0;
    start.lra.bends.iter_mut().for_each(|b| b.angle_rad += 0.07);
    let descended = |start| descend(&mut &line, start, &truth.parameters(), None, way(0.02));
    let trapped = descended(start);
    assert_eq!(trapped.model.lra.bends[1].length_mm, 0.0);
    let found = descended(drawn_apart(&trapped.model, 1).unwrap());
    assert!((found.model.lra.bends[1].length_mm - 6.0).abs() < 1.0, "{:?}", found.model.lra);
    assert!(found.pass.cost < trapped.pass.cost);
    assert_eq!(drawn_apart(&truth, 1), None, "they are apart");
    assert_eq!(drawn_apart(&truth, 0), None);
}

#[test]
fn a_second_bend_of_an_s_shows_beside_one_whose_radius_nothing_tells() {
    // Hard 280: the first bend between two sections, its CLR at the bound.
    let truth = tube(vec![bend(90.0, 0.0, 0.082), bend(20.0, std::f64::consts::PI, 0.032)]);
    let points = points(&truth, 0.03);
    let mut less = without_bend(&truth, 1);
    less.lra.bends[0].radius_mm = 15.0;
    let line = CentreLine::measure(&points, &less, false);
    let parameters = less.parameters();
    let prior = Some(RadiusPrior { radius_mm: 15.0, spread_mm: 5.0 });
    let noise_mm = line.noise_mm;
    let fitted = descend(&mut &line, less, &parameters, prior, way(noise_mm)).model;
    let solved = Solved::new(&line, &fitted, &parameters, prior);
    let joints = solved.joints(&line, &fitted, &parameters, noise_mm);
    let best = joints.iter().map(|j| j.gain).fold(0.0, f64::max);
    assert!(best > 300.0, "{best}");
}

#[test]
fn arcs_of_one_bend_are_known_as_such() {
    let with = |length_mm, rotation_rad, radius_mm| {
        let mut model = tube(vec![bend(100.0, 0.0, 0.7), bend(length_mm, rotation_rad, 0.5)]);
        model.lra.bends[1].radius_mm = radius_mm;
        is_one(&model, 1)
    };
    assert!(with(0.4, 0.009, 40.5));
    assert!(!with(0.6, 0.0, 40.0), "a straight of 0.05 radii and more");
    assert!(!with(0.0, 0.011, 40.0), "a turn");
    assert!(!with(0.0, 0.0, 41.0), "another CLR");
}

#[test]
fn shallow_bends_close_together_are_doubted() {
    let pairs = |length_mm, second_rad| {
        shallow_pairs(&tube(vec![bend(100.0, 0.0, 0.02), bend(length_mm, 1.0, second_rad)]))
    };
    assert_eq!(pairs(9.9, 0.02), [1]);
    assert!(pairs(10.1, 0.02).is_empty(), "a tube radius between");
    assert!(pairs(9.9, 0.34).is_empty(), "not shallow");
}

#[test]
fn a_row_of_bends_that_leads_nowhere_is_pulled_straight() {
    // Aside by 2 mm and back again, between two bends.
    let detour = |roll: f64| {
        let shallow = |length_mm, turn, angle| Bend { radius_mm: 20.0, ..bend(length_mm, turn, angle) };
        let half_turn = std::f64::consts::PI;
        let way = [shallow(40.0, roll, 0.2), shallow(1.0, half_turn, 0.4), shallow(1.0, half_turn, 0.2)];
        [&[bend(100.0, 0.0, 1.2)], &way[..], &[bend(45.0, -0.7, 0.9)]].concat()
    };
    for roll in [0.0, 1.0, -2.5] {
        let model = tube(detour(roll));
        let rows = without_detours(&model);
        assert_eq!(rows.len(), 1);
        let (row, straight) = &rows[0];
        assert_eq!((row.clone(), straight.lra.bends.len()), (1..=3, 2));
        let (spine, before) = (straight.spine(), model.spine());
        let ends = [0.0, 1.0].map(|share| {
            let at = |s: &crate::tube::Spine| s.frame_at(share * s.length_mm()).translation.vector;
            (at(&spine) - at(&before)).norm()
        });
        assert!(ends.iter().all(|off| *off < 1.0), "{roll}: {ends:?}");
    }
    // A real offset bend, and an S, stay.
    assert!(
        without_detours(&tube(vec![bend(100.0, 0.0, 0.5), bend(5.0, 3.1, 0.5), bend(50.0, 0.3, 0.4)]))
            .is_empty()
    );
}
