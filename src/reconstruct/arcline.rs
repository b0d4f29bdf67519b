//! A polygon to an arc-line spline with the fewest arcs: shortest path on the shortcut graph with modified tangents
//! (paper 000, section 4, Algorithm 1). An edge i - j says that the vertices from i to j + 1 lie within the tolerance
//! of line, arc, line; the arc's possible centres come from the Apollonius construction (see `apollonius`).

use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector2, Vector3};

use super::apollonius::{Chain, solve};
use crate::tube::{Bend, Frame, Lra, any_normal};

/// What an arc may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Largest distance of a vertex from the spline.
    pub tolerance_mm: f64,
    /// Smallest radius of an arc.
    pub min_radius_mm: f64,
}

/// One arc with the two points where it touches its tangent lines.
#[derive(Debug, Clone, Copy)]
struct Arc {
    begin: Point3<f64>,
    end: Point3<f64>,
    /// Unit normal of its plane, right-handed to the turn.
    normal: Vector3<f64>,
    radius_mm: f64,
    angle_rad: f64,
}

/// Best way found to a vertex.
#[derive(Debug, Clone)]
struct Reached {
    arcs: usize,
    error: f64,
    before: usize,
    /// Where the vertex lies on its modified tangent line.
    point: Point3<f64>,
    arc: Option<Arc>,
}

/// Approximates the polygon; None when no spline within the limits was found. Fewer than two vertices are no curve.
pub fn approximate(vertices: &[Point3<f64>], limits: Limits) -> Option<(Lra, Frame)> {
    let n = vertices.len();
    if n < 2 {
        return None;
    }
    let mut reached: Vec<Option<Reached>> = vec![None; n - 1];
    reached[0] = Some(Reached { arcs: 0, error: 0.0, before: 0, point: vertices[0], arc: None });
    for i in 0..n - 1 {
        let Some(from) = reached[i].clone() else { continue };
        for (j, to) in reached.iter_mut().enumerate().skip(i + 1) {
            if to.as_ref().is_some_and(|r| r.arcs <= from.arcs) {
                continue;
            }
            let Some((arc, point, error)) = edge(vertices, i, &from, j, limits) else { continue };
            let candidate =
                Reached { arcs: from.arcs + 1, error: from.error + error, before: i, point, arc: Some(arc) };
            let better = |old: &Reached| (candidate.arcs, candidate.error) < (old.arcs, old.error);
            if to.as_ref().is_none_or(better) {
                *to = Some(candidate);
            }
        }
    }
    let mut arcs = Vec::new();
    let mut at = n - 2;
    while let Some(Reached { arc: Some(arc), before, .. }) = &reached[at] {
        arcs.push(*arc);
        at = *before;
    }
    if at != 0 {
        return None;
    }
    arcs.reverse();
    Some(lay_out(vertices[0], vertices[1], vertices[n - 1], &arcs))
}

/// Tests the edge i - j and returns its arc, vertex j on the modified tangent, and the squared error.
fn edge(
    vertices: &[Point3<f64>],
    i: usize,
    from: &Reached,
    j: usize,
    limits: Limits,
) -> Option<(Arc, Point3<f64>, f64)> {
    let (origin, last) = (from.point, vertices[j + 1]);
    let first = (vertices[i + 1] - origin).try_normalize(1e-9)?;
    let normal = first.cross(&(last - origin)).try_normalize(1e-9)?;
    let axes = Matrix3::from_columns(&[first, normal.cross(&first), normal]);
    let flat = |p: &Point3<f64>| axes.tr_mul(&(p - origin));
    let mut points = Vec::with_capacity(j - i);
    for vertex in &vertices[i + 1..=j] {
        let local = flat(vertex);
        let left = limits.tolerance_mm.powi(2) - local.z.powi(2);
        if left < 0.0 {
            return None;
        }
        points.push((Vector2::new(local.x, local.y), left.sqrt()));
    }
    let turning = points[points.len() - 1].0;
    let finish = flat(&last).xy();
    // The end of the arc before bounds where this one may begin.
    let begin_at = from.arc.map_or(0.0, |arc| (arc.end - origin).dot(&first));
    let side = |mirror: f64| {
        let flip = |v: Vector2<f64>| Vector2::new(v.x, mirror * v.y);
        let chain = Chain {
            points: points.iter().map(|(p, e)| (flip(*p), *e)).collect(),
            turning: flip(turning),
            finish: flip(finish),
            begin_at,
            tolerance_mm: limits.tolerance_mm,
            min_radius_mm: limits.min_radius_mm,
        };
        let found = solve(&chain)?;
        let lift = |v: Vector2<f64>| origin + axes * Vector3::new(v.x, mirror * v.y, 0.0);
        let arc = Arc {
            begin: lift(found.begin),
            end: lift(found.end),
            normal: normal * mirror,
            radius_mm: found.radius_mm,
            angle_rad: found.angle_rad,
        };
        Some((arc, found.squared_error))
    };
    let found = [side(1.0), side(-1.0)].into_iter().flatten();
    let (arc, error) = found.min_by(|a, b| a.1.total_cmp(&b.1))?;
    let on_plane = origin + axes * Vector3::new(turning.x, turning.y, 0.0);
    Some((arc, on_plane, error))
}

/// Arcs in order to LRA and the pose of the first straight. Straights that came out negative become 0.
fn lay_out(first: Point3<f64>, second: Point3<f64>, last: Point3<f64>, arcs: &[Arc]) -> (Lra, Frame) {
    let mut lra = Lra::default();
    let mut at = first;
    let mut tangent = (second - first).normalize();
    let mut normal = arcs.first().map_or_else(|| any_normal(&tangent), |a| a.normal);
    let axes = Matrix3::from_columns(&[tangent, normal.cross(&tangent), normal]);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    for arc in arcs {
        lra.bends.push(Bend {
            length_mm: (arc.begin - at).dot(&tangent).max(0.0),
            rotation_rad: normal.cross(&arc.normal).dot(&tangent).atan2(normal.dot(&arc.normal)),
            angle_rad: arc.angle_rad,
            radius_mm: arc.radius_mm,
        });
        tangent = Rotation3::from_scaled_axis(arc.normal * arc.angle_rad) * tangent;
        (at, normal) = (arc.end, arc.normal);
    }
    lra.last_length_mm = (last - at).dot(&tangent).max(0.0);
    (lra, Frame::from_parts(first.into(), turn))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruct::simplify::simplify;
    use crate::tube::Spine;

    fn bend(length_mm: f64, rotation_deg: f64, angle_deg: f64, radius_mm: f64) -> Bend {
        Bend {
            length_mm,
            rotation_rad: rotation_deg.to_radians(),
            angle_rad: angle_deg.to_radians(),
            radius_mm,
        }
    }

    /// Samples a tube's spine, simplifies it and asks for the arc-line spline.
    fn round_trip(lra: &Lra) -> Lra {
        let start = Frame::new(Vector3::new(3.0, 40.0, -9.0), Vector3::new(1.0, 0.2, -0.4));
        let points = Spine::from_lra(lra, start).sampled(2.0);
        let kept: Vec<Point3<f64>> = simplify(&points, 0.3).into_iter().map(|i| points[i]).collect();
        let limits = Limits { tolerance_mm: 0.8, min_radius_mm: 10.0 };
        approximate(&kept, limits).unwrap().0
    }

    fn assert_close(found: &Lra, expected: &Lra) {
        assert_eq!(found.bends.len(), expected.bends.len(), "{found:#?}");
        for (f, e) in found.bends.iter().zip(&expected.bends).skip(1) {
            assert!((f.angle_rad - e.angle_rad).abs() < 0.12, "{f:?} {e:?}");
            assert!(crate::tube::wrap_angle(f.rotation_rad - e.rotation_rad).abs() < 0.15, "{f:?} {e:?}");
        }
    }

    #[test]
    fn bends_in_space() {
        let lra = Lra {
            bends: vec![
                bend(100.0, 0.0, 90.0, 40.0),
                bend(60.0, 90.0, 45.0, 40.0),
                bend(80.0, -60.0, 120.0, 40.0),
                bend(70.0, 180.0, 30.0, 40.0),
            ],
            last_length_mm: 90.0,
        };
        assert_close(&round_trip(&lra), &lra);
    }

    #[test]
    fn a_half_turn_and_more_than_a_half_turn() {
        for angle in [170.0, 179.9, 180.0, 181.0, 220.0, 270.0] {
            let lra = Lra {
                bends: vec![bend(90.0, 0.0, 60.0, 40.0), bend(70.0, 100.0, angle, 40.0)],
                last_length_mm: 60.0,
            };
            assert_close(&round_trip(&lra), &lra);
        }
    }

    #[test]
    fn a_straight_tube_has_no_bend() {
        let (lra, _) = approximate(
            &[Point3::origin(), Point3::new(100.0, 1.0, 0.0)],
            Limits { tolerance_mm: 0.5, min_radius_mm: 5.0 },
        )
        .unwrap();
        assert_eq!(lra.bends.len(), 0);
        assert!((lra.last_length_mm - 100.005).abs() < 1e-3);
    }
}
