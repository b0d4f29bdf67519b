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

/// How far back from the face a burr bends the surface out, in its heights.
const FLARE_HEIGHTS: f64 = 2.0;
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
        let depth = (-beyond).max(0.0) / (FLARE_HEIGHTS * burr.height_mm);
        let (lateral, beyond) = (lateral_mm - height * (1.0 - depth).max(0.0), beyond - height);
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
