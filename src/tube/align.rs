//! Rigid registration of point pairs (Kabsch): the motion that lays one tube over another.
//!
//! Used by `reconstruct` (nominal onto cloud) and `inspect` (measured onto nominal).

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};

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
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = (u * v_t).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let motion = Isometry3::from_parts((to - rotation * from).into(), rotation);
    let square: f64 = pairs.iter().map(|p| (motion * p.from - p.to).norm_squared() * p.weight).sum();
    Some(Registration { motion, rms_mm: (square / total).sqrt() })
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

    #[test]
    fn without_weight_there_is_no_answer() {
        assert_eq!(register(&[]), None);
    }
}
