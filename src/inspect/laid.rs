//! Lays a measured tube out on the nominal's radii, so that it can be compared point by point.
//!
//! A scan knows where two straights' axes meet far better than where the bend between them begins: the errors
//! of a straight's length and of its neighbour's CLR cancel in the distance of the corners. So corners are
//! laid out, and the tangent points that are compared are those which the nominal's radius puts there; a bend
//! that grew in radius moves none of its straights. From 150 degrees on the corner runs away and the measured
//! tangent points themselves are used.

use nalgebra::Point3;

use crate::tube::{Bend, Frame, Lra, MeasuredTube, Spine, StraightPoints};

/// A value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Known {
    /// The value.
    pub value: f64,
    /// One standard deviation in the same unit.
    pub sigma: f64,
}

/// Taken where a length comes without its sigma (other programs' files).
const ASSUMED_LENGTH_SIGMA_MM: f64 = 0.1;

/// Direction of an axis, from which an unstated sigma of a rotation follows: it grows as 1 / sin(angle) of the
/// shallower bend (field: 0.05 degree). Beyond 90 degrees the offset of the straights holds the plane.
const ASSUMED_AXIS_SIGMA_RAD: f64 = 0.05 * std::f64::consts::PI / 180.0;

/// Which bends have a usable corner: below 150 degrees both measured and wanted. Needs equal bend counts.
pub fn corners(measured: &MeasuredTube, nominal: &Lra) -> Vec<bool> {
    let limit = MeasuredTube::INTERSECTION_LIMIT_RAD;
    let both = measured.bends.iter().zip(&nominal.bends);
    both.map(|(m, n)| m.angle_rad < limit && n.angle_rad < limit).collect()
}

/// From a corner to its tangent point; 0 where the tangent point itself is the mark.
fn tangent(corner: bool, radius_mm: f64, angle_rad: f64) -> f64 {
    if corner { radius_mm * (angle_rad / 2.0).tan() } else { 0.0 }
}

/// The bends at the two sides of straight `j`.
fn sides(j: usize, bends: usize) -> impl Iterator<Item = usize> {
    [j.checked_sub(1), (j < bends).then_some(j)].into_iter().flatten()
}

/// Distances end - mark, mark - mark, ..., mark - end, where a bend's mark is its corner or (no corner) its
/// tangent point. From the scan's own intersection distances, else from its lengths and radii.
pub fn distances(measured: &MeasuredTube, corner: &[bool]) -> Vec<Option<Known>> {
    let n = measured.bends.len();
    let one = |j: usize| -> Option<Known> {
        let given = measured.intersection_mm.get(j).copied().flatten();
        if let Some(value) = given.filter(|_| sides(j, n).all(|i| corner[i])) {
            let sigma = measured.intersection_sigma_mm.get(j).copied().flatten();
            return Some(Known { value, sigma: sigma.unwrap_or(ASSUMED_LENGTH_SIGMA_MM) });
        }
        let (length, sigma) = if j < n {
            (measured.bends[j].length_mm, measured.bends[j].length_sigma_mm)
        } else {
            (measured.last_length_mm, measured.last_length_sigma_mm)
        };
        let mut value = length?;
        for i in sides(j, n).filter(|&i| corner[i]) {
            value += tangent(true, measured.bends[i].radius_mm?, measured.bends[i].angle_rad);
        }
        // The radius' error would cancel in part: the length's sigma alone is the better account.
        Some(Known { value, sigma: sigma.unwrap_or(ASSUMED_LENGTH_SIGMA_MM) })
    };
    (0..=n).map(one).collect()
}

/// The same distances of a table.
pub fn table_distances(lra: &Lra, corner: &[bool]) -> Vec<f64> {
    let n = lra.bends.len();
    let length = |j: usize| if j < n { lra.bends[j].length_mm } else { lra.last_length_mm };
    let side = |i: usize| tangent(corner[i], lra.bends[i].radius_mm, lra.bends[i].angle_rad);
    (0..=n).map(|j| length(j) + sides(j, n).map(side).sum::<f64>()).collect()
}

/// Rotation of bend `i` against the one before; the first has none.
pub fn rotation(measured: &MeasuredTube, i: usize) -> Option<Known> {
    let bend = &measured.bends[i];
    let value = bend.rotation_rad?;
    let before = measured.bends[i.checked_sub(1)?].angle_rad;
    let shallower = before.min(bend.angle_rad).clamp(1e-3, std::f64::consts::FRAC_PI_2);
    let assumed = ASSUMED_AXIS_SIGMA_RAD / shallower.sin();
    Some(Known { value, sigma: bend.rotation_sigma_rad.unwrap_or(assumed) })
}

/// The measured values that place the straights, and what stands in where one is unknown.
#[derive(Debug, Clone)]
pub struct Layout {
    corner: Vec<bool>,
    /// Between marks, see [`distances`].
    pub distance: Vec<Option<Known>>,
    /// Against the bend before; None in the first row.
    pub rotation: Vec<Option<Known>>,
    /// Always known.
    pub angle: Vec<Known>,
    radius_mm: Vec<f64>,
    fallback: Lra,
}

impl Layout {
    /// For a measurement with as many bends as the nominal.
    pub fn new(measured: &MeasuredTube, nominal: &Lra) -> Layout {
        let corner = corners(measured, nominal);
        let radius = |i: usize| {
            let own = measured.bends[i].radius_mm.filter(|_| !corner[i]);
            own.unwrap_or(nominal.bends[i].radius_mm)
        };
        let bends = 0..measured.bends.len();
        let angle = |b: &crate::tube::MeasuredBend| Known { value: b.angle_rad, sigma: b.angle_sigma_rad };
        Layout {
            distance: distances(measured, &corner),
            rotation: bends.clone().map(|i| rotation(measured, i)).collect(),
            angle: measured.bends.iter().map(angle).collect(),
            radius_mm: bends.map(radius).collect(),
            fallback: nominal.clone(),
            corner,
        }
    }

    /// The tube as a table on the nominal's radii. Where bends lie closer than those radii allow a length
    /// comes out negative; unknown values are the nominal's.
    pub fn lra(&self) -> Lra {
        let n = self.angle.len();
        let wanted = table_distances(&self.fallback, &self.corner);
        let side = |i: usize| tangent(self.corner[i], self.radius_mm[i], self.angle[i].value);
        let length =
            |j: usize| self.distance[j].map_or(wanted[j], |d| d.value) - sides(j, n).map(side).sum::<f64>();
        let bend = |i: usize| Bend {
            length_mm: length(i),
            rotation_rad: self.rotation[i].map_or(self.fallback.bends[i].rotation_rad, |r| r.value),
            angle_rad: self.angle[i].value,
            radius_mm: self.radius_mm[i],
        };
        Lra { bends: (0..n).map(bend).collect(), last_length_mm: length(n) }
    }

    /// Check points of every straight in the measured tube's own frame.
    pub fn points(&self) -> Vec<[Point3<f64>; 3]> {
        points_of(&self.lra())
    }

    /// Which check points (start, middle, end of each straight) the measurement really carries. An unknown
    /// distance or rotation inside the tube breaks it in two whose relative pose is unknown: the longest
    /// unbroken part is kept.
    pub fn known_points(&self) -> Vec<[bool; 3]> {
        let n = self.angle.len();
        let broken =
            |j: usize| (1..n).contains(&j) && (self.distance[j].is_none() || self.rotation[j].is_none());
        // Runs of bends first..=last without a break between them.
        let (mut best, mut first) = (0..=0, 0);
        for last in 0..n {
            if last > 0 && broken(last) {
                first = last;
            }
            if last - first > best.end() - best.start() || last == 0 {
                best = first..=last;
            }
        }
        let point = |j: usize| {
            let length = self.distance[j].is_some();
            if n == 0 {
                return [length; 3];
            }
            // A straight hangs on the run by the bend at its start or at its end.
            let (at_start, at_end) = (j > 0 && best.contains(&(j - 1)), j < n && best.contains(&j));
            let any = at_start || at_end;
            [at_start || (any && length), any && length, at_end || (any && length)]
        };
        (0..=n).map(point).collect()
    }
}

/// Check points of a table's straights, laid out from the origin.
pub fn points_of(lra: &Lra) -> Vec<[Point3<f64>; 3]> {
    let spine = Spine::from_lra(lra, Frame::identity());
    spine.straights().iter().map(|s: &StraightPoints| [s.start, s.middle, s.end]).collect()
}
