//! Jets: normal and principal curvatures of the surface around a point, by a weighted quadratic fit over the
//! tangent plane of a weighted principal component analysis (paper 000, sections 2.1 and 2.2).

use nalgebra::{Matrix2, Matrix3, Matrix6, Point3, SymmetricEigen, Vector3, Vector6};

/// Second-order picture of a surface at one point.
///
/// The normal points to the outside of the stronger bend: a tube's radius r in from the point against the normal
/// lies on its axis, whichever side the scanner stood on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jet {
    /// The point, moved onto the fitted surface.
    pub foot: Point3<f64>,
    /// Unit normal away from the centre of the strongest curvature.
    pub normal: Vector3<f64>,
    /// Strongest curvature, >= 0, 1/mm.
    pub strong_per_mm: f64,
    /// The other principal curvature; negative on a saddle, 1/mm.
    pub weak_per_mm: f64,
    /// Unit direction of the weak curvature: a tube's axis direction.
    pub weak_direction: Vector3<f64>,
    /// Weighted root mean square distance of the neighbours from the fitted surface.
    pub rms_mm: f64,
}

/// Fewest neighbours that make a jet (paper 000, section 7).
pub const MIN_NEIGHBOURS: usize = 10;

/// Fits the jet at `point` to the neighbours within `radius_mm`, weighted down to zero at that distance. None
/// with fewer than [`MIN_NEIGHBOURS`] or when they do not span a surface patch.
pub fn fit_jet(point: &Point3<f64>, neighbours: &[Point3<f64>], radius_mm: f64) -> Option<Jet> {
    if neighbours.len() < MIN_NEIGHBOURS {
        return None;
    }
    let weight = |q: &Point3<f64>| {
        let t = (q - point).norm_squared() / (radius_mm * radius_mm);
        (1.0 - t).max(0.0).powi(2)
    };
    let frame = tangent_frame(point, neighbours, weight)?;
    // Unit of length: the neighbourhood's radius, so that the normal equations are well scaled.
    let axes: [Vector3<f64>; 3] = std::array::from_fn(|k| frame.column(k) / radius_mm);
    // Moments of x and y by their powers, weighted; and of z times those up to second order.
    let (mut m, mut z) = ([0.0; 15], [0.0; 6]);
    let mut square_z = 0.0;
    for q in neighbours {
        let w = weight(q);
        let d = q - point;
        let (x, y, height) = (d.dot(&axes[0]), d.dot(&axes[1]), d.dot(&axes[2]));
        let (xx, xy, yy) = (x * x, x * y, y * y);
        let (wx, wy, wxx, wxy, wyy) = (w * x, w * y, w * xx, w * xy, w * yy);
        let terms = [
            wxx * xx,
            wxx * xy,
            wxx * yy,
            wxy * yy,
            wyy * yy, //
            wxx * x,
            wxx * y,
            wyy * x,
            wyy * y, //
            wxx,
            wxy,
            wyy,
            wx,
            wy,
            w,
        ];
        for k in 0..15 {
            m[k] += terms[k];
        }
        for (sum, term) in z.iter_mut().zip([wxx, wyy, wxy, wx, wy, w]) {
            *sum += term * height;
        }
        square_z += w * height * height;
    }
    let [x4, x3y, x2y2, xy3, y4, x3, x2y, xy2, y3, x2, xy, y2, x, y, total] = m;
    let normal_matrix = Matrix6::new(
        x4, x2y2, x3y, x3, x2y, x2, //
        x2y2, y4, xy3, xy2, y3, y2, //
        x3y, xy3, x2y2, x2y, xy2, xy, //
        x3, xy2, x2y, x2, xy, x, //
        x2y, y3, xy2, xy, y2, y, //
        x2, y2, xy, x, y, total,
    );
    let right = Vector6::from(z);
    let c = normal_matrix.cholesky()?.solve(&right);
    let rms_mm = ((square_z - c.dot(&right)).max(0.0) / total).sqrt() * radius_mm;
    shape_operator(point, &frame, &c, radius_mm, rms_mm)
}

/// Columns: two tangents and the normal, by principal component analysis.
fn tangent_frame(
    point: &Point3<f64>,
    neighbours: &[Point3<f64>],
    weight: impl Fn(&Point3<f64>) -> f64,
) -> Option<Matrix3<f64>> {
    let (mut total, mut first, mut second) = (0.0, Vector3::zeros(), [0.0; 6]);
    for q in neighbours {
        let (w, d) = (weight(q), q - point);
        let wd = d * w;
        total += w;
        first += wd;
        let products = [wd.x * d.x, wd.x * d.y, wd.x * d.z, wd.y * d.y, wd.y * d.z, wd.z * d.z];
        for k in 0..6 {
            second[k] += products[k];
        }
    }
    if total <= 0.0 {
        return None;
    }
    let [xx, xy, xz, yy, yz, zz] = second;
    let covariance = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz) - first * first.transpose() / total;
    let eigen = SymmetricEigen::new(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let axis = |k: usize| eigen.eigenvectors.column(order[k]).into_owned();
    // A row of points (one scan stripe) has no tangent plane.
    if eigen.eigenvalues[order[1]] < 1e-3 * eigen.eigenvalues[order[0]] {
        return None;
    }
    let (x, y) = (axis(0), axis(1));
    Some(Matrix3::from_columns(&[x, y, x.cross(&y)]))
}

/// Principal curvatures of the fitted paraboloid at the point (paper 000, section 2.2).
fn shape_operator(
    point: &Point3<f64>,
    frame: &Matrix3<f64>,
    c: &Vector6<f64>,
    unit_mm: f64,
    rms_mm: f64,
) -> Option<Jet> {
    let (a, b, mixed, d, e) = (c[0], c[1], c[2], c[3], c[4]);
    let slope = (1.0 + d * d + e * e).sqrt();
    let first = Matrix2::new(d * d + 1.0, d * e, d * e, e * e + 1.0);
    let second = Matrix2::new(2.0 * a, mixed, mixed, 2.0 * b) / slope;
    // Symmetric form of G^-1 H: with G = L L^T the eigenvalues of L^-1 H L^-T are the principal curvatures.
    let lower = first.cholesky()?.l();
    let inverse = lower.try_inverse()?;
    let eigen = SymmetricEigen::new(inverse * second * inverse.transpose());
    let (k0, k1) = (eigen.eigenvalues[0], eigen.eigenvalues[1]);
    let (strong, weak, weak_index) = if k0.abs() >= k1.abs() { (k0, k1, 1) } else { (k1, k0, 0) };
    let uv = inverse.transpose() * eigen.eigenvectors.column(weak_index);
    let weak_direction = frame * Vector3::new(uv.x, uv.y, d * uv.x + e * uv.y);
    let upward = frame * Vector3::new(-d, -e, 1.0) / slope;
    // Positive curvature bends towards +normal: the centre lies there, so the outside is the other way.
    let outward = if strong > 0.0 { -upward } else { upward };
    let foot = point + frame * Vector3::new(0.0, 0.0, c[5] * unit_mm);
    Some(Jet {
        foot,
        normal: outward,
        strong_per_mm: strong.abs() / unit_mm,
        weak_per_mm: weak * strong.signum() / unit_mm,
        weak_direction: weak_direction.normalize(),
        rms_mm,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Points of a torus patch (major radius `big`, minor `small`) around the place at angle `phi`.
    fn torus_patch(big: f64, small: f64, phi: f64, reach: f64) -> (Point3<f64>, Vec<Point3<f64>>) {
        let at = |u: f64, v: f64| {
            let ring = big + small * v.cos();
            Point3::new(ring * u.cos(), ring * u.sin(), small * v.sin())
        };
        let centre = at(0.0, phi);
        let mut points = Vec::new();
        for i in -12..=12 {
            for j in -12..=12 {
                let q = at(i as f64 * reach / 12.0 / (big - small), phi + j as f64 * reach / 12.0 / small);
                if (q - centre).norm() < reach {
                    points.push(q);
                }
            }
        }
        (centre, points)
    }

    proptest! {
        #[test]
        fn curvatures_of_a_torus(small in 1.0..50.0f64, ratio in 2.5..8.0f64, phi in 0.0..std::f64::consts::TAU) {
            let big = small * ratio;
            let (centre, points) = torus_patch(big, small, phi, 0.1 * small);
            let jet = fit_jet(&centre, &points, 0.1 * small).unwrap();
            let weak = phi.cos() / (big + small * phi.cos());
            prop_assert!((jet.strong_per_mm * small - 1.0).abs() < 0.02);
            prop_assert!((jet.weak_per_mm - weak).abs() * small < 0.02);
            let outward = Vector3::new(phi.cos(), 0.0, phi.sin());
            prop_assert!(jet.normal.dot(&outward) > 0.999);
            prop_assert!(jet.weak_direction.y.abs() > 0.999);
        }
    }

    #[test]
    fn too_few_or_collinear_neighbours_make_no_jet() {
        let row: Vec<Point3<f64>> = (0..50).map(|i| Point3::new(i as f64 * 0.01, 0.0, 0.0)).collect();
        assert_eq!(fit_jet(&row[25], &row, 1.0), None);
        assert_eq!(fit_jet(&row[0], &row[..9], 1.0), None);
    }
}
