//! Rigid registration of point pairs (Kabsch): the motion that lays one tube over another.
//!
//! Used by `reconstruct` (nominal onto cloud) and `inspect` (measured onto nominal).

use nalgebra::{DMatrix, Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};

/// One pair: `from` is moved, `to` stays; `weight` >= 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    /// The point that is moved.
    pub from: Point3<f64>,
    /// The point that it should meet.
    pub to: Point3<f64>,
    /// Its share in the sum of squares.
    pub weight: f64,
}

/// A registration: the motion and what is left after it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Registration {
    /// Takes `from` to `to`.
    pub motion: Isometry3<f64>,
    /// Weighted root mean square distance after the motion.
    pub rms_mm: f64,
}

/// The proper rigid motion with the smallest weighted sum of squared distances (W. Kabsch 1976, 1978).
/// Never mirrors. With fewer than three pairs or collinear points the free turn is chosen arbitrarily but
/// always alike; None without any weight.
pub fn register(pairs: &[Pair]) -> Option<Registration> {
    let total: f64 = pairs.iter().map(|p| p.weight).sum();
    if total.is_nan() || total <= 0.0 {
        return None;
    }
    let mean = |pick: fn(&Pair) -> &Point3<f64>| -> Vector3<f64> {
        pairs.iter().map(|p| pick(p).coords * p.weight).sum::<Vector3<f64>>() / total
    };
    let (from, to) = (mean(|p| &p.from), mean(|p| &p.to));
    let covariance: Matrix3<f64> =
        pairs.iter().map(|p| (p.to.coords - to) * (p.from.coords - from).transpose() * p.weight).sum();
    let (u, v_t) = singular_vectors(covariance)?;
    let sign = (u * v_t).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let motion = Isometry3::from_parts((to - rotation * from).into(), rotation);
    let square: f64 = pairs.iter().map(|p| (motion * p.from - p.to).norm_squared() * p.weight).sum();
    Some(Registration { motion, rms_mm: (square / total).sqrt() })
}

/// Points of nearly one line leave the turn about it to little weights. The fast decomposition of 3 by 3 matrices squares them, and
/// loses what is a millionth of the rest: there the slow one is taken.
fn singular_vectors(matrix: Matrix3<f64>) -> Option<(Matrix3<f64>, Matrix3<f64>)> {
    const NEARLY_A_LINE: f64 = 1e-4;
    let svd = matrix.svd(true, true);
    if svd.singular_values[1] > NEARLY_A_LINE * svd.singular_values[0] {
        return Some((svd.u?, svd.v_t?));
    }
    let svd = DMatrix::from_column_slice(3, 3, matrix.as_slice()).svd(true, true);
    let fixed = |m: DMatrix<f64>| Matrix3::from_column_slice(m.as_slice());
    Some((fixed(svd.u?), fixed(svd.v_t?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(points: &[[f64; 3]], motion: &Isometry3<f64>) -> Vec<Pair> {
        let pair = |p: &[f64; 3]| {
            let from = Point3::from(*p);
            Pair { from, to: motion * from, weight: 1.0 }
        };
        points.iter().map(pair).collect()
    }

    #[test]
    fn finds_a_known_motion() {
        let motion = Isometry3::new(Vector3::new(5.0, -3.0, 100.0), Vector3::new(0.3, -2.0, 1.0));
        let found = register(&pairs(
            &[[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 50.0, 0.0], [90.0, 50.0, 30.0]],
            &motion,
        ))
        .unwrap();
        assert!(found.rms_mm < 1e-10);
        assert!((found.motion.to_homogeneous() - motion.to_homogeneous()).norm() < 1e-9);
    }

    #[test]
    fn never_mirrors() {
        let points = [[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 50.0, 0.0], [90.0, 50.0, 30.0]];
        let mirrored: Vec<Pair> = points
            .iter()
            .map(|p| Pair { from: Point3::from(*p), to: Point3::new(p[0], p[1], -p[2]), weight: 1.0 })
            .collect();
        let found = register(&mirrored).unwrap();
        assert!((found.motion.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-9);
        assert!(found.rms_mm > 1.0);
    }

    /// Found: the turn about a straight was anywhere where the points beside it weigh a millionth.
    #[test]
    fn a_line_is_turned_by_what_weighs_little() {
        let motion = Isometry3::new(Vector3::new(5.0, -3.0, 100.0), Vector3::new(0.3, -2.0, 1.0));
        let points =
            [[0.0, 0.0, 0.0], [150.0, 0.0, 0.0], [300.0, 0.0, 0.0], [-80.0, 50.0, 0.0], [-90.0, 80.0, 5.0]];
        let mut pairs = pairs(&points, &motion);
        pairs[3..].iter_mut().for_each(|p| p.weight = 1e-6);
        let found = register(&pairs).unwrap();
        assert!(pairs.iter().all(|p| (found.motion * p.from - p.to).norm() < 1e-6));
    }

    #[test]
    fn without_weight_there_is_no_answer() {
        assert_eq!(register(&[]), None);
    }
}
