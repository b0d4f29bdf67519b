//! Weighted least-squares fit of a cylinder with a moving centre: the elementary step of the spine's
//! reconstruction (paper 000, section 3).

use nalgebra::{Matrix5, Point3, Vector2, Vector3, Vector5};

/// A local cylinder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cylinder {
    /// The starting point projected onto the axis.
    pub centre: Point3<f64>,
    /// Unit axis.
    pub axis: Vector3<f64>,
    /// Radius.
    pub radius_mm: f64,
    /// Weighted root mean square distance of the points that count.
    pub rms_mm: f64,
    /// Points that count.
    pub count: usize,
    /// How far around it its points reach: 1 less the length of their mean normal, 0 for a single line, 1 all around.
    /// A cylinder on the wrong side of a surface only touches it along a narrow strip.
    pub opening: f64,
    /// Share of the points around its centre that count: little where something else lies beside the tube.
    pub share: f64,
}

/// Support of the weights around the centre in tube radii: a piece of tube about 1.3 radii long (paper 000,
/// section 3.2).
const SUPPORT_RADII: f64 = 1.2;

impl Cylinder {
    /// A first guess: a point near the axis and its direction.
    pub fn guess(centre: Point3<f64>, axis: Vector3<f64>, radius_mm: f64) -> Cylinder {
        Cylinder { centre, axis, radius_mm, rms_mm: 0.0, count: 0, opening: 0.0, share: 0.0 }
    }
}

/// Points that a fit needs to see around the first guess of its centre, in tube radii.
pub const REACH_RADII: f64 = 1.4;

/// Points farther from the cylinder than this share of its radius do not count (paper 000, section 7).
const OUTLIER_RADII: f64 = 0.1;

/// Steps at most; the first one or two look wide, so that a poor start can be left: the second when the first was longer than
/// this share of the radius.
const STEPS: usize = 10;
const WIDE_STEPS: usize = 2;
const LONG_RADII: f64 = 0.03;

/// A step smaller than this share of the radius is the last.
const SETTLED_RADII: f64 = 1e-3;

/// Fits a cylinder to the points around a starting axis; with `free_radius` its radius too. None when the points do
/// not determine it or the axis runs away from its start.
pub fn fit_cylinder(points: &[Point3<f64>], start: &Cylinder, free_radius: bool) -> Option<Cylinder> {
    let (mut at, mut wide) = (*start, true);
    for step in 1..=STEPS {
        let outlier = at.radius_mm * if wide { 3.0 * OUTLIER_RADII } else { OUTLIER_RADII };
        let (u, v) = across(&at.axis);
        let sums = Sums::over(points, &at, (&u, &v), outlier);
        if sums.count < crate::recognize::MIN_NEIGHBOURS {
            return None;
        }
        let change = sums.solve(free_radius)?;
        let scale = at.radius_mm;
        let axis = (at.axis + (u * change[2] + v * change[3]) / scale).normalize();
        let through = at.centre + u * change[0] + v * change[1];
        let normals = Vector2::new(sums.first[0], sums.first[1]);
        at = Cylinder {
            centre: through + axis * (start.centre - through).dot(&axis),
            axis,
            radius_mm: at.radius_mm + change[4],
            rms_mm: (sums.square / sums.weight).sqrt(),
            count: sums.count,
            opening: 1.0 - normals.norm() / sums.weight,
            share: sums.count as f64 / sums.seen as f64,
        };
        let sane = at.radius_mm > 0.5 * start.radius_mm && at.radius_mm < 2.0 * start.radius_mm;
        let stays =
            (at.centre - start.centre).norm() < start.radius_mm && at.axis.dot(&start.axis).abs() > 0.7;
        if !(sane && stays) {
            return None;
        }
        if !wide && change.amax() < SETTLED_RADII * scale {
            break;
        }
        wide = step < WIDE_STEPS && change.amax() > LONG_RADII * scale;
    }
    Some(at)
}

/// Two unit vectors across a direction.
fn across(axis: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let other = if axis.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let u = axis.cross(&other).normalize();
    (u, axis.cross(&u))
}

/// Normal equations of one Gauss-Newton step. A row is minus (m, l m, 1): m the normal across the axis (two values), l
/// the lever along it in radii; so products of m, weighted with 1, l and l squared, are all that is needed.
#[derive(Default)]
struct Sums {
    /// `m m^T` (uu, uv, vv) times 1, l, l^2.
    products: [[f64; 3]; 3],
    /// m and l m.
    first: [f64; 4],
    /// The same times the residual.
    right: [f64; 4],
    /// Residuals.
    residual: f64,
    square: f64,
    weight: f64,
    count: usize,
    /// Points in the support that are not far outside the tube.
    seen: usize,
}

impl Sums {
    fn over(
        points: &[Point3<f64>],
        at: &Cylinder,
        (u, v): (&Vector3<f64>, &Vector3<f64>),
        outlier_mm: f64,
    ) -> Sums {
        let support = 1.0 / (SUPPORT_RADII * at.radius_mm).powi(2);
        let (per_radius, per_outlier) = (1.0 / at.radius_mm, 1.0 / outlier_mm);
        let mut sums = Sums::default();
        for p in points {
            let from = p - at.centre;
            let near = 1.0 - from.norm_squared() * support;
            let (x, y) = (from.dot(u), from.dot(v));
            let square = x * x + y * y;
            if near <= 0.0 || square <= 0.0 {
                continue;
            }
            sums.seen += 1;
            let distance = square.sqrt();
            let residual = distance - at.radius_mm;
            let off = residual * per_outlier;
            let good = 1.0 - off * off;
            if good <= 0.0 {
                continue;
            }
            let w = near * near * good * good;
            let l = from.dot(&at.axis) * per_radius;
            let (mu, mv) = (x / distance, y / distance);
            let (wu, wv) = (w * mu, w * mv);
            let mut products = [wu * mu, wu * mv, wv * mv];
            for sum in &mut sums.products {
                for k in 0..3 {
                    sum[k] += products[k];
                    products[k] *= l;
                }
            }
            let first = [wu, wv, l * wu, l * wv];
            for (k, value) in first.iter().enumerate() {
                sums.first[k] += value;
                sums.right[k] += value * residual;
            }
            sums.residual += w * residual;
            sums.square += w * residual * residual;
            sums.weight += w;
            sums.count += 1;
        }
        sums
    }

    /// Shift u, shift v, tilt u, tilt v (at one radius), radius.
    fn solve(&self, free_radius: bool) -> Option<Vector5<f64>> {
        let ([a, b, c], f, r) = (self.products, self.first, self.right);
        let mut normal = Matrix5::new(
            a[0],
            a[1],
            b[0],
            b[1],
            f[0], //
            a[1],
            a[2],
            b[1],
            b[2],
            f[1], //
            b[0],
            b[1],
            c[0],
            c[1],
            f[2], //
            b[1],
            b[2],
            c[1],
            c[2],
            f[3], //
            f[0],
            f[1],
            f[2],
            f[3],
            self.weight,
        );
        let mut right = Vector5::new(r[0], r[1], r[2], r[3], self.residual);
        if !free_radius {
            normal.fixed_view_mut::<1, 4>(4, 0).fill(0.0);
            normal.fixed_view_mut::<4, 1>(0, 4).fill(0.0);
            right[4] = 0.0;
        }
        // A touch of damping: a narrow strip of surface leaves one shift nearly free.
        for k in 0..5 {
            normal[(k, k)] += 1e-6 * self.weight;
        }
        Some(normal.cholesky()?.solve(&right))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Half a cylinder about an axis through `centre`, seen from one side.
    fn half_cylinder(centre: &Point3<f64>, axis: &Vector3<f64>, radius: f64) -> Vec<Point3<f64>> {
        let (u, v) = across(axis);
        (0..900)
            .map(|i| {
                let around = ((i % 30) as f64 / 29.0 - 0.5) * 2.6;
                let along = ((i / 30) as f64 / 29.0 - 0.5) * 2.0 * radius;
                centre + axis * along + (u * around.cos() + v * around.sin()) * radius
            })
            .collect()
    }

    proptest! {
        #[test]
        fn finds_the_axis_from_a_poor_start(
            x in -100.0..100.0f64, ax in -1.0..1.0f64, ay in -1.0..1.0f64, radius in 1.0..50.0f64,
            off in -0.2..0.2f64, tilt in -0.3..0.3f64,
        ) {
            let centre = Point3::new(x, 3.0, -5.0);
            let axis = Vector3::new(ax, ay, 1.0).normalize();
            let points = half_cylinder(&centre, &axis, radius);
            let (u, v) = across(&axis);
            let start = Cylinder::guess(centre + (u + v) * off * radius, (axis + u * tilt).normalize(), radius * 1.04);
            let found = fit_cylinder(&points, &start, true).unwrap();
            prop_assert!((found.radius_mm - radius).abs() < 1e-4 * radius);
            prop_assert!(found.axis.cross(&axis).norm() < 1e-4);
            prop_assert!((found.centre - centre).cross(&axis).norm() < 1e-4 * radius);
        }
    }

    #[test]
    fn a_plane_is_no_cylinder() {
        let plane: Vec<_> =
            (0..400).map(|i| Point3::new((i % 20) as f64 * 0.1, (i / 20) as f64 * 0.1, 0.0)).collect();
        let start = Cylinder::guess(Point3::new(1.0, 1.0, -1.0), Vector3::x(), 1.0);
        let found = fit_cylinder(&plane, &start, true);
        assert!(found.is_none_or(|c| c.count < 200), "{found:?}");
    }
}
