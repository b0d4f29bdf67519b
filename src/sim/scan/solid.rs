//! The ideal tube as a solid, and the exact point where a ray meets it.
//!
//! The surface is where the distance to the centre line equals the section's radius. A ray advances by that
//! distance (it cannot pass the surface) until it is close, then Newton's method finds the root. In a bend the
//! section is an ellipse flattened in the bend's plane, its outer wall flatter still, growing out of the circle within a
//! radius of arc. Both ends are clipped (`end`); with a wall the tube is hollow, and light returns from the faces and from the
//! bore close to them.

use std::f64::consts::PI;

use nalgebra::{Matrix3, Point3, Vector3};

use super::TubeShape;
use super::end::Cut;
use crate::tube::{SegmentKind, Spine};

/// Closer than this share of the radius, the root is sought by Newton's method.
const NEAR: f64 = 1e-3;
/// Cosine of incidence below which a ray only skims the surface (86 degrees).
const SKIMMING: f64 = 0.07;
/// The scanner's camera sees this deep into the bore, in tube radii.
const BORE_RADII: f64 = 1.0;
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
    /// The tube, but where no light returns: its open end, deep in the bore, or a skimmed side.
    Blocked(f64),
    /// A surface at this distance, with the cosine of incidence.
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
    flattening: f64,
}

/// A part of the tube within a ball: what rays near it must be tested against.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chunk {
    pub centre: Point3<f64>,
    /// Of the ball that holds the surface.
    pub radius_mm: f64,
    pub piece: usize,
}

/// What a point is nearest to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Surface {
    Outside,
    Face,
    Bore,
}

/// Distance from the surface, below 0 in the material; the share of it that is safe to advance.
struct Near {
    distance_mm: f64,
    stride: f64,
    surface: Surface,
}

/// The tube.
#[derive(Debug)]
pub(super) struct Solid {
    pieces: Vec<Piece>,
    ends: [Cut; 2],
    radius_mm: f64,
    /// Thickness of the wall; 0 for an end that returns nothing.
    wall_mm: f64,
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
                    let of = |bends: &[f64]| bends.get(bend - 1).copied().unwrap_or(0.0);
                    let (ovality, flattening) = (of(&shape.ovality), of(&shape.flattening));
                    Some(Arc { radius_mm, angle_rad, ovality, flattening })
                }
            };
            if segment.length_mm > 0.0 {
                let to_local = segment.start.rotation.to_rotation_matrix().matrix().transpose();
                let origin = segment.start.translation.vector.into();
                pieces.push(Piece { origin, to_local, length_mm: segment.length_mm, arc });
            }
        }
        let end = |at: f64, sign: f64, k: usize| {
            Cut::new(&spine.frame_at(at), sign, shape.od_mm / 2.0, shape.ends[k])
        };
        let ends = [end(0.0, -1.0, 0), end(spine.length_mm(), 1.0, 1)];
        if let Some(first) = pieces.first_mut().filter(|p| p.arc.is_none()) {
            let more = ends[0].overhang_mm();
            first.origin -= first.to_local.row(0).transpose() * more;
            first.length_mm += more;
        }
        if let Some(last) = pieces.last_mut().filter(|p| p.arc.is_none()) {
            last.length_mm += ends[1].overhang_mm();
        }
        let most = |bends: &[f64]| bends.iter().fold(0.0, |a: f64, b| a.max(b.abs()));
        let steepest = most(&shape.ovality) + 3.0 * most(&shape.flattening);
        Solid {
            pieces,
            ends,
            radius_mm: shape.od_mm / 2.0,
            wall_mm: shape.wall_mm,
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
        for (index, (segment, piece)) in bent.zip(&self.pieces).enumerate() {
            let n = (piece.length_mm / (2.0 * self.radius_mm)).ceil().clamp(1.0, 1e6) as usize;
            let step = piece.length_mm / n as f64;
            let half = step / 2.0 * piece.arc.map_or(1.0, |a| 1.0 + self.radius_mm / a.radius_mm);
            // The first straight goes on before its segment.
            let before = if index == 0 && piece.arc.is_none() { self.ends[0].overhang_mm() } else { 0.0 };
            for k in 0..n {
                let middle = segment.frame_at(step * (k as f64 + 0.5) - before);
                let centre = middle.translation.vector.into();
                // The corners are farthest: in a bend, those on its outside.
                let radius_mm = 1.1 * (self.radius_mm / self.stride).hypot(half);
                chunks.push(Chunk { centre, radius_mm, piece: index });
            }
        }
        chunks
    }

    /// Follows a ray up to `limit_mm`, against the pieces given (which must be all that are near it).
    pub fn cast(&self, ray: &Ray, pieces: &[usize], limit_mm: f64) -> Cast {
        let mut t = 0.0;
        for _ in 0..MOST_STEPS {
            let near = self.near(&ray.at(t), pieces);
            if near.distance_mm <= NEAR * self.radius_mm {
                return self.settle(ray, t, pieces);
            }
            t += near.distance_mm * near.stride;
            if t > limit_mm {
                return Cast::Miss;
            }
        }
        Cast::Blocked(t)
    }

    /// Newton's method from close by.
    fn settle(&self, ray: &Ray, from: f64, pieces: &[usize]) -> Cast {
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
                let lit = match here.surface {
                    Surface::Outside => true,
                    Surface::Face => self.wall_mm > 0.0,
                    Surface::Bore => self.near_an_end(&ray.at(t)),
                };
                return if lit { Cast::Outside { t, cosine: (-slope).min(1.0) } } else { Cast::Blocked(t) };
            }
        }
        Cast::Blocked(t)
    }

    /// Whether the scanner sees a place in the bore.
    fn near_an_end(&self, p: &Point3<f64>) -> bool {
        let reach = self.radius_mm.hypot(BORE_RADII * self.radius_mm);
        self.ends
            .iter()
            .any(|end| -end.beyond_mm(p) < BORE_RADII * self.radius_mm && (p - end.centre).norm() < reach)
    }

    fn near(&self, p: &Point3<f64>, pieces: &[usize]) -> Near {
        let mut best = Near { distance_mm: f64::INFINITY, stride: self.stride, surface: Surface::Outside };
        let mut outside_mm = f64::INFINITY;
        for &i in pieces {
            let (lateral_mm, side) = self.pieces[i].distance(p, self.radius_mm);
            outside_mm = outside_mm.min(lateral_mm);
            let mut near = Near { distance_mm: lateral_mm, stride: self.stride, surface: Surface::Outside };
            let line = self.pieces[i].arc.is_none();
            let first = i == 0 && (line || side == Side::Before);
            let last = i + 1 == self.pieces.len() && (line || side == Side::After);
            for (end, _) in self.ends.iter().zip([first, last]).filter(|(_, own)| *own) {
                let clipped = end.clip(p, near.distance_mm);
                if clipped.face {
                    near.surface = Surface::Face;
                }
                near.distance_mm = clipped.distance_mm;
                near.stride = near.stride.min(clipped.stride);
            }
            if near.distance_mm < best.distance_mm {
                best = near;
            }
        }
        // The bore is taken out of the whole tube, so that no piece closes its neighbour's.
        let within_mm = -self.wall_mm - outside_mm;
        if self.wall_mm > 0.0 && within_mm > best.distance_mm {
            best = Near { distance_mm: within_mm, stride: self.stride, surface: Surface::Bore };
        }
        best
    }
}

/// Where a point's foot lies on a piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
        if (self.ovality == 0.0 && self.flattening == 0.0) || distance == 0.0 {
            return radius_mm;
        }
        let ramp_mm = radius_mm.min(self.radius_mm * self.angle_rad / 2.0);
        let from_end_mm = self.radius_mm * turn.min(self.angle_rad - turn);
        let x = (from_end_mm / ramp_mm).clamp(0.0, 1.0);
        let share = x * x * (3.0 - 2.0 * x);
        let ovality = self.ovality * share;
        let (flat, tall) = (1.0 - ovality / 2.0, 1.0 + ovality / 2.0);
        let ellipse_mm = radius_mm * flat * tall * distance / (tall * outward).hypot(flat * across);
        let cos = outward / distance;
        let three_sided = cos * (4.0 * cos * cos - 3.0);
        ellipse_mm - 2.0 * radius_mm * self.flattening * share * three_sided
    }
}
