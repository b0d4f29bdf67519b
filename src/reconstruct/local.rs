//! The segments of a model ready for many points: which one a point faces, and where along it.
//!
//! Under `moments` and `sections`, which both walk points along the tube.

use nalgebra::{Isometry3, Point3, Vector2, Vector3};

use super::model::TubeModel;
use crate::tube::SegmentKind;

/// A section turns from round to oval over this many tube radii at both ends of a bend.
const OVAL_RAMP_RADII: f64 = 1.0;

/// A segment prepared for the pass.
pub struct Local {
    pub to_local: Isometry3<f64>,
    pub length_mm: f64,
    pub arc: Option<Arc>,
    /// Directions from an arc's centre that face it, and those where its section is as oval as it gets.
    facing: Sector,
    oval: Sector,
}

/// Directions between two, as turns from the arc's start; told without an arc tangent.
#[derive(Debug, Clone, Copy)]
struct Sector {
    /// Sine and cosine of both ends.
    begin: (f64, f64),
    end: (f64, f64),
    width_rad: f64,
}

impl Sector {
    fn new(begin_rad: f64, end_rad: f64) -> Sector {
        Sector { begin: begin_rad.sin_cos(), end: end_rad.sin_cos(), width_rad: end_rad - begin_rad }
    }

    /// Whether the direction with this sine and cosine (times any length) lies between the ends.
    fn holds(&self, sin: f64, cos: f64) -> bool {
        let after = sin * self.begin.1 - cos * self.begin.0 >= 0.0;
        let before = cos * self.end.0 - sin * self.end.1 >= 0.0;
        let both = after && before;
        if self.width_rad > std::f64::consts::PI { after || before } else { both && self.width_rad > 0.0 }
    }
}

/// What makes an arc.
pub struct Arc {
    pub radius_mm: f64,
    pub angle_rad: f64,
    pub ovality_mm: f64,
    pub flattening_mm: f64,
}

/// The segments of the model, line, arc, ..., line.
pub fn prepare(model: &TubeModel) -> Vec<Local> {
    let (spine, flattenings_mm) = (model.spine(), model.flattenings_mm());
    let local = |(k, s): (usize, &crate::tube::Segment)| {
        let (mut facing, mut oval) = (Sector::new(0.0, 0.0), Sector::new(0.0, 0.0));
        let arc = match s.kind {
            SegmentKind::Arc { radius_mm, angle_rad } => {
                let (ovality_mm, flattening_mm) = (model.ovality_mm[k / 2], flattenings_mm[k / 2]);
                let arc = Arc { radius_mm, angle_rad, ovality_mm, flattening_mm };
                let full = arc.full_ramp_mm(model.tube_radius_mm) / radius_mm;
                facing = Sector::new(0.0, angle_rad);
                oval = Sector::new(full, angle_rad - full);
                Some(arc)
            }
            SegmentKind::Line => None,
        };
        Local { to_local: s.start.inverse(), length_mm: s.length_mm, arc, facing, oval }
    };
    spine.segments().iter().enumerate().map(local).collect()
}

/// Moves a point along the tube to the segment it faces; returns it in that segment's frame.
pub fn settle(p: &Point3<f64>, segment: &mut u32, locals: &[Local]) -> Point3<f64> {
    let last = locals.len() - 1;
    let mut came_from = usize::MAX;
    let mut k = (*segment as usize).min(last);
    loop {
        let local = locals[k].to_local * p;
        let next = match locals[k].side(&local) {
            -1 if k > 0 => k - 1,
            1 if k < last => k + 1,
            _ => k,
        };
        if next == k || next == came_from {
            *segment = k as u32;
            return local;
        }
        came_from = k;
        k = next;
    }
}

impl Local {
    /// Distance along the segment of the point's foot, clamped to it.
    pub fn along_mm(&self, p: &Point3<f64>) -> f64 {
        match &self.arc {
            None => p.x.clamp(0.0, self.length_mm),
            Some(arc) => {
                let turn = p.x.atan2(arc.radius_mm - p.y).rem_euclid(std::f64::consts::TAU);
                (turn * arc.radius_mm).min(self.length_mm)
            }
        }
    }

    /// Before (-1), on (0) or after (1) the segment.
    pub fn side(&self, p: &Point3<f64>) -> i32 {
        match &self.arc {
            None => i32::from(p.x > self.length_mm) - i32::from(p.x < 0.0),
            Some(arc) => {
                let angle = arc.angle_rad;
                // Turn measured from the middle of the gap opposite to the arc, so that it wraps there.
                let turn = p.x.atan2(arc.radius_mm - p.y);
                let turn = if turn < (angle / 2.0 - std::f64::consts::PI) {
                    turn + std::f64::consts::TAU
                } else {
                    turn
                };
                i32::from(turn > angle) - i32::from(turn < 0.0)
            }
        }
    }
}

impl Local {
    /// Square of a point's distance from the segment's axis; infinite beside an arc.
    pub fn square_from_axis(&self, p: [f64; 3]) -> f64 {
        let [x, y, z] = p;
        match &self.arc {
            None => {
                let past = x - x.clamp(0.0, self.length_mm);
                past * past + y * y + z * z
            }
            Some(arc) if self.facing.holds(x, arc.radius_mm - y) => {
                let qy = arc.radius_mm - y;
                let outward = (x * x + qy * qy).sqrt() - arc.radius_mm;
                outward * outward + z * z
            }
            Some(_) => f64::INFINITY,
        }
    }

    /// Where along the segment a point lies, 0 to 1.
    pub fn share_along(&self, p: [f64; 3]) -> f64 {
        (self.along_mm(&p.into()) / self.length_mm.max(1e-12)).clamp(0.0, 1.0)
    }

    /// A point's place across the axis; from the outside of a bend.
    pub fn across(&self, p: [f64; 3]) -> (f64, f64) {
        match &self.arc {
            None => (p[1], p[2]),
            Some(arc) => {
                let qy = p[1] - arc.radius_mm;
                ((p[0] * p[0] + qy * qy).sqrt() - arc.radius_mm, p[2])
            }
        }
    }

    /// Unit direction from the axis to a point, in the segment's frame.
    pub fn outward(&self, p: [f64; 3]) -> Vector3<f64> {
        let (u, v) = self.across(p);
        let out = match &self.arc {
            None => Vector3::new(0.0, u, v),
            Some(arc) => {
                let y = p[1] - arc.radius_mm;
                let ring = p[0].hypot(y).max(1e-12);
                Vector3::new(u * p[0] / ring, u * y / ring, v)
            }
        };
        out / u.hypot(v).max(1e-12)
    }

    /// How oval the section is where a point faces the segment: [`Arc::ramp`].
    pub fn ramp_at(&self, p: [f64; 3], tube_radius_mm: f64) -> f64 {
        match &self.arc {
            None => 0.0,
            Some(_) => self.place_on_ramp(p, tube_radius_mm).map_or(1.0, |(_, share)| oval_share(share)),
        }
    }

    /// Where a point that faces an arc lies on one of its ramps: whether on that at its end, and how far, 0 to 1 inwards. None
    /// where the arc is as oval as it gets, and on a line.
    pub fn place_on_ramp(&self, p: [f64; 3], tube_radius_mm: f64) -> Option<(bool, f64)> {
        let arc = self.arc.as_ref()?;
        let (x, y) = (p[0], arc.radius_mm - p[1]);
        if self.oval.holds(x, y) {
            return None;
        }
        Some(arc.place_on_ramp(x.atan2(y).rem_euclid(std::f64::consts::TAU), tube_radius_mm))
    }

    /// How oval the section is at a distance along the segment, and how flat its outer wall.
    pub fn uneven_mm(&self, along_mm: f64, tube_radius_mm: f64) -> (f64, f64) {
        let Some(arc) = &self.arc else { return (0.0, 0.0) };
        let ramp = arc.ramp(along_mm / arc.radius_mm, tube_radius_mm);
        (arc.ovality_mm * ramp, arc.flattening_mm * ramp)
    }

    /// Signed distance of a point from the tube's surface, outside positive.
    pub fn residual_mm(&self, p: [f64; 3], tube_radius_mm: f64) -> f64 {
        let (u, v) = self.across(p);
        let distance = (u * u + v * v).sqrt().max(1e-12);
        let Some(arc) = &self.arc else { return distance - tube_radius_mm };
        let ramp = self.ramp_at(p, tube_radius_mm);
        let (oval_mm, flat_mm) = (arc.ovality_mm * ramp, arc.flattening_mm * ramp);
        distance - Outline::at(u / distance, v / distance, tube_radius_mm, oval_mm, flat_mm).radius_mm
    }
}

/// The section of a bend: an ellipse with half axes radius + oval towards the outside of the bend and radius - oval across,
/// with a flattened outer wall.
pub struct Outline {
    /// The section's radius in a direction.
    pub radius_mm: f64,
    /// Its derivatives by the tube's radius, by the ovality, by the flattening, and by the direction.
    pub by_radius: f64,
    /// See `by_radius`.
    pub by_oval: f64,
    /// See `by_radius`.
    pub by_flat: f64,
    /// See `by_radius`.
    pub by_direction_mm: f64,
}

impl Outline {
    /// The section in the direction (cos, sin) from the outside of the bend.
    pub fn at(cos: f64, sin: f64, radius_mm: f64, oval_mm: f64, flat_mm: f64) -> Outline {
        let (cos_3, sin_3) = ((4.0 * cos * cos - 3.0) * cos, (3.0 - 4.0 * sin * sin) * sin);
        let (a, b) = (radius_mm + oval_mm, radius_mm - oval_mm);
        let square = b * b * cos * cos + a * a * sin * sin;
        let root = square.sqrt();
        let cubic = a * b / (square * root);
        Outline {
            radius_mm: a * b / root + flat_mm * cos_3,
            by_radius: 2.0 * radius_mm / root - cubic * (b * cos * cos + a * sin * sin),
            by_oval: -2.0 * oval_mm / root + cubic * (b * cos * cos - a * sin * sin),
            by_flat: cos_3,
            by_direction_mm: -cubic * cos * sin * 4.0 * radius_mm * oval_mm - 3.0 * flat_mm * sin_3,
        }
    }
}

impl Arc {
    /// Over what length from its ends the section becomes as oval as it gets.
    pub fn full_ramp_mm(&self, tube_radius_mm: f64) -> f64 {
        (OVAL_RAMP_RADII * tube_radius_mm).min(0.5 * self.angle_rad * self.radius_mm)
    }

    /// How oval the section is at a turn from the arc's start: 0 at its ends, 1 inside. Its own slope along the tube is in the
    /// derivatives where the ramps are told apart (`ramps`), for the fit of all points. A sample's fit leaves it out: where the
    /// model holds residuals are noise, so that costs a little speed of convergence.
    pub fn ramp(&self, turn_rad: f64, tube_radius_mm: f64) -> f64 {
        oval_share(self.place_on_ramp(turn_rad, tube_radius_mm).1)
    }

    /// Whether a turn from the arc's start is nearer to its end, and how far inwards on the ramp there, 0 to 1.
    fn place_on_ramp(&self, turn_rad: f64, tube_radius_mm: f64) -> (bool, f64) {
        let left_rad = self.angle_rad - turn_rad;
        let full = self.full_ramp_mm(tube_radius_mm);
        let share = turn_rad.min(left_rad) * self.radius_mm / full.max(1e-12);
        (left_rad < turn_rad, share.clamp(0.0, 1.0))
    }
}

/// How oval the section is at a share of a ramp.
pub fn oval_share(share: f64) -> f64 {
    0.5 - 0.5 * (std::f64::consts::PI * share).cos()
}

impl Local {
    /// Place across the tube, in the frame that goes along the segment: towards the bend's centre, along its normal.
    pub fn off_axis(&self, p: &Point3<f64>) -> Vector2<f64> {
        match &self.arc {
            None => Vector2::new(p.y, p.z),
            Some(arc) => Vector2::new(arc.radius_mm - p.x.hypot(arc.radius_mm - p.y), p.z),
        }
    }

    /// Distance along the segment, beyond its ends too.
    pub fn unclamped_along_mm(&self, p: &Point3<f64>) -> f64 {
        match &self.arc {
            None => p.x,
            Some(_) => self.along_mm(p),
        }
    }

    /// The point of the axis that a point faces, and the tangent there.
    pub fn foot(&self, p: &Point3<f64>) -> (Point3<f64>, Vector3<f64>) {
        match &self.arc {
            None => (Point3::new(p.x, 0.0, 0.0), Vector3::x()),
            Some(arc) => {
                let ring = p.x.hypot(arc.radius_mm - p.y).max(1e-12);
                let (sin, cos) = (p.x / ring, (arc.radius_mm - p.y) / ring);
                let r = arc.radius_mm;
                (Point3::new(r * sin, r * (1.0 - cos), 0.0), Vector3::new(cos, sin, 0.0))
            }
        }
    }
}
