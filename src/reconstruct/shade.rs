//! Whether another leg of the tube stood between the scanner and what may follow on an end: then the scan stops at that leg's
//! shadow, which crosses the end as squarely as a saw's cut may.
//!
//! Under `finish`, for `measure`. Only of a scan from one side: the sides of several fill each other's shadows.

use nalgebra::{Matrix3, Point3, Vector3};

use super::local::{prepare, settle};
use super::model::TubeModel;
use crate::tube::{Frame, Spine};

/// Points farther from the surface than this, in tube radii, have no normal of it.
const ON_SURFACE: f64 = 0.2;

/// Normals seen from one side point this much towards it on average: 0.72 to 0.79 where a half is seen, 0.62 where two sides 30
/// degrees apart were.
const ONE_SIDED: f64 = 0.66;

/// Rounds in which legs that are seen end on come to count as what they tell.
const ROUNDS: usize = 5;

/// So far beyond the end, in tube radii, a shadow that ends there is sure to lie; and where it falls is told to such an angle.
const BEYOND_RADII: f64 = 0.5;
const ASTRAY: f64 = 0.05;

/// Distance of the places of a leg that are looked at, and what is nearer than this is no leg in front, in tube radii.
const STEP_RADII: f64 = 0.5;
const IN_FRONT_RADII: f64 = 1.0;

/// The direction to the scanner, where all points were seen from about one side.
pub fn sight(points: &[Point3<f64>], model: &TubeModel) -> Option<Vector3<f64>> {
    let (locals, radius) = (prepare(model), model.tube_radius_mm);
    let mut segment = 0;
    let mut seen: Vec<(Vector3<f64>, Vector3<f64>)> = Vec::new();
    for p in points {
        let local = settle(p, &mut segment, &locals);
        let own = &locals[segment as usize];
        let at = [local.x, local.y, local.z];
        if own.residual_mm(at, radius).abs() < ON_SURFACE * radius {
            let out = |v: Vector3<f64>| own.to_local.rotation.inverse() * v;
            seen.push((out(own.outward(at)), out(own.foot(&local).1)));
        }
    }
    let sum: Vector3<f64> = seen.iter().map(|(normal, _)| normal).sum();
    let across = |sight: &Vector3<f64>, tangent: &Vector3<f64>| sight - tangent * tangent.dot(sight);
    let mut sight = sum.try_normalize(1e-9)?;
    for _ in 0..ROUNDS {
        // A leg's normals point to the scanner as far as that is across the leg.
        let each = |(_, t): &(Vector3<f64>, Vector3<f64>)| {
            (Matrix3::identity() - t * t.transpose()) / across(&sight, t).norm().max(ON_SURFACE)
        };
        let matrix: Matrix3<f64> = seen.iter().map(each).sum();
        sight = (matrix.try_inverse()? * sum).try_normalize(1e-9)?;
    }
    let towards = |(normal, t): &(Vector3<f64>, Vector3<f64>)| {
        across(&sight, t).try_normalize(1e-9).map_or(0.0, |a| a.dot(normal))
    };
    let faced = seen.iter().map(towards).sum::<f64>() / seen.len() as f64;
    (faced > ONE_SIDED).then_some(sight)
}

/// Whether a leg stands before what may follow on an end (`end`: its frame, x along the tube, from there on to the scan's end);
/// `legs`: where along the spine other legs are.
pub fn is_shaded(
    sight: &Vector3<f64>,
    spine: &Spine,
    legs: std::ops::Range<f64>,
    end: &Frame,
    radius_mm: f64,
) -> bool {
    let inwards = end.rotation * Vector3::x();
    let Some(up) = (sight - inwards * inwards.dot(sight)).try_normalize(1e-9) else { return false };
    let at = end.translation.vector - inwards * (BEYOND_RADII * radius_mm) + up * radius_mm;
    let step_mm = STEP_RADII * radius_mm;
    let count = ((legs.end - legs.start) / step_mm) as usize;
    let covers = |i: usize| {
        let way = spine.point_at(legs.start + i as f64 * step_mm).coords - at;
        let before_mm = way.dot(sight);
        let aside_mm = (way - sight * before_mm).norm();
        before_mm > IN_FRONT_RADII * radius_mm && aside_mm < radius_mm + ASTRAY * before_mm
    };
    (0..=count).any(covers)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::{Bend, Lra};

    const RADIUS: f64 = 5.0;

    /// A hook: its last straight runs back below its first, 60 mm apart.
    fn hook() -> TubeModel {
        let bend =
            |length_mm| Bend { length_mm, rotation_rad: 0.0, angle_rad: 90f64.to_radians(), radius_mm: 20.0 };
        TubeModel::round(
            Frame::identity(),
            Lra { bends: vec![bend(100.0), bend(20.0)], last_length_mm: 60.0 },
            RADIUS,
        )
    }

    /// Points of the half that faces a direction.
    fn seen_from(sights: &[Vector3<f64>]) -> Vec<Point3<f64>> {
        let spine = hook().spine();
        let mut points = Vec::new();
        for i in 0..(spine.length_mm() as usize) {
            let frame = spine.frame_at(i as f64);
            for k in 0..40 {
                let turn = f64::from(k) * 0.157;
                let out = frame.rotation * Vector3::new(0.0, turn.cos(), turn.sin());
                if sights.iter().any(|s| out.dot(s) > 0.2) {
                    points.push(Point3::from(frame.translation.vector + out * RADIUS));
                }
            }
        }
        points
    }

    #[test]
    fn the_side_that_was_scanned_from_shows_in_the_normals() {
        let side = Vector3::new(0.2, -0.9, 0.4).normalize();
        let found = sight(&seen_from(&[side]), &hook()).unwrap();
        assert!(found.angle(&side).to_degrees() < 6.0, "{found}");
        let sides = [side, Vector3::new(0.5, 0.3, -0.8)];
        assert_eq!(sight(&seen_from(&sides), &hook()), None, "two sides");
    }

    #[test]
    fn what_a_leg_stands_before_is_shaded() {
        let spine = hook().spine();
        let last = spine.segments()[4].start_mm;
        let end = spine.frame_at(spine.length_mm()) * Frame::rotation(Vector3::z() * std::f64::consts::PI);
        let shaded = |sight: Vector3<f64>| is_shaded(&sight.normalize(), &spine, 0.0..last, &end, RADIUS);
        assert!(shaded(-Vector3::y()), "the first straight is right before it");
        assert!(!shaded(Vector3::z()) && !shaded(Vector3::y()), "nothing is");
        // Seen so that the first straight's begin passes beside the end.
        assert!(!shaded(Vector3::new(0.0, -1.0, 0.6)));
    }
}
