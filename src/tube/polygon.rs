//! XYZ: the control polygon of ends and corners that drawings give, and its conversion to and from LRA.
//!
//! Paper 000, section 5.2, names its limits: no bend of 180 degrees or more, and corners too close
//! together make no tube; both are errors here. Formulas: angles by atan2 of cross and dot, never acos.

use nalgebra::{Point3, Rotation3, UnitQuaternion, Vector3};

use super::{Bend, Frame, Lra, Spine, TubeError};

/// One point of the polygon.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Where the two straights' axes meet (or the tube ends).
    pub point: Point3<f64>,
    /// CLR of the bend here; unused at the two ends.
    pub radius_mm: f64,
}

/// First end, corners, last end.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ControlPolygon {
    /// At least two points.
    pub corners: Vec<Corner>,
}

/// Angle below which a corner counts as straight: its plane would be noise.
const STRAIGHT_RAD: f64 = 1e-9;

/// An overlap within rounding of published tables is a straight of length 0.
const ROUNDING_MM: f64 = 1e-6;

impl ControlPolygon {
    /// Corners of a tube laid out from `start`. Zero-angle rows vanish. Fails for a bend of 180 degrees or more.
    pub fn from_lra(lra: &Lra, start: Frame) -> Result<ControlPolygon, TubeError> {
        for (i, b) in lra.bends.iter().enumerate() {
            if b.angle_rad >= std::f64::consts::PI - 1e-9 {
                return Err(TubeError::NoCorner { bend: i + 1, angle_deg: b.angle_rad.to_degrees() });
            }
        }
        let merged = lra.merged();
        let spine = Spine::from_lra(&merged, start);
        let mut corners = vec![Corner { point: spine.point_at(0.0), radius_mm: 0.0 }];
        for (bend, arc) in merged.bends.iter().zip(spine.segments().iter().skip(1).step_by(2)) {
            let tangent = bend.radius_mm * (bend.angle_rad / 2.0).tan();
            corners.push(Corner {
                point: arc.start * Point3::new(tangent, 0.0, 0.0),
                radius_mm: bend.radius_mm,
            });
        }
        corners.push(Corner { point: spine.point_at(spine.length_mm()), radius_mm: 0.0 });
        Ok(ControlPolygon { corners })
    }

    /// The LRA table, and the pose that puts the tube where the polygon is. Straight corners are merged; fails
    /// for folds, overlaps, and values that are no numbers or out of range.
    pub fn to_lra(&self) -> Result<(Lra, Frame), TubeError> {
        let corners = self.without_straight_corners()?;
        let legs: Vec<Vector3<f64>> = corners.windows(2).map(|w| w[1].point - w[0].point).collect();
        let directions: Vec<Vector3<f64>> = legs.iter().map(|l| l.normalize()).collect();
        let angles: Vec<f64> =
            directions.windows(2).map(|w| w[0].cross(&w[1]).norm().atan2(w[0].dot(&w[1]))).collect();
        let normals: Vec<Vector3<f64>> =
            directions.windows(2).map(|w| w[0].cross(&w[1]).normalize()).collect();
        let tangents: Vec<f64> =
            angles.iter().zip(&corners[1..]).map(|(a, c)| c.radius_mm * (a / 2.0).tan()).collect();
        let straight = |leg: usize| -> Result<f64, TubeError> {
            let before = if leg > 0 { tangents[leg - 1] } else { 0.0 };
            let after = tangents.get(leg).copied().unwrap_or(0.0);
            let (distance_mm, needed_mm) = (legs[leg].norm(), before + after);
            if distance_mm - needed_mm < -ROUNDING_MM {
                return Err(TubeError::Overlap { from: leg + 1, to: leg + 2, needed_mm, distance_mm });
            }
            // Rounding of a published table may leave a straight a hair below 0; a NaN stays one.
            let rest_mm = distance_mm - needed_mm;
            Ok(if rest_mm < 0.0 { 0.0 } else { rest_mm })
        };
        let mut lra = Lra::default();
        for (i, &angle_rad) in angles.iter().enumerate() {
            let rotation_rad = if i == 0 {
                0.0
            } else {
                let (n, m) = (normals[i - 1], normals[i]);
                n.cross(&m).dot(&directions[i]).atan2(n.dot(&m))
            };
            let radius_mm = corners[i + 1].radius_mm;
            lra.bends.push(Bend { length_mm: straight(i)?, rotation_rad, angle_rad, radius_mm });
        }
        lra.last_length_mm = straight(legs.len() - 1)?;
        lra.validate()?;
        let x = directions[0];
        let z = normals.first().copied().unwrap_or_else(|| any_normal(&x));
        let axes = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]);
        let start = Frame::from_parts(corners[0].point.into(), UnitQuaternion::from_rotation_matrix(&axes));
        Ok((lra, start))
    }

    fn without_straight_corners(&self) -> Result<Vec<Corner>, TubeError> {
        let mut kept: Vec<Corner> = Vec::new();
        for corner in &self.corners {
            // Written so that a NaN is kept, for `validate` to refuse, and not dropped as a double.
            let double = kept.last().is_some_and(|last| (corner.point - last.point).norm() <= 1e-9);
            if !double {
                kept.push(*corner);
            }
        }
        if kept.len() < 2 {
            return Err(TubeError::TooFewPoints { found: kept.len() });
        }
        let mut out = vec![kept[0]];
        for i in 1..kept.len() - 1 {
            let before = (kept[i].point - out[out.len() - 1].point).normalize();
            let after = (kept[i + 1].point - kept[i].point).normalize();
            let turn = before.cross(&after).norm().atan2(before.dot(&after));
            if turn > std::f64::consts::PI - 1e-9 {
                return Err(TubeError::Fold { corner: i + 1 });
            }
            if turn.is_nan() || turn > STRAIGHT_RAD {
                out.push(kept[i]);
            }
        }
        out.push(kept[kept.len() - 1]);
        Ok(out)
    }
}

/// Some unit vector across `direction`, always the same one.
pub fn any_normal(direction: &Vector3<f64>) -> Vector3<f64> {
    let axis = if direction.z.abs() < 0.9 { Vector3::z() } else { Vector3::y() };
    direction.cross(&axis).normalize()
}
