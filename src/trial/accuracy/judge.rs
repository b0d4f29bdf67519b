//! One reconstruction against its truth: the error of every value beside its reported sigma and its bound.

use nalgebra::Point3;

use crate::reconstruct::Reconstruction;
use crate::reconstruct::bound::{Bound, cramer_rao};
use crate::reconstruct::model::{Flattening, TubeModel};
use crate::sim::scan::{PointKind, ScanSettings, SimulatedScan, TubeShape, UnseenEnd};
use crate::tube::{Lra, MeasuredTube, wrap_angle};

/// What a value is. Angles are in degrees here, as the trade speaks of them; the rest in millimetres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Bend angle.
    Angle,
    /// Rotation between two bends.
    Rotation,
    /// Straight between two bends.
    Length,
    /// Straight to an end of the tube: no bound.
    EndLength,
    /// Distance of two corners.
    Intersection,
    /// Distance from a corner to an end of the tube: no bound.
    EndIntersection,
    /// Centre-line radius.
    Clr,
    /// Outer radius of the tube; reported without a sigma.
    TubeRadius,
}

impl Kind {
    /// All, in the order of the tables.
    pub const ALL: [Kind; 8] = [
        Kind::Angle,
        Kind::Rotation,
        Kind::Length,
        Kind::EndLength,
        Kind::Intersection,
        Kind::EndIntersection,
        Kind::Clr,
        Kind::TubeRadius,
    ];

    /// Its name with its unit.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Angle => "angle deg",
            Kind::Rotation => "rotation deg",
            Kind::Length => "length mm",
            Kind::EndLength => "end length mm",
            Kind::Intersection => "intersection mm",
            Kind::EndIntersection => "end intersection mm",
            Kind::Clr => "CLR mm",
            Kind::TubeRadius => "tube radius mm",
        }
    }

    /// The error from which on a value that is claimed to be certain does harm. Lengths and CLR do none by themselves:
    /// their harm shows in the intersection distances.
    fn harmful(self) -> Option<f64> {
        match self {
            Kind::Angle => Some(0.3),
            Kind::Rotation => Some(1.0),
            Kind::Intersection | Kind::EndIntersection => Some(0.5),
            _ => None,
        }
    }
}

/// An error of this many reported sigmas was not announced.
const UNANNOUNCED: f64 = 6.0;

/// One value that the data was asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Value {
    /// What it is.
    pub kind: Kind,
    /// Row (bend, or straight before it) counted from 1.
    pub row: usize,
    /// Measured less true; None when it was not given.
    pub error: Option<f64>,
    /// Reported standard deviation.
    pub sigma: Option<f64>,
    /// Least possible standard deviation.
    pub bound: Option<f64>,
}

impl Value {
    /// Whether it is far off and was said to be certain.
    pub fn is_silently_wrong(&self) -> bool {
        match (self.error, self.sigma, self.kind.harmful()) {
            (Some(error), Some(sigma), Some(limit)) => error.abs() > limit.max(UNANNOUNCED * sigma),
            _ => false,
        }
    }
}

/// What became of a case.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// Number of bends right, and no value silently wrong.
    Right,
    /// Another number of bends.
    WrongCount(usize),
    /// Number of bends right, values far off that were said to be certain.
    SilentlyWrong,
    /// An error instead of a result.
    Refused(String),
}

/// A verdict, and the values where the number of bends is right.
#[derive(Debug, Clone, PartialEq)]
pub struct Judgement {
    /// What became of it.
    pub verdict: Verdict,
    /// In the truth's direction and order; empty with another number of bends.
    pub values: Vec<Value>,
}

/// A refusal with its reason.
pub fn refused(reason: String) -> Judgement {
    Judgement { verdict: Verdict::Refused(reason), values: Vec::new() }
}

/// Holds a reconstruction against what was scanned, in the direction that fits better.
pub fn judge(
    found: &Reconstruction,
    shape: &TubeShape,
    settings: &ScanSettings,
    scanned: &SimulatedScan,
) -> Judgement {
    let bends = found.measured.bends.len();
    if bends != shape.lra.bends.len() {
        return Judgement { verdict: Verdict::WrongCount(bends), values: Vec::new() };
    }
    let radii = || found.lra.bends.iter().map(|b| b.radius_mm);
    let common_radius = radii().zip(radii().skip(1)).all(|(a, b)| a == b);
    let truth = true_model(shape, scanned, common_radius);
    let bound = cramer_rao(&truth, outside(shape, scanned), settings.noise_mm);
    let (forward, backward) = (&found.measured, &found.measured.reversed());
    let backwards = misfit(backward, shape) < misfit(forward, shape);
    let measured = if backwards { backward } else { forward };
    let mut values = row_values(measured, &shape.lra, &bound);
    values.extend(straight_values(measured, &shape.lra, &bound));
    if let Some(end) = settings.unseen_end {
        leave_out_unseen(&mut values, &end, bends);
    }
    values.push(Value {
        kind: Kind::TubeRadius,
        row: 1,
        error: Some(measured.tube_radius_mm - shape.od_mm / 2.0),
        sigma: None,
        bound: Some(bound.tube_radius_mm),
    });
    let silent = values.iter().any(Value::is_silently_wrong);
    Judgement { verdict: if silent { Verdict::SilentlyWrong } else { Verdict::Right }, values }
}

/// The tube that was scanned, where it was scanned, with the freedoms that the fit took.
fn true_model(shape: &TubeShape, scanned: &SimulatedScan, common_radius: bool) -> TubeModel {
    let mut lra = shape.lra.clone();
    let radius = shape.od_mm / 2.0;
    // The pose holds the first rotation.
    lra.bends.iter_mut().take(1).for_each(|b| b.rotation_rad = 0.0);
    let each = |shares: &[f64], factor: f64| -> Vec<f64> {
        (0..lra.bends.len()).map(|i| factor * radius * shares.get(i).copied().unwrap_or(0.0)).collect()
    };
    let ovality_mm = each(&shape.ovality, -0.5);
    let flattening = match shape.flattening.is_empty() {
        true => Flattening::NONE,
        false => Flattening::Free { bends_mm: each(&shape.flattening, -2.0), spread_mm: f64::INFINITY },
    };
    let start = scanned.spine.segments()[0].start;
    TubeModel { common_radius, ovality_mm, flattening, ..TubeModel::round(start, lra, radius) }
}

/// The scanned points of the tube's outside: those of the bore say nothing of it.
fn outside(shape: &TubeShape, scanned: &SimulatedScan) -> Vec<Point3<f64>> {
    let least_mm = (shape.od_mm - shape.wall_mm) / 2.0;
    let outside = |p: &Point3<f64>| shape.wall_mm == 0.0 || scanned.spine.closest(p).distance_mm > least_mm;
    let own = scanned.points.iter().zip(&scanned.kinds).filter(|(_, kind)| **kind == PointKind::Tube);
    own.map(|(p, _)| *p).filter(outside).collect()
}

/// How badly a measurement fits a tube in this direction; each value counts at most once, however far off it is.
fn misfit(m: &MeasuredTube, shape: &TubeShape) -> f64 {
    let most = |off: f64| off.abs().min(1.0);
    let truth = &shape.lra;
    let rows = m.bends.iter().zip(&truth.bends).map(|(a, b)| {
        let turned = a.rotation_rad.map_or(0.0, |r| wrap_angle(r - b.rotation_rad));
        let length = a.length_mm.map_or(0.0, |l| (l - b.length_mm) / shape.od_mm);
        most(a.angle_rad - b.angle_rad) + most(turned) + most(length)
    });
    let last = m.last_length_mm.map_or(0.0, |l| (l - truth.last_length_mm) / shape.od_mm);
    rows.sum::<f64>() + most(last)
}

/// Angles, rotations and CLR.
fn row_values(measured: &MeasuredTube, truth: &Lra, bound: &Bound) -> Vec<Value> {
    let mut values = Vec::new();
    for (i, (a, b)) in measured.bends.iter().zip(&truth.bends).enumerate() {
        let mut push = |kind, error, sigma, bound| {
            values.push(Value { kind, row: i + 1, error, sigma, bound: Some(bound) });
        };
        let degrees = |rad: Option<f64>| rad.map(f64::to_degrees);
        let (angle, sigma) = (a.angle_rad - b.angle_rad, a.angle_sigma_rad);
        push(Kind::Angle, degrees(Some(angle)), degrees(Some(sigma)), bound.angles_rad[i].to_degrees());
        if i > 0 {
            let off = a.rotation_rad.map(|r| wrap_angle(r - b.rotation_rad));
            let limit = bound.rotations_rad[i].to_degrees();
            push(Kind::Rotation, degrees(off), degrees(a.rotation_sigma_rad), limit);
        }
        let off = a.radius_mm.map(|r| r - b.radius_mm);
        push(Kind::Clr, off, a.radius_sigma_mm, bound.radii_mm[i]);
    }
    values
}

/// A straight that was scanned in part looks like one that was cut there: no data could tell its length.
pub(super) fn leave_out_unseen(values: &mut Vec<Value>, end: &UnseenEnd, bends: usize) {
    let row = if end.last { bends + 1 } else { 1 };
    values.retain(|v| v.row != row || !matches!(v.kind, Kind::EndLength | Kind::EndIntersection));
}

/// Lengths and intersection distances.
fn straight_values(measured: &MeasuredTube, truth: &Lra, bound: &Bound) -> Vec<Value> {
    let n = truth.bends.len();
    let corners = truth.intersection_distances_mm(MeasuredTube::INTERSECTION_LIMIT_RAD);
    let mut values = Vec::new();
    for (i, corner) in corners.iter().enumerate() {
        let (length, sigma, right) = match measured.bends.get(i) {
            Some(b) => (b.length_mm, b.length_sigma_mm, truth.bends[i].length_mm),
            None => (measured.last_length_mm, measured.last_length_sigma_mm, truth.last_length_mm),
        };
        let inner = i > 0 && i < n;
        let (kind, corner_kind) = match inner {
            true => (Kind::Length, Kind::Intersection),
            false => (Kind::EndLength, Kind::EndIntersection),
        };
        let error = length.map(|l| l - right);
        let limit = |bound: f64| inner.then_some(bound);
        values.push(Value { kind, row: i + 1, error, sigma, bound: limit(bound.lengths_mm[i]) });
        if let Some(right) = corner {
            let given = |list: &[Option<f64>]| list.get(i).copied().flatten();
            values.push(Value {
                kind: corner_kind,
                row: i + 1,
                error: given(&measured.intersection_mm).map(|l| l - right),
                sigma: given(&measured.intersection_sigma_mm),
                bound: limit(bound.intersections_mm[i]),
            });
        }
    }
    values
}
