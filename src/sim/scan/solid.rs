//! The ideal tube as a solid, and the exact point where a ray meets it.
//!
//! The surface is where the distance to the centre line equals the section's radius. A ray advances by that
//! distance (it cannot pass the surface) until it is close, then Newton's method finds the root. In a bend the
//! section is an ellipse flattened in the bend's plane, growing out of the circle within a radius of arc.

use std::f64::consts::PI;

use nalgebra::{Matrix3, Point3, Vector3};

use super::TubeShape;
use crate::tube::{SegmentKind, Spine};

/// Closer than this share of the radius, the root is sought by Newton's method.
const NEAR: f64 = 1e-3;
/// Cosine of incidence below which a ray only skims the surface (86 degrees).
const SKIMMING: f64 = 0.07;
/// A ray still creeping after this many steps skims a surface.
const MOST_STEPS: usize = 300;

/// A ray with a unit direction.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub origin: Point3<f64>,
    pub direction: Vector3<f64>,
}

impl Ray {
    /// The point at a distance.
    pub fn at(&self, t: f64) -> Point3<f64> {
        self.origin + self.direction * t
    }
}

/// What a ray meets first on the tube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Cast {
    /// Nothing up to the limit.
    Miss,
    /// The tube, but where no light returns: its open end, or a skimmed side.
    Blocked(f64),
    /// The outside at this distance, with the cosine of incidence.
    Outside { t: f64, cosine: f64 },
}

/// One line or arc, ready for distances.
#[derive(Debug)]
struct Piece {
    origin: Point3<f64>,
    /// Rows are the frame's axes: world to local.
    to_local: Matrix3<f64>,
    length_mm: f64,
    /// None for a line.
    arc: Option<Arc>,
}

#[derive(Debug, Clone, Copy)]
struct Arc {
    radius_mm: f64,
    angle_rad: f64,
    ovality: f64,
}

/// A part of the tube within a ball: what rays near it must be tested against.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chunk {
    pub centre: Point3<f64>,
    /// Of the ball that holds the surface.
    pub radius_mm: f64,
    pub piece: usize,
}

/// An open end.
#[derive(Debug, Clone, Copy)]
struct End {
    centre: Point3<f64>,
    outward: Vector3<f64>,
}

/// Distance from the surface, below 0 inside; and the end whose face the point lies beyond.
struct Near {
    distance_mm: f64,
    beyond: Option<usize>,
}

/// The tube.
#[derive(Debug)]
pub(super) struct Solid {
    pieces: Vec<Piece>,
    ends: [End; 2],
    radius_mm: f64,
    /// Share of the distance that is safe to advance: an oval section's field is a little steeper than 1.
    stride: f64,
}

impl Solid {
    pub fn new(shape: &TubeShape, spine: &Spine) -> Solid {
        let mut pieces = Vec::new();
        let mut bend = 0;
        for segment in spine.segments() {
            let arc = match segment.kind {
                SegmentKind::Line => None,
                SegmentKind::Arc { radius_mm, angle_rad } => {
                    bend += 1;
                    let ovality = shape.ovality.get(bend - 1).copied().unwrap_or(0.0);
                    Some(Arc { radius_mm, angle_rad, ovality })
                }
            };
            if segment.length_mm > 0.0 {
                let to_local = segment.start.rotation.to_rotation_matrix().matrix().transpose();
                let origin = segment.start.translation.vector.into();
                pieces.push(Piece { origin, to_local, length_mm: segment.length_mm, arc });
            }
        }
        let end = |at: f64, sign: f64| {
            let frame = spine.frame_at(at);
            let outward = frame.rotation * (Vector3::x() * sign);
            End { centre: frame.translation.vector.into(), outward }
        };
        let steepest = shape.ovality.iter().fold(0.0, |a: f64, b| a.max(b.abs()));
        Solid {
            pieces,
            ends: [end(0.0, -1.0), end(spine.length_mm(), 1.0)],
            radius_mm: shape.od_mm / 2.0,
            stride: 1.0 / (1.0 + 2.0 * steepest),
        }
    }

    /// Half the nominal outer diameter.
    pub fn radius_mm(&self) -> f64 {
        self.radius_mm
    }

    /// The tube cut into chunks about two radii long.
    pub fn chunks(&self, spine: &Spine) -> Vec<Chunk> {
        let mut chunks = Vec::new();
        let bent = spine.segments().iter().filter(|s| s.length_mm > 0.0);
        for (piece, segment) in bent.enumerate() {
            let n = (segment.length_mm / (2.0 * self.radius_mm)).ceil().clamp(1.0, 1e6) as usize;
            let step = segment.length_mm / n as f64;
            let half =
                step / 2.0 * self.pieces[piece].arc.map_or(1.0, |a| 1.0 + self.radius_mm / a.radius_mm);
            for k in 0..n {
                let middle = segment.frame_at(step * (k as f64 + 0.5));
                let centre = middle.translation.vector.into();
                // The corners are farthest: in a bend, those on its outside.
                let radius_mm = 1.1 * (self.radius_mm / self.stride).hypot(half);
                chunks.push(Chunk { centre, radius_mm, piece });
            }
        }
        chunks
    }

    /// Follows a ray up to `limit_mm`, against the pieces given (which must be all that are near it).
    pub fn cast(&self, ray: &Ray, pieces: &[usize], limit_mm: f64) -> Cast {
        let mut t = 0.0;
        for _ in 0..MOST_STEPS {
            let near = self.near(&ray.at(t), pieces);
            if near.distance_mm > NEAR * self.radius_mm {
                t += near.distance_mm * self.stride;
                if t > limit_mm {
                    return Cast::Miss;
                }
                continue;
            }
            let found = match near.beyond {
                Some(end) => Err((t, end)),
                None => self.settle(ray, t, pieces),
            };
            match found {
                Ok(cast) => return cast,
                Err((at, end)) => match self.past_end(ray, at, end) {
                    Some(exit) => t = exit,
                    None => return Cast::Blocked(at),
                },
            }
        }
        Cast::Blocked(t)
    }

    /// Newton's method from close by. Err with the place and the end when the root is no surface but the ball
    /// about an end.
    fn settle(&self, ray: &Ray, from: f64, pieces: &[usize]) -> Result<Cast, (f64, usize)> {
        let mut t = from;
        let h = 1e-5 * self.radius_mm;
        for _ in 0..20 {
            let here = self.near(&ray.at(t), pieces);
            let ahead = self.near(&ray.at(t + h), pieces);
            let slope = (ahead.distance_mm - here.distance_mm) / h;
            if slope > -SKIMMING {
                break;
            }
            let step = here.distance_mm / slope;
            t -= step;
            if step.abs() < 1e-10 * self.radius_mm {
                return match here.beyond {
                    Some(end) => Err((t, end)),
                    None => Ok(Cast::Outside { t, cosine: (-slope).min(1.0) }),
                };
            }
        }
        Ok(Cast::Blocked(t))
    }

    /// A ray in the ball about an end, beyond its face: where it leaves the ball, or None when it has gone
    /// through the face into the tube by then.
    fn past_end(&self, ray: &Ray, t: f64, end: usize) -> Option<f64> {
        let end = &self.ends[end];
        let to = ray.at(t) - end.centre;
        let along = to.dot(&ray.direction);
        // Out of reach of NEAR, so that the march goes on.
        let out = self.radius_mm * (1.0 + 2.0 * NEAR);
        let exit = t - along + (along * along - to.norm_squared() + out * out).max(0.0).sqrt();
        ((ray.at(exit) - end.centre).dot(&end.outward) > 0.0).then_some(exit)
    }

    fn near(&self, p: &Point3<f64>, pieces: &[usize]) -> Near {
        let mut best = Near { distance_mm: f64::INFINITY, beyond: None };
        for &i in pieces {
            let (distance_mm, side) = self.pieces[i].distance(p, self.radius_mm);
            if distance_mm < best.distance_mm {
                let beyond = match side {
                    Side::Before if i == 0 => Some(0),
                    Side::After if i + 1 == self.pieces.len() => Some(1),
                    _ => None,
                };
                best = Near { distance_mm, beyond };
            }
        }
        best
    }
}

/// Where a point's foot lies on a piece.
enum Side {
    Before,
    Within,
    After,
}

impl Piece {
    /// Distance from this piece's surface; beyond its ends, from the ball about the end.
    fn distance(&self, p: &Point3<f64>, radius_mm: f64) -> (f64, Side) {
        let q = self.to_local * (p - self.origin);
        let Some(arc) = self.arc else {
            let over = q.x - q.x.clamp(0.0, self.length_mm);
            let distance = (over * over + q.y * q.y + q.z * q.z).sqrt() - radius_mm;
            let side = if over < 0.0 {
                Side::Before
            } else if over > 0.0 {
                Side::After
            } else {
                Side::Within
            };
            return (distance, side);
        };
        let turn = q.x.atan2(arc.radius_mm - q.y).rem_euclid(2.0 * PI);
        if turn <= arc.angle_rad {
            let outward = q.x.hypot(arc.radius_mm - q.y) - arc.radius_mm;
            let section = arc.section_mm(outward, q.z, turn, radius_mm);
            return (outward.hypot(q.z) - section, Side::Within);
        }
        let after = turn - arc.angle_rad < 2.0 * PI - turn;
        let (sin, cos) = if after { arc.angle_rad.sin_cos() } else { (0.0, 1.0) };
        let foot = Vector3::new(arc.radius_mm * sin, arc.radius_mm * (1.0 - cos), 0.0);
        ((q - foot).norm() - radius_mm, if after { Side::After } else { Side::Before })
    }
}

impl Arc {
    /// Radius of the section towards (outward in the bend's plane, across it), at a turn along the bend.
    fn section_mm(&self, outward: f64, across: f64, turn: f64, radius_mm: f64) -> f64 {
        let distance = outward.hypot(across);
        if self.ovality == 0.0 || distance == 0.0 {
            return radius_mm;
        }
        let ramp_mm = radius_mm.min(self.radius_mm * self.angle_rad / 2.0);
        let from_end_mm = self.radius_mm * turn.min(self.angle_rad - turn);
        let x = (from_end_mm / ramp_mm).clamp(0.0, 1.0);
        let ovality = self.ovality * x * x * (3.0 - 2.0 * x);
        let (flat, tall) = (1.0 - ovality / 2.0, 1.0 + ovality / 2.0);
        radius_mm * flat * tall * distance / (tall * outward).hypot(flat * across)
    }
}
