//! Changes of a tube's structure by one bend: one dropped, two merged into one, one split or doubled, one put in, two drawn
//! apart; and what goes with them: one CLR for all.
//!
//! Under `structure`, which fits every changed tube and keeps what the data supports.

use std::ops::RangeInclusive;

use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::evidence::Joint;
use super::model::TubeModel;
use crate::tube::{Bend, Lra, Segment};

/// Seamless joints in one plane from which on a table is no bent tube's.
const FREE_FORM_JOINTS: usize = 4;

/// Neighbouring bends this near to one plane are tried as one.
const MERGE_RAD: f64 = 0.6;

/// Bends that turn less than this together are tried as one whatever their planes.
const SHALLOW_RAD: f64 = 0.35;

/// Pairs of bends tried as one per round.
const PAIRS: usize = 4;

/// A straight no longer than this, in tube radii, is none.
const NO_STRAIGHT: f64 = 0.05;

/// A turn no larger than this is none (0.6 degrees), and CLRs this near to each other are one.
const NO_TURN_RAD: f64 = 0.01;
const SAME_RADIUS: f64 = 0.02;

/// A bend this much wider than the mean may be two.
const WIDE: f64 = 1.3;

/// So many bends in a row that lead back onto the line before them are none, if the points agree: turned by less than this, and
/// aside by less than so many tube radii.
const DETOUR_BENDS: RangeInclusive<usize> = 3..=5;
const DETOUR_RAD: f64 = 0.05;
const DETOUR_RADII: f64 = 0.2;

/// Smallest first angle of a bend that is tried.
const TRIAL_RAD: f64 = 0.01;

/// Mean CLR weighted by angle: sharp bends know theirs best. None without bends.
pub fn mean_radius_mm(model: &TubeModel) -> Option<f64> {
    let weight: f64 = model.lra.bends.iter().map(|b| b.angle_rad).sum();
    let sum: f64 = model.lra.bends.iter().map(|b| b.angle_rad * b.radius_mm).sum();
    (weight > 0.0).then(|| sum / weight)
}

/// The tube with one CLR for all bends.
pub fn with_common_radius(model: &TubeModel) -> TubeModel {
    let mut out = TubeModel { common_radius: true, ..model.clone() };
    if let Some(mean) = mean_radius_mm(model) {
        out.lra.bends.iter_mut().for_each(|b| b.radius_mm = mean);
    }
    out
}

/// The tube with bend `i` pulled straight; the longer part beside it stays in place.
pub fn without_bend(model: &TubeModel, i: usize) -> TubeModel {
    let mut out = model.clone();
    let gone = out.lra.bends.remove(i);
    out.ovality_mm.remove(i);
    let length = gone.length_mm + gone.radius_mm * gone.angle_rad;
    match out.lra.bends.get_mut(i) {
        Some(next) => {
            next.length_mm += length;
            next.rotation_rad += gone.rotation_rad;
        }
        None => out.lra.last_length_mm += length,
    }
    turn_into_pose(&mut out);
    with_longer_part_in_place(model, i + 1, out, i)
}

/// The tube with a row of bends pulled straight that lead back onto the line before them, for every such row: no part is bent
/// so, but a centre line runs so past a few points of a jaw that hides the tube. With the bends that go.
pub fn without_detours(model: &TubeModel) -> Vec<(RangeInclusive<usize>, TubeModel)> {
    let n = model.lra.bends.len();
    let rows = DETOUR_BENDS.flat_map(|many| (0..(n + 1).saturating_sub(many)).map(move |i| i..=i + many - 1));
    rows.filter_map(|row| Some((row.clone(), without_detour(model, row)?))).collect()
}

fn without_detour(model: &TubeModel, row: RangeInclusive<usize>) -> Option<TubeModel> {
    let (first, last) = (*row.start(), *row.end());
    let spine = model.spine();
    let (one, other) = (&spine.segments()[2 * first + 1], &spine.segments()[2 * last + 1]);
    let way = one.start.inverse() * other.frame_at(other.length_mm);
    let along = way.rotation * Vector3::x();
    let shift = way.translation.vector;
    let aside_mm = shift.y.hypot(shift.z);
    if along.y.hypot(along.z) > DETOUR_RAD || along.x < 0.0 || aside_mm > DETOUR_RADII * model.tube_radius_mm
    {
        return None;
    }
    let across = way.rotation * Vector3::y();
    let roll_rad = across.z.atan2(across.y);
    let mut out = model.clone();
    out.lra.bends.drain(row.clone());
    out.ovality_mm.drain(row);
    let (length_mm, rotation_rad) =
        (model.lra.bends[first].length_mm + shift.x, model.lra.bends[first].rotation_rad);
    match out.lra.bends.get_mut(first) {
        Some(next) => {
            next.length_mm += length_mm;
            next.rotation_rad += rotation_rad + roll_rad;
        }
        None => out.lra.last_length_mm += length_mm,
    }
    turn_into_pose(&mut out);
    Some(with_longer_part_in_place(model, last + 1, out, first))
}

/// A changed tube whose bend `new` is the `old` one of the tube before and the first behind the change: what lies behind stays
/// where it is if that is the longer part. From a swing of the longer part no fit finds back.
fn with_longer_part_in_place(before: &TubeModel, old: usize, mut after: TubeModel, new: usize) -> TubeModel {
    let (spine, changed) = (before.spine(), after.spine());
    if let (Some(was), Some(is)) = (spine.segments().get(2 * old + 1), changed.segments().get(2 * new + 1))
        && spine.length_mm() - was.start_mm > was.start_mm
    {
        after.start = was.start * is.start.inverse() * after.start;
    }
    after
}

/// The first row's rotation belongs into the pose.
fn turn_into_pose(model: &mut TubeModel) {
    if let Some(first) = model.lra.bends.first_mut() {
        model.start *= UnitQuaternion::from_axis_angle(&Vector3::x_axis(), first.rotation_rad);
        first.rotation_rad = 0.0;
    }
}

/// Bends that are likeliest one with the bend before: hardly a straight and hardly a turn between.
pub fn likeliest_pairs(model: &TubeModel) -> Vec<usize> {
    let bends = &model.lra.bends;
    let apart =
        |i: &usize| bends[*i].length_mm / model.tube_radius_mm + bends[*i].rotation_rad.abs() / MERGE_RAD;
    let mut pairs: Vec<usize> = (1..bends.len()).collect();
    pairs.sort_by(|a, b| apart(a).total_cmp(&apart(b)));
    pairs.truncate(PAIRS);
    pairs
}

/// Shallow bends less than a tube radius behind another: over so short a way a section of the centre line may mistake one
/// for two.
pub fn shallow_pairs(model: &TubeModel) -> Vec<usize> {
    let bends = &model.lra.bends;
    let shallow = |i: &usize| bends[i - 1].angle_rad + bends[*i].angle_rad < SHALLOW_RAD;
    (1..bends.len()).filter(|i| bends[*i].length_mm < model.tube_radius_mm).filter(shallow).collect()
}

/// Whether the table is a curve of no straights cut into arcs: bend on bend in one plane, which a bender would bend as
/// one. Fewer than [`FREE_FORM_JOINTS`] such joints may be a measurement's doubt about one bend.
pub fn is_free_form(lra: &Lra, tube_radius_mm: f64) -> bool {
    let seamless = |b: &&Bend| b.length_mm < 0.2 * tube_radius_mm && b.rotation_rad.abs() < 0.3;
    let joints = lra.bends.iter().skip(1).filter(seamless).count();
    joints >= FREE_FORM_JOINTS && 2 * joints >= lra.bends.len()
}

/// Whether bends `i - 1` and `i` are one for any bender: the same CLR in the same plane with no straight between.
pub fn is_one(model: &TubeModel, i: usize) -> bool {
    let (one, other) = (model.lra.bends[i - 1], model.lra.bends[i]);
    other.length_mm < NO_STRAIGHT * model.tube_radius_mm
        && other.rotation_rad.abs() < NO_TURN_RAD
        && (one.radius_mm / other.radius_mm).ln().abs() < SAME_RADIUS
}

/// A bend as one with the nearer of its neighbours that it touches, if it touches one.
pub fn joined(model: &TubeModel, bend: usize) -> Option<TubeModel> {
    let length_mm = |i: &usize| model.lra.bends[*i].length_mm;
    let touching = (bend.max(1)..model.lra.bends.len().min(bend + 2))
        .filter(|i| length_mm(i) < NO_STRAIGHT * model.tube_radius_mm);
    let nearest = touching.min_by(|a, b| length_mm(a).total_cmp(&length_mm(b)))?;
    merged(model, nearest).map(TubeModel::settled)
}

/// Bends `i - 1` and `i` as one: an arc over both when they turn in about one plane the same way, or, shallow ones in any
/// planes, their joint turn in between.
pub fn merged(model: &TubeModel, i: usize) -> Option<TubeModel> {
    let (one, other) = (model.lra.bends[i - 1], model.lra.bends[i]);
    let sum_rad = one.angle_rad + other.angle_rad;
    let arcs = one.radius_mm * one.angle_rad + other.radius_mm * other.angle_rad;
    let whole = arcs + other.length_mm;
    let (sin, cos) = other.rotation_rad.sin_cos();
    let across = Vector2::new(one.angle_rad + other.angle_rad * cos, other.angle_rad * sin);
    let (before, bend, roll) = if other.rotation_rad.abs() <= MERGE_RAD && other.length_mm <= 0.5 * arcs {
        (0.0, Bend { angle_rad: sum_rad, radius_mm: whole / sum_rad.max(1e-9), ..one }, 0.0)
    } else if sum_rad < SHALLOW_RAD {
        let angle_rad = across.norm().max(TRIAL_RAD);
        let radius_mm = (arcs / sum_rad.max(1e-9)).min(whole / angle_rad);
        let share = (other.angle_rad / sum_rad.max(1e-9)).clamp(0.0, 1.0);
        let before = share * (whole - radius_mm * angle_rad);
        (before, Bend { angle_rad, radius_mm, ..one }, across.y.atan2(across.x))
    } else {
        return None;
    };
    if sum_rad <= 0.0 {
        return None;
    }
    let mut out = model.clone();
    let rest = whole - bend.radius_mm * bend.angle_rad - before;
    let (length_mm, rotation_rad) = (one.length_mm + before, one.rotation_rad + roll);
    out.lra.bends[i - 1] = Bend { length_mm, rotation_rad, ..bend };
    out.lra.bends.remove(i);
    out.ovality_mm.remove(i);
    match out.lra.bends.get_mut(i) {
        Some(next) => {
            next.rotation_rad += other.rotation_rad - roll;
            next.length_mm += rest;
        }
        None => out.lra.last_length_mm += rest,
    }
    turn_into_pose(&mut out);
    Some(with_longer_part_in_place(model, i + 1, out, i))
}

/// The bends at (or just beside) a joint, each as two with a straight between.
pub fn split(model: &TubeModel, joint: &Joint) -> Vec<TubeModel> {
    let spine = model.spine();
    let near = 1.5 * model.tube_radius_mm;
    let arcs = spine.segments().iter().enumerate().filter(|(k, s)| {
        let reach = s.start_mm - near..s.start_mm + s.length_mm + near;
        k % 2 == 1 && s.length_mm > 0.0 && reach.contains(&joint.at_mm)
    });
    let apart = |(k, segment): (usize, &Segment)| {
        let mut out = model.clone();
        let share = ((joint.at_mm - segment.start_mm) / segment.length_mm).clamp(0.15, 0.85);
        let whole = out.lra.bends[k / 2];
        // At least a little apart, also where the bend itself is shorter than that.
        let length_mm = joint.shift_mm.min(segment.length_mm).max(0.1 * model.tube_radius_mm);
        out.lra.bends[k / 2].angle_rad *= share;
        let angle_rad = whole.angle_rad * (1.0 - share);
        let rotation_rad = joint.turn_rad.x.clamp(-0.5, 0.5);
        out.lra.bends.insert(k / 2 + 1, Bend { length_mm, rotation_rad, angle_rad, ..whole });
        out.ovality_mm.insert(k / 2, model.ovality_mm[k / 2]);
        with_longer_part_in_place(model, k / 2 + 1, out, k / 2 + 2)
    };
    arcs.map(apart).collect()
}

/// A bend that is much wider than the others as two of the usual radius, at a quarter and three quarters of it: an arc strays
/// least from two short bends when it is twice as long as they are apart.
pub fn doubled(model: &TubeModel, i: usize) -> Option<TubeModel> {
    let whole = model.lra.bends[i];
    let usual = mean_radius_mm(model)?;
    if whole.radius_mm < WIDE * usual || whole.angle_rad <= 0.0 {
        return None;
    }
    let mut out = model.clone();
    let half = Bend { angle_rad: 0.5 * whole.angle_rad, radius_mm: usual, ..whole };
    let spare = (whole.radius_mm - usual) * whole.angle_rad;
    out.lra.bends[i] = Bend { length_mm: whole.length_mm + 0.25 * spare, ..half };
    out.lra.bends.insert(i + 1, Bend { length_mm: 0.5 * spare, rotation_rad: 0.0, ..half });
    out.ovality_mm.insert(i, 0.0);
    match out.lra.bends.get_mut(i + 2) {
        Some(next) => next.length_mm += 0.25 * spare,
        None => out.lra.last_length_mm += 0.25 * spare,
    }
    Some(with_longer_part_in_place(model, i + 1, out, i + 2))
}

/// Bends the other way with no straight between, drawn apart by a tube radius; both arcs give way. A straight at its least
/// length is a trap: both angles and the CLR have grown to make up for it. None for other bends.
pub fn drawn_apart(model: &TubeModel, i: usize) -> Option<TubeModel> {
    let radius = model.tube_radius_mm;
    let other_way = model.lra.bends[i].rotation_rad.abs() > std::f64::consts::FRAC_PI_2;
    if i == 0 || !other_way || model.lra.bends[i].length_mm > NO_STRAIGHT * radius {
        return None;
    }
    let mut out = model.clone();
    let pair = &mut out.lra.bends[i - 1..=i];
    let arcs = pair[0].radius_mm + pair[1].radius_mm;
    pair.iter_mut().for_each(|b| b.angle_rad = (b.angle_rad - radius / arcs).max(0.0));
    pair[1].length_mm += radius;
    Some(with_longer_part_in_place(model, i + 1, out, i + 1))
}

/// The tube with all bends that are much wider than the others as two.
pub fn with_wide_doubled(model: &TubeModel) -> TubeModel {
    (0..model.lra.bends.len()).rev().fold(model.clone(), |out, i| doubled(&out, i).unwrap_or(out))
}

/// The tube with the shallow bend that a joint asks for. Where the joint lies on (or near the end of) an arc the
/// straights beside it are tried.
pub fn with_bend(model: &TubeModel, joint: &Joint) -> Vec<TubeModel> {
    let spine = model.spine();
    let segments = spine.segments();
    let near = 1.5 * model.tube_radius_mm;
    let lines = segments.iter().enumerate().filter(|(k, s)| {
        let (from, to) = (s.start_mm - near, s.start_mm + s.length_mm + near);
        let beside = |arc: Option<&Segment>| {
            arc.is_some_and(|a| (a.start_mm..=a.start_mm + a.length_mm).contains(&joint.at_mm))
        };
        let next_to = (*k > 0 && beside(segments.get(k - 1))) || beside(segments.get(k + 1));
        k % 2 == 0 && ((from..=to).contains(&joint.at_mm) || next_to)
    });
    let place = |(k, segment): (usize, &Segment)| {
        let along = (joint.at_mm - segment.start_mm).clamp(0.1 * segment.length_mm, 0.9 * segment.length_mm);
        insert(model, k / 2, along, joint)
    };
    lines.map(place).collect()
}

/// Puts a bend into straight `row`, turning as the joint does.
fn insert(model: &TubeModel, row: usize, along_mm: f64, joint: &Joint) -> TubeModel {
    let mut out = model.clone();
    let radius_mm = mean_radius_mm(model).unwrap_or(6.0 * model.tube_radius_mm);
    let angle_rad = joint.turn_rad.yz().norm().clamp(TRIAL_RAD, 20.0 * TRIAL_RAD);
    // The plane's normal (0, y, z) is the frame's z axis rolled about x.
    let roll = (-joint.turn_rad.y).atan2(joint.turn_rad.z);
    let before = out.lra.bends.get(row).map_or(0.0, |b| b.rotation_rad);
    let half = 0.5 * radius_mm * angle_rad;
    let bend =
        Bend { length_mm: (along_mm - half).max(0.0), rotation_rad: before + roll, angle_rad, radius_mm };
    match out.lra.bends.get_mut(row) {
        Some(next) => {
            next.length_mm = (next.length_mm - along_mm - half).max(0.0);
            next.rotation_rad = -roll;
        }
        None => out.lra.last_length_mm = (out.lra.last_length_mm - along_mm - half).max(0.0),
    }
    out.lra.bends.insert(row, bend);
    out.ovality_mm.insert(row, 0.0);
    turn_into_pose(&mut out);
    with_longer_part_in_place(model, row, out, row + 1)
}
