//! The spine: a tube's centre line in space as alternating lines and arcs, smoothly joined (G1).
//!
//! Built from [`Lra`] and a starting [`Frame`]; answers where the line is at an arc length, and which of
//! its points is closest to a given one. Source of the curve class: paper 000, section 5.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use super::Lra;

/// A pose on the spine: x is the tangent (feed direction), y points to the bend's centre, z is the normal
/// of the bend's plane.
pub type Frame = Isometry3<f64>;

/// Line or arc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SegmentKind {
    /// A straight.
    Line,
    /// A circular bend in the frame's x-y plane, towards +y.
    Arc {
        /// Centre-line radius.
        radius_mm: f64,
        /// Bend angle.
        angle_rad: f64,
    },
}

/// One line or arc with its pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// Pose at the segment's start.
    pub start: Frame,
    /// Arc length from the spine's start to the segment's start.
    pub start_mm: f64,
    /// Arc length of the segment.
    pub length_mm: f64,
    /// Line or arc.
    pub kind: SegmentKind,
}

/// The point of the spine nearest to a given point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClosestPoint {
    /// Index of the segment it lies on.
    pub segment: usize,
    /// Arc length from the spine's start.
    pub arc_length_mm: f64,
    /// The point.
    pub point: Point3<f64>,
    /// Its distance from the given point.
    pub distance_mm: f64,
}

/// Both tangent points of a straight and its middle: the trade's check points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StraightPoints {
    /// Where the straight begins.
    pub start: Point3<f64>,
    /// Half way.
    pub middle: Point3<f64>,
    /// Where it ends.
    pub end: Point3<f64>,
}

/// A centre line: line, arc, line, ..., arc, line (lines may have length 0).
#[derive(Debug, Clone, PartialEq)]
pub struct Spine {
    segments: Vec<Segment>,
}

impl Segment {
    /// Pose at a distance along the segment, 0 to `length_mm` (beyond, the line or circle goes on).
    pub fn frame_at(&self, along_mm: f64) -> Frame {
        let local = match self.kind {
            SegmentKind::Line => Isometry3::translation(along_mm, 0.0, 0.0),
            SegmentKind::Arc { radius_mm, .. } => {
                let turn = along_mm / radius_mm;
                let (sin, cos) = turn.sin_cos();
                Isometry3::from_parts(
                    Translation3::new(radius_mm * sin, radius_mm * (1.0 - cos), 0.0),
                    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn),
                )
            }
        };
        self.start * local
    }

    /// Distance along the segment of its point closest to `point`, clamped to the segment.
    pub fn closest_along_mm(&self, point: &Point3<f64>) -> f64 {
        let local = self.start.inverse_transform_point(point);
        match self.kind {
            // A scan that begins within a bend can leave the straight before it a length a little below 0.
            SegmentKind::Line => local.x.clamp(0.0, self.length_mm.max(0.0)),
            SegmentKind::Arc { radius_mm, angle_rad } => {
                let turn = local.x.atan2(radius_mm - local.y).rem_euclid(2.0 * PI);
                if turn <= angle_rad {
                    return turn * radius_mm;
                }
                // Outside: the nearer of both ends, which is the one at the smaller turn.
                if turn - angle_rad < 2.0 * PI - turn { self.length_mm } else { 0.0 }
            }
        }
    }

    /// Centre of the bend; None for a line.
    pub fn centre(&self) -> Option<Point3<f64>> {
        match self.kind {
            SegmentKind::Line => None,
            SegmentKind::Arc { radius_mm, .. } => Some(self.start * Point3::new(0.0, radius_mm, 0.0)),
        }
    }
}

impl Spine {
    /// Lays the tube out from a starting pose. The first row's rotation is applied about the first
    /// straight. Rows of angle 0 become arcs of length 0.
    pub fn from_lra(lra: &Lra, start: Frame) -> Spine {
        let mut segments = Vec::with_capacity(2 * lra.bends.len() + 1);
        let mut frame = start;
        let mut at = 0.0;
        let mut push = |frame: &mut Frame, length_mm: f64, kind: SegmentKind| {
            let segment = Segment { start: *frame, start_mm: at, length_mm, kind };
            *frame = segment.frame_at(length_mm);
            at += length_mm;
            segments.push(segment);
        };
        for bend in &lra.bends {
            frame *= UnitQuaternion::from_axis_angle(&Vector3::x_axis(), bend.rotation_rad);
            push(&mut frame, bend.length_mm, SegmentKind::Line);
            let kind = SegmentKind::Arc { radius_mm: bend.radius_mm.max(1e-9), angle_rad: bend.angle_rad };
            push(&mut frame, bend.radius_mm.max(1e-9) * bend.angle_rad, kind);
        }
        push(&mut frame, lra.last_length_mm, SegmentKind::Line);
        Spine { segments }
    }

    /// The segments in order: line, arc, ..., line.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// Arc length of the whole.
    pub fn length_mm(&self) -> f64 {
        self.segments.last().map_or(0.0, |s| s.start_mm + s.length_mm)
    }

    /// Pose at an arc length; clamped to the spine. At a joint it is that of the segment which ends there, so
    /// before the turn of the next plane.
    pub fn frame_at(&self, arc_length_mm: f64) -> Frame {
        let at = arc_length_mm.clamp(0.0, self.length_mm());
        let index = self.segments.partition_point(|s| s.start_mm + s.length_mm < at);
        let segment = &self.segments[index.min(self.segments.len() - 1)];
        segment.frame_at(at - segment.start_mm)
    }

    /// Point at an arc length; clamped to the spine.
    pub fn point_at(&self, arc_length_mm: f64) -> Point3<f64> {
        self.frame_at(arc_length_mm).translation.vector.into()
    }

    /// The point of the spine nearest to `point`.
    pub fn closest(&self, point: &Point3<f64>) -> ClosestPoint {
        let mut best = ClosestPoint {
            segment: 0,
            arc_length_mm: 0.0,
            point: self.point_at(0.0),
            distance_mm: f64::INFINITY,
        };
        for (i, segment) in self.segments.iter().enumerate() {
            let along = segment.closest_along_mm(point);
            let foot = Point3::from(segment.frame_at(along).translation.vector);
            let distance_mm = (point - foot).norm();
            if distance_mm < best.distance_mm {
                let arc_length_mm = segment.start_mm + along;
                best = ClosestPoint { segment: i, arc_length_mm, point: foot, distance_mm };
            }
        }
        best
    }

    /// Check points of every straight (bends + 1 of them): tangent points (or ends) and middles.
    pub fn straights(&self) -> Vec<StraightPoints> {
        let at = |s: &Segment, along: f64| Point3::from(s.frame_at(along).translation.vector);
        self.segments
            .iter()
            .filter(|s| s.kind == SegmentKind::Line)
            .map(|s| StraightPoints {
                start: at(s, 0.0),
                middle: at(s, s.length_mm / 2.0),
                end: at(s, s.length_mm),
            })
            .collect()
    }

    /// The same spine moved rigidly.
    pub fn moved(&self, by: &Isometry3<f64>) -> Spine {
        Spine { segments: self.segments.iter().map(|s| Segment { start: by * s.start, ..*s }).collect() }
    }

    /// Points along the spine no farther apart than `step_mm`, joints included: for pictures and checks.
    pub fn sampled(&self, step_mm: f64) -> Vec<Point3<f64>> {
        let mut points = vec![self.point_at(0.0)];
        for s in self.segments.iter().filter(|s| s.length_mm > 0.0) {
            let steps = (s.length_mm / step_mm).ceil().max(1.0) as usize;
            points.extend(
                (1..=steps).map(|k| {
                    Point3::from(s.frame_at(s.length_mm * k as f64 / steps as f64).translation.vector)
                }),
            );
        }
        points
    }
}
