//! How the simulated tube was cut to length: square or oblique, clean or with a burr.
//!
//! An end is a half-space that clips the straight it belongs to. The scan's `solid` asks it how far a point is from
//! the clipped tube.

use std::f64::consts::{PI, TAU};

use nalgebra::{Point3, Vector3};

use crate::tube::Frame;

/// One end of the tube. The default is a clean square cut. The cut goes through the end of the centre line, so the
/// tube's length is measured on its axis. An end that lies in a bend is always clean and square.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EndShape {
    /// Angle of the face from square.
    pub cut_rad: f64,
    /// Around the tube, from the spine's y axis towards its z axis: where the tube is longest.
    pub longest_rad: f64,
    /// What the saw left.
    pub burr: Option<Burr>,
}

/// A ragged lip on a part of the edge. It stands out along the tube and outwards.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Burr {
    /// Its highest teeth.
    pub height_mm: f64,
    /// Where it begins, around the tube like [`EndShape::longest_rad`].
    pub from_rad: f64,
    /// How far around it goes.
    pub over_rad: f64,
}

/// How far from the edge a burr reaches, along the tube and towards its axis, in its heights.
const FADE_HEIGHTS: f64 = 2.0;
/// Width of a tooth in heights: no steeper than a ray can be followed to.
const TOOTH_HEIGHTS: f64 = 4.0;
/// Share of the burr's field that is safe to advance: teeth and flare are slopes.
const BURR_STRIDE: f64 = 0.3;

/// An end in its place.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cut {
    pub centre: Point3<f64>,
    normal: Vector3<f64>,
    y: Vector3<f64>,
    z: Vector3<f64>,
    radius_mm: f64,
    shape: EndShape,
}

/// A point seen from a clipped straight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clipped {
    /// Distance from its surface, below 0 inside.
    pub distance_mm: f64,
    /// Share of it that is safe to advance.
    pub stride: f64,
    /// Whether the nearest surface is the face.
    pub face: bool,
}

impl Cut {
    /// `frame` is the spine's at the end, `sign` is 1 where its x axis points out of the tube and -1 at the first end.
    pub fn new(frame: &Frame, sign: f64, radius_mm: f64, shape: EndShape) -> Cut {
        let [x, y, z] = [Vector3::x(), Vector3::y(), Vector3::z()].map(|v| frame.rotation * v);
        let (sin, cos) = shape.longest_rad.sin_cos();
        let normal = x * (sign * shape.cut_rad.cos()) - (y * cos + z * sin) * shape.cut_rad.sin();
        Cut { centre: frame.translation.vector.into(), normal, y, z, radius_mm, shape }
    }

    /// How far the tube goes on beyond the end of its centre line.
    pub fn overhang_mm(&self) -> f64 {
        self.radius_mm * self.shape.cut_rad.tan().abs()
            + 2.0 * self.shape.burr.map_or(0.0, |b| b.height_mm.max(0.0))
    }

    /// Distance beyond the face.
    pub fn beyond_mm(&self, p: &Point3<f64>) -> f64 {
        self.normal.dot(&(p - self.centre))
    }

    /// The straight's field at a point `lateral_mm` from its outside, clipped.
    pub fn clip(&self, p: &Point3<f64>, lateral_mm: f64) -> Clipped {
        let beyond = self.beyond_mm(p);
        let plain = Clipped { distance_mm: lateral_mm.max(beyond), stride: 1.0, face: beyond > lateral_mm };
        let Some(burr) = self.shape.burr.filter(|b| b.height_mm > 0.0 && b.over_rad > 0.0) else {
            return plain;
        };
        // Nothing of the burr is closer than this.
        let free = plain.distance_mm - burr.height_mm;
        if free > burr.height_mm {
            return Clipped { distance_mm: free, ..plain };
        }
        let from = p - self.centre;
        let height = burr.height_at(from.dot(&self.z).atan2(from.dot(&self.y)), self.radius_mm);
        // Outwards it fades along the tube, along the tube it fades towards the bore.
        let fade = |depth_mm: f64| (1.0 - depth_mm.max(0.0) / (FADE_HEIGHTS * burr.height_mm)).max(0.0);
        let lateral = lateral_mm - height * fade(-beyond);
        let beyond = beyond - height * fade(-lateral_mm);
        Clipped { distance_mm: lateral.max(beyond), stride: BURR_STRIDE, face: beyond > lateral }
    }
}

impl Burr {
    /// Height at a place around the tube: teeth of two widths under an arch.
    fn height_at(&self, around_rad: f64, radius_mm: f64) -> f64 {
        let share = (around_rad - self.from_rad).rem_euclid(TAU) / self.over_rad;
        if share >= 1.0 {
            return 0.0;
        }
        let arch = (PI * share).sin().powi(2);
        let teeth = TAU * share * self.over_rad * radius_mm / (TOOTH_HEIGHTS * self.height_mm);
        self.height_mm * arch * (0.5 + 0.25 * (teeth.sin() + (0.618 * teeth).sin()))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Density, ScanSettings, SimulatedScan, TubeShape, scan};
    use super::*;
    use crate::tube::Lra;

    /// A tube of 20 mm along x from 0 to 200, seen slantwise onto its first face, without noise.
    fn seen(end: EndShape) -> SimulatedScan {
        let lra = Lra { bends: vec![], last_length_mm: 200.0 };
        let square = EndShape::default();
        let shape = TubeShape { wall_mm: 2.0, ends: [end, square], ..TubeShape::round(lra, 20.0) };
        let settings = ScanSettings {
            density: Density::Points(60_000),
            noise_mm: 0.0,
            outlier_share: 0.0,
            random_pose: false,
            sight: Some(Vector3::new(1.0, 0.0, -1.0)),
            ..ScanSettings::default()
        };
        scan(&shape, &settings, 5)
    }

    /// On the outside, the face's plane, the bore: and nothing else.
    fn counts(scan: &SimulatedScan, beyond: impl Fn(&Point3<f64>) -> f64) -> [usize; 3] {
        let mut counts = [0; 3];
        for p in &scan.points {
            let (ring, beyond) = (p.y.hypot(p.z), beyond(p));
            if (ring - 10.0).abs() < 1e-6 && beyond < 1e-6 {
                counts[0] += 1;
            } else if beyond.abs() < 1e-6 && (8.0 - 1e-6..10.0).contains(&ring) {
                counts[1] += 1;
            } else {
                assert!((ring - 8.0).abs() < 1e-6 && (-10.0..0.0).contains(&beyond), "{p}");
                counts[2] += 1;
            }
        }
        counts
    }

    #[test]
    fn with_a_wall_the_face_and_a_little_of_the_bore_show() {
        let [outside, face, bore] = counts(&seen(EndShape::default()), |p| -p.x);
        assert!(outside > 20_000 && face > 300 && bore > 300, "{outside} {face} {bore}");
    }

    #[test]
    fn an_oblique_face_lies_on_its_plane_and_the_tube_goes_on_to_it() {
        let (cut_rad, longest_rad) = (0.08, 2.0);
        let scan = seen(EndShape { cut_rad, longest_rad, burr: None });
        let along = |p: &Point3<f64>| p.y * longest_rad.cos() + p.z * longest_rad.sin();
        // Longest towards `longest_rad`: there the face lies before x = 0.
        let beyond = |p: &Point3<f64>| -p.x * cut_rad.cos() - along(p) * cut_rad.sin();
        let [_, face, _] = counts(&scan, beyond);
        assert!(face > 300, "{face}");
        let least = scan.points.iter().map(|p| p.x).fold(f64::INFINITY, f64::min);
        assert!((least + 10.0 * cut_rad.tan()).abs() < 0.2, "{least}");
    }

    #[test]
    fn a_burr_stands_out_by_its_height_where_it_is_and_nowhere_else() {
        let burr = Burr { height_mm: 0.3, from_rad: 1.0, over_rad: 1.2 };
        let scan = seen(EndShape { burr: Some(burr), ..EndShape::default() });
        let around = |p: &Point3<f64>| p.z.atan2(p.y).rem_euclid(TAU);
        let (mut along, mut out) = (0f64, 0f64);
        for p in &scan.points {
            let (before, outside) = (-p.x, p.y.hypot(p.z) - 10.0);
            if before > 1e-6 || outside > 1e-6 {
                assert!((1.0..2.2).contains(&around(p)), "{p}");
            }
            (along, out) = (along.max(before), out.max(outside));
        }
        assert!((0.1..=0.3).contains(&along) && (0.1..=0.3).contains(&out), "{along} {out}");
    }
}
