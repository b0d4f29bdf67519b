//! Deviations: check points after a named alignment, and the LRA values beside their tolerances.

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use super::laid::{Known, Layout, points_of};
use crate::tube::align::{Pair, Registration, register};
use crate::tube::{Alignment, Frame, Lra, Spine};

/// A deviation against its tolerance with a guard band of two sigmas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// At most tolerance - 2 sigma.
    In,
    /// More than tolerance + 2 sigma.
    Out,
    /// Between: the scan cannot tell.
    Uncertain,
}

/// Judges a deviation (field: acceptance with guard band).
pub fn judge(deviation: f64, tolerance: f64, sigma: f64) -> State {
    if deviation.abs() <= tolerance - 2.0 * sigma {
        State::In
    } else if deviation.abs() > tolerance + 2.0 * sigma {
        State::Out
    } else {
        State::Uncertain
    }
}

/// Which of a straight's three check points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Place {
    /// Tangent point where the straight begins; the tube's end in the first straight.
    Start,
    /// Half way.
    Middle,
    /// Tangent point where it ends; the tube's end in the last straight.
    End,
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Place::Start => "start",
            Place::Middle => "middle",
            Place::End => "end",
        })
    }
}

/// One check point, measured tube laid over the nominal.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PointDeviation {
    /// Straight counted from 1 in the nominal's feed order.
    pub straight: usize,
    /// Where on it.
    pub place: Place,
    /// The nominal point; first straight along +x from the origin, first bend towards +y.
    pub nominal_mm: [f64; 3],
    /// The measured point after alignment.
    pub measured_mm: [f64; 3],
    /// Their distance, >= 0.
    pub deviation_mm: f64,
    /// The part of it along the straight (positive: measured lies farther on).
    pub along_mm: f64,
    /// Sigma of the point's position in its worst direction.
    pub sigma_mm: f64,
    /// Against the envelope's radius.
    pub state: State,
}

/// All check points that the measurement carries, after alignment.
pub struct Compared {
    /// Laid over by this alignment.
    pub rms_mm: f64,
    /// In feed order.
    pub points: Vec<PointDeviation>,
}

/// Compares point by point; None when no point that the alignment needs is known.
///
/// Sigmas: every measured distance, rotation and angle is moved by its own sigma, the tube laid out and aligned
/// anew, and the points' movements added as independent. That includes what the alignment absorbs; it leaves
/// out correlations between the values, which the use of corner distances makes small.
pub fn compare(layout: &Layout, nominal: &Lra, alignment: Alignment, envelope_mm: f64) -> Option<Compared> {
    let wanted = points_of(nominal);
    let known = layout.known_points();
    let weights = weights(&known, &wanted, alignment);
    let Aligned { points: base, rms_mm, .. } = aligned(layout.points(), &wanted, &weights)?;
    let mut covariance = vec![[Matrix3::<f64>::zeros(); 3]; wanted.len()];
    for moved in one_sigma_each(layout) {
        let Aligned { points, .. } = aligned(moved.points(), &wanted, &weights)?;
        for (c, (p, b)) in
            covariance.iter_mut().flatten().zip(points.iter().flatten().zip(base.iter().flatten()))
        {
            *c += (p - b) * (p - b).transpose();
        }
    }
    let spine = Spine::from_lra(nominal, Frame::identity());
    let mut points = Vec::new();
    for (j, places) in known.iter().enumerate() {
        let direction = direction(&spine, j);
        for (k, place) in [Place::Start, Place::Middle, Place::End].into_iter().enumerate() {
            if !places[k] {
                continue;
            }
            let off = base[j][k] - wanted[j][k];
            let sigma_mm = covariance[j][k].symmetric_eigenvalues().max().max(0.0).sqrt();
            points.push(PointDeviation {
                straight: j + 1,
                place,
                nominal_mm: wanted[j][k].into(),
                measured_mm: base[j][k].into(),
                deviation_mm: off.norm(),
                along_mm: off.dot(&direction),
                sigma_mm,
                state: judge(off.norm(), envelope_mm, sigma_mm),
            });
        }
    }
    Some(Compared { rms_mm, points })
}

type Points = Vec<[Point3<f64>; 3]>;

/// Check points laid over the nominal's.
pub(super) struct Aligned {
    /// In the nominal's frame.
    pub points: Points,
    /// What brought them there.
    pub motion: Isometry3<f64>,
    /// Weighted root mean square distance.
    pub rms_mm: f64,
}

/// Lays check points over the nominal's; None without any weight.
pub(super) fn aligned(points: Points, wanted: &Points, weights: &[[f64; 3]]) -> Option<Aligned> {
    let pairs: Vec<Pair> = points
        .iter()
        .flatten()
        .zip(wanted.iter().flatten().zip(weights.iter().flatten()))
        .filter(|(_, (_, weight))| **weight > 0.0)
        .map(|(from, (to, weight))| Pair { from: *from, to: *to, weight: *weight })
        .collect();
    let Registration { motion, rms_mm } = register(&pairs)?;
    let points = points.iter().map(|straight| straight.map(|p| motion * p)).collect();
    Some(Aligned { points, motion, rms_mm })
}

/// How much each check point counts in the alignment. A single straight leaves the turn about itself open:
/// the next one decides that alone, with a weight that cannot pull the straight away.
pub(super) fn weights(known: &[[bool; 3]], wanted: &Points, alignment: Alignment) -> Vec<[f64; 3]> {
    const TURN_ONLY: f64 = 1e-6;
    let last = known.len() - 1;
    let of_straight = |j: usize| match alignment {
        Alignment::BestFit => 1.0,
        Alignment::Weighted => (wanted[j][2] - wanted[j][0]).norm().max(1e-3),
        Alignment::AEnd if j == 0 => 1.0,
        Alignment::BEnd if j == last => 1.0,
        Alignment::AEnd if j == 1 => TURN_ONLY,
        Alignment::BEnd if j + 1 == last => TURN_ONLY,
        Alignment::Fixture if j == 0 || j == last => 1.0,
        Alignment::AEnd | Alignment::BEnd | Alignment::Fixture => 0.0,
    };
    let held = |weight: f64| weight > TURN_ONLY;
    let weights: Vec<[f64; 3]> = (known.iter().enumerate())
        .map(|(j, k)| k.map(|known| if known { of_straight(j) } else { 0.0 }))
        .collect();
    // An alignment on a straight that was not measured would be an invention: no weight, no answer.
    if weights.iter().flatten().any(|&w| held(w)) { weights } else { vec![[0.0; 3]; known.len()] }
}

fn direction(spine: &Spine, straight: usize) -> Vector3<f64> {
    spine.segments().get(2 * straight).map_or(Vector3::x(), |s| s.start * Vector3::x())
}

/// The layout with one value after the other moved by its sigma.
fn one_sigma_each(layout: &Layout) -> Vec<Layout> {
    let mut out = Vec::new();
    let mut push = |pick: &dyn Fn(&mut Layout) -> Option<&mut Known>| {
        let mut moved = layout.clone();
        if let Some(known) = pick(&mut moved) {
            known.value += known.sigma;
            out.push(moved);
        }
    };
    for i in 0..layout.angle.len() {
        push(&|l| Some(&mut l.angle[i]));
        push(&|l| l.rotation[i].as_mut());
    }
    for j in 0..layout.distance.len() {
        push(&|l| l.distance[j].as_mut());
    }
    out
}

/// A measured value beside the wanted one, in the unit of the field's name.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Comparison {
    /// What the part file says.
    pub nominal: f64,
    /// What was measured; null is not known.
    pub measured: Option<f64>,
    /// Its sigma.
    pub sigma: Option<f64>,
    /// Measured - nominal (rotations wrapped).
    pub deviation: Option<f64>,
    /// The part's tolerance; null where it has none or nothing was measured.
    pub tolerance: Option<f64>,
    /// Against the part's tolerance; null where there is no tolerance or no value.
    pub state: Option<State>,
}

/// One row of the table compared.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BendDeviation {
    /// Counted from 1 in the nominal's feed order.
    pub bend: usize,
    /// Straight before the bend, as it would be on the nominal's radii.
    pub length_mm: Comparison,
    /// Turn against the bend before.
    pub rotation_deg: Comparison,
    /// Bend angle.
    pub angle_deg: Comparison,
    /// CLR as formed: information, no tolerance.
    pub radius_mm: Comparison,
}
