//! Polygon simplification: the fewest vertices within a tolerance, and of all such polygons the one with the
//! smallest squared error (paper 000, section 4.5; shortcut graph after D. Eu and G. Toussaint 1994).

use std::ops::RangeInclusive;

use nalgebra::{Matrix3, Point3, Vector3};

/// Sums over the first k points, for squared errors of any chord in constant time.
struct Prefix {
    origin: Point3<f64>,
    first: Vec<Vector3<f64>>,
    second: Vec<Matrix3<f64>>,
}

impl Prefix {
    fn new(points: &[Point3<f64>]) -> Prefix {
        let origin = points[0];
        let (mut first, mut second) = (vec![Vector3::zeros()], vec![Matrix3::zeros()]);
        for (i, p) in points.iter().enumerate() {
            let d = p - origin;
            first.push(first[i] + d);
            second.push(second[i] + d * d.transpose());
        }
        Prefix { origin, first, second }
    }

    /// Sum of squared distances of points i+1 .. j-1 from the line through points i and j.
    fn squared_error(&self, points: &[Point3<f64>], i: usize, j: usize) -> f64 {
        let (a, chord) = (points[i] - self.origin, points[j] - points[i]);
        let n = (j - i).saturating_sub(1) as f64;
        let length = chord.norm_squared();
        if n == 0.0 || length <= 0.0 {
            return 0.0;
        }
        let sum = self.first[j] - self.first[i + 1];
        let square = self.second[j] - self.second[i + 1];
        let shifted = square - sum * a.transpose() - a * sum.transpose() + a * a.transpose() * n;
        (shifted.trace() - (chord.transpose() * shifted * chord)[(0, 0)] / length).max(0.0)
    }
}

/// Indices of the kept vertices, first and last included. A polygon of fewer than three points is kept.
pub fn simplify(points: &[Point3<f64>], tolerance_mm: f64) -> Vec<usize> {
    let n = points.len();
    if n < 3 {
        return (0..n).collect();
    }
    let prefix = Prefix::new(points);
    let mut edges = vec![usize::MAX; n];
    let mut error = vec![f64::INFINITY; n];
    let mut before = vec![0; n];
    (edges[0], error[0]) = (0, 0.0);
    for i in 0..n - 1 {
        for j in i + 1..n {
            let count = edges[i] + 1;
            // The middle is where a chord usually fails, and costs least.
            if count > edges[j] || !within(points, i, j, (i + j) / 2..=(i + j) / 2, tolerance_mm) {
                continue;
            }
            let squared = error[i] + prefix.squared_error(points, i, j);
            let better = count < edges[j] || (count == edges[j] && squared < error[j]);
            if better && within(points, i, j, i..=j, tolerance_mm) {
                (edges[j], error[j], before[j]) = (count, squared, i);
            }
        }
    }
    let mut kept = vec![n - 1];
    while kept[kept.len() - 1] != 0 {
        kept.push(before[kept[kept.len() - 1]]);
    }
    kept.reverse();
    kept
}

/// Whether the points `among` those between lie within the tolerance of the chord (as a segment).
fn within(
    points: &[Point3<f64>],
    i: usize,
    j: usize,
    among: RangeInclusive<usize>,
    tolerance_mm: f64,
) -> bool {
    let chord = points[j] - points[i];
    let length = chord.norm_squared().max(1e-300);
    points[among].iter().all(|p| {
        let from = p - points[i];
        let t = (from.dot(&chord) / length).clamp(0.0, 1.0);
        (from - chord * t).norm_squared() <= tolerance_mm * tolerance_mm
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// All subsets of the inner vertices: the oracle.
    fn brute_force(points: &[Point3<f64>], tolerance: f64) -> (usize, f64) {
        let n = points.len();
        let prefix = Prefix::new(points);
        let mut best = (usize::MAX, f64::INFINITY);
        for mask in 0u32..1 << (n - 2) {
            let kept: Vec<usize> =
                (0..n).filter(|&k| k == 0 || k == n - 1 || mask & (1 << (k - 1)) != 0).collect();
            if kept.windows(2).all(|w| within(points, w[0], w[1], w[0]..=w[1], tolerance)) {
                let error: f64 = kept.windows(2).map(|w| prefix.squared_error(points, w[0], w[1])).sum();
                if kept.len() < best.0 || (kept.len() == best.0 && error < best.1) {
                    best = (kept.len(), error);
                }
            }
        }
        best
    }

    proptest! {
        #[test]
        fn is_optimal(ys in prop::collection::vec((-1.0..1.0f64, -1.0..1.0f64), 3..11), tolerance in 0.1..1.5f64) {
            let points: Vec<Point3<f64>> =
                ys.iter().enumerate().map(|(i, (y, z))| Point3::new(i as f64, *y, *z)).collect();
            let kept = simplify(&points, tolerance);
            let prefix = Prefix::new(&points);
            let error: f64 = kept.windows(2).map(|w| prefix.squared_error(&points, w[0], w[1])).sum();
            let (count, least) = brute_force(&points, tolerance);
            prop_assert_eq!(kept.len(), count);
            prop_assert!((error - least).abs() < 1e-9);
        }

        #[test]
        fn squared_error_is_the_sum_over_the_points(ys in prop::collection::vec(-1.0..1.0f64, 4..20)) {
            let points: Vec<Point3<f64>> =
                ys.iter().enumerate().map(|(i, y)| Point3::new(i as f64 + 1e3, *y, 7.0)).collect();
            let last = points.len() - 1;
            let chord = (points[last] - points[0]).normalize();
            let direct: f64 = points[1..last].iter().map(|p| (p - points[0]).cross(&chord).norm_squared()).sum();
            prop_assert!((Prefix::new(&points).squared_error(&points, 0, last) - direct).abs() < 1e-8);
        }
    }
}
