//! What lies around the tube: a table, V-blocks and clamp jaws, as convex bodies.

use nalgebra::{Point3, Vector3};

use super::solid::Ray;
use super::{Jaws, ScanSettings};
use crate::tube::{Segment, SegmentKind, Spine};

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

/// A place on a straight: a point of the centre line and its direction.
type Spot = (Point3<f64>, Vector3<f64>);

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
    let rests = if settings.v_blocks { supports(spine, points, r, up) } else { Vec::new() };
    for (centre, tangent) in &rests {
        props.extend(v_block(centre, tangent, up, r, floor));
    }
    if let Some(jaws) = settings.jaws {
        for (centre, tangent) in grips(spine, points, r, up, &rests) {
            props.extend(match jaws {
                Jaws::Grip => grip(&centre, &tangent, up, r),
                Jaws::Flat => vec![flat_jaw(&centre, &tangent, up, r)],
            });
        }
    }
    if settings.table {
        props.push(Prop { faces: vec![(*up, floor)] });
    }
    props
}

/// Where the tube rests: up to three of its longest straights that lie flat, away from other legs and with none below.
fn supports(spine: &Spine, points: &[Point3<f64>], r: f64, up: &Vector3<f64>) -> Vec<Spot> {
    // A long straight would tip over one block.
    let spots = spots(spine, 4.0 * r, |mm| if mm > 12.0 * r { &[0.25, 0.75] } else { &[0.5] });
    let free_below = |(centre, tangent): &Spot| {
        points.iter().all(|p| {
            let d = p - centre;
            let down = -d.dot(up);
            d.cross(tangent).norm() < 0.01 * r || down < 0.0 || (d + up * down).norm() > 4.0 * r
        })
    };
    let flat = spots.into_iter().filter(|s| s.1.dot(up).abs() < 0.3);
    flat.filter(|s| is_free(s, points, r) && free_below(s)).take(3).collect()
}

/// Where jaws hold the tube: up to two of its longest straights, away from other legs and from where it rests.
fn grips(spine: &Spine, points: &[Point3<f64>], r: f64, up: &Vector3<f64>, rests: &[Spot]) -> Vec<Spot> {
    let apart = |s: &Spot| rests.iter().all(|rest| (rest.0 - s.0).norm() > 4.0 * r);
    let spots = spots(spine, 6.0 * r, |_| &[0.5]).into_iter();
    spots.filter(|s| s.1.dot(up).abs() < 0.8 && apart(s) && is_free(s, points, r)).take(2).collect()
}

/// Places on straights of more than a length, the longest first, at the given shares of each.
fn spots(spine: &Spine, least_mm: f64, shares: impl Fn(f64) -> &'static [f64]) -> Vec<Spot> {
    let mut lines: Vec<_> =
        spine.segments().iter().filter(|s| s.kind == SegmentKind::Line && s.length_mm > least_mm).collect();
    lines.sort_by(|a, b| b.length_mm.total_cmp(&a.length_mm));
    let on = |s: &&Segment| -> Vec<Spot> {
        let at = |share: &f64| {
            let frame = s.frame_at(share * s.length_mm);
            (Point3::from(frame.translation.vector), frame.rotation * Vector3::x())
        };
        shares(s.length_mm).iter().map(at).collect()
    };
    lines.iter().flat_map(on).collect()
}

/// Whether no other leg comes within four radii.
fn is_free((centre, tangent): &Spot, points: &[Point3<f64>], r: f64) -> bool {
    points.iter().all(|p| {
        let d = p - centre;
        d.cross(tangent).norm() < 0.01 * r || d.norm() > 4.0 * r
    })
}

/// Upwards and sideways across a straight.
fn across(tangent: &Vector3<f64>, up: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let high = (up - tangent * tangent.dot(up)).normalize();
    (high, tangent.cross(&high))
}

/// A block with a V of 90 degrees that touches the tube along two lines: two convex halves.
fn v_block(centre: &Point3<f64>, tangent: &Vector3<f64>, up: &Vector3<f64>, r: f64, floor: f64) -> Vec<Prop> {
    let (high, side) = across(tangent, up);
    let bottom = (-up, -floor);
    [side, -side].map(|side| v_half(centre, tangent, &high, &side, (r, 0.2 * r, 2.2 * r), bottom)).into()
}

/// Two jaws with a V of 90 degrees, one from either side; a gap of a radius stays between them.
fn grip(centre: &Point3<f64>, tangent: &Vector3<f64>, up: &Vector3<f64>, r: f64) -> Vec<Prop> {
    let (high, side) = across(tangent, up);
    let jaw = |side: Vector3<f64>| {
        let back = (side, side.dot(&centre.coords) + 2.0 * r);
        [high, -high].map(|half| v_half(centre, tangent, &-side, &half, (r, 0.5 * r, 1.3 * r), back))
    };
    [side, -side].into_iter().flat_map(jaw).collect()
}

/// Half of a body with a V that opens towards `open`: tube radius, distance of its front from the tube's centre line,
/// and how far it reaches towards `half`.
fn v_half(
    centre: &Point3<f64>,
    tangent: &Vector3<f64>,
    open: &Vector3<f64>,
    half: &Vector3<f64>,
    (r, front, wide): (f64, f64, f64),
    back: (Vector3<f64>, f64),
) -> Prop {
    let at = |n: Vector3<f64>, mm: f64| (n, n.dot(&centre.coords) + mm);
    let groove = (open - half).normalize();
    let faces = vec![
        at(groove, -r),
        at(*half, wide),
        at(-half, 0.0),
        at(*tangent, r),
        at(-tangent, r),
        at(*open, -front),
        back,
    ];
    Prop { faces }
}

/// A jaw with a flat face that touches the tube along a line.
fn flat_jaw(centre: &Point3<f64>, tangent: &Vector3<f64>, up: &Vector3<f64>, r: f64) -> Prop {
    let (high, side) = across(tangent, up);
    let at = |n: Vector3<f64>, mm: f64| (n, n.dot(&centre.coords) + mm);
    let faces = vec![
        at(-side, -r),
        at(side, 3.0 * r),
        at(*tangent, 1.5 * r),
        at(-tangent, 1.5 * r),
        at(high, 0.6 * r),
        at(-high, 1.2 * r),
    ];
    Prop { faces }
}
