//! What lies around the tube: a table and V-blocks, as convex bodies.

use nalgebra::{Point3, Vector3};

use super::ScanSettings;
use super::solid::Ray;
use crate::tube::{SegmentKind, Spine};

/// A convex body: all points p with normal . p <= offset for every face.
#[derive(Debug)]
pub(super) struct Prop {
    faces: Vec<(Vector3<f64>, f64)>,
}

impl Prop {
    /// Where a ray enters it, with the cosine of incidence; None when it passes or starts within.
    pub fn entry(&self, ray: &Ray) -> Option<(f64, f64)> {
        let (mut enter, mut leave, mut cosine) = (0.0, f64::INFINITY, 0.0);
        for (normal, offset) in &self.faces {
            let towards = -normal.dot(&ray.direction);
            let outside = normal.dot(&ray.origin.coords) - offset;
            if towards.abs() < 1e-12 {
                if outside > 0.0 {
                    return None;
                }
            } else if towards < 0.0 {
                leave = f64::min(leave, outside / towards);
            } else if outside / towards > enter {
                (enter, cosine) = (outside / towards, towards);
            }
        }
        (cosine > 0.0 && enter < leave).then_some((enter, cosine))
    }
}

/// The bodies that the settings ask for. `points` are close steps along the spine.
pub(super) fn around(
    spine: &Spine,
    points: &[Point3<f64>],
    r: f64,
    up: &Vector3<f64>,
    settings: &ScanSettings,
) -> Vec<Prop> {
    let mut props = Vec::new();
    let lowest = points.iter().map(|p| up.dot(&p.coords)).fold(f64::INFINITY, f64::min) - r;
    // With V-blocks the tube hangs free of the table by their bottoms' thickness.
    let floor = if settings.v_blocks { lowest - r } else { lowest };
    if settings.v_blocks {
        for (centre, tangent) in supports(spine, points, r, up) {
            props.extend(v_block(&centre, &tangent, up, r, floor));
        }
    }
    if settings.table {
        props.push(Prop { faces: vec![(*up, floor)] });
    }
    props
}

/// Where the tube rests: up to three of its longest straights that lie flat, away from other legs.
fn supports(
    spine: &Spine,
    points: &[Point3<f64>],
    r: f64,
    up: &Vector3<f64>,
) -> Vec<(Point3<f64>, Vector3<f64>)> {
    let mut lines: Vec<_> =
        spine.segments().iter().filter(|s| s.kind == SegmentKind::Line && s.length_mm > 4.0 * r).collect();
    lines.sort_by(|a, b| b.length_mm.total_cmp(&a.length_mm));
    let spots = lines.iter().flat_map(|s| {
        // A long straight would tip over one block.
        let shares: &[f64] = if s.length_mm > 12.0 * r { &[0.25, 0.75] } else { &[0.5] };
        shares.iter().map(|share| {
            let frame = s.frame_at(share * s.length_mm);
            (Point3::from(frame.translation.vector), frame.rotation * Vector3::x())
        })
    });
    let free = |(centre, tangent): &(Point3<f64>, Vector3<f64>)| {
        points.iter().all(|p| {
            let d = p - centre;
            let own = d.cross(tangent).norm() < 0.01 * r;
            own || d.norm() > 4.0 * r
        })
    };
    spots.filter(|s| s.1.dot(up).abs() < 0.3).filter(free).take(3).collect()
}

/// A block with a V of 90 degrees that touches the tube along two lines: two convex halves.
fn v_block(centre: &Point3<f64>, tangent: &Vector3<f64>, up: &Vector3<f64>, r: f64, floor: f64) -> Vec<Prop> {
    let high = (up - tangent * tangent.dot(up)).normalize();
    let side = tangent.cross(&high);
    let at = |n: Vector3<f64>, mm: f64| (n, n.dot(&centre.coords) + mm);
    [side, -side]
        .into_iter()
        .map(|side| {
            let groove = (high - side).normalize();
            let faces = vec![
                at(groove, -r),
                at(side, 2.2 * r),
                at(-side, 0.0),
                at(*tangent, r),
                at(-tangent, r),
                at(high, -0.2 * r),
                (-up, -floor),
            ];
            Prop { faces }
        })
        .collect()
}
