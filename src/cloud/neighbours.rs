//! Neighbour search over a cloud: everything within a radius, and the n nearest.
//!
//! A k-d tree from the `kiddo` crate behind answers that do not depend on its inner order: results are sorted,
//! ties go to the lower index. Built on a cloud sorted by voxel it is 2 to 4 times faster.

use std::num::NonZero;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Point3;

use super::PointCloud;

type Metric = SquaredEuclidean<f64>;

/// The tree sums a branch's distance axis by axis while the leaf sums a point's, so rounding could prune a
/// point exactly at the radius: ask for a hair more, then compare each point's own distance.
const SLACK: f64 = 1.0 + 1e-9;

/// A spatial index over a cloud; answers indices into that cloud.
#[derive(Debug)]
pub struct Neighbours {
    /// None for an empty cloud.
    tree: Option<ImmutableKdTree<f64, 3>>,
    origin: Point3<f64>,
    len: usize,
}

impl Neighbours {
    /// Indexes a cloud (best sorted by voxel first).
    pub fn new(cloud: &PointCloud) -> Neighbours {
        let points: Vec<[f64; 3]> = cloud.offsets.iter().map(|o| o.map(f64::from)).collect();
        // The only other refusal, more points than u32 can number, is refused by the readers.
        let tree =
            if points.is_empty() { None } else { ImmutableKdTree::<f64, 3>::new_from_slice(&points).ok() };
        Neighbours { tree, origin: cloud.origin, len: points.len() }
    }

    /// Indices of all points no farther than `radius_mm` from `p`, ascending, into `out` (cleared first). A
    /// radius or point that is not a number finds nothing.
    pub fn within(&self, p: &Point3<f64>, radius_mm: f64, out: &mut Vec<u32>) {
        out.clear();
        if radius_mm.is_nan() || radius_mm < 0.0 || !finite(p) {
            return;
        }
        let limit = radius_mm * radius_mm;
        self.visit(p, limit, |index, _| out.push(index));
        out.sort_unstable();
    }

    /// The `n` nearest points as (index, distance in millimetres), by distance, then index. Fewer when the cloud has
    /// fewer.
    pub fn nearest(&self, p: &Point3<f64>, n: usize) -> Vec<(u32, f64)> {
        let Some(tree) = self.tree.as_ref().filter(|_| finite(p)) else { return Vec::new() };
        let Some(want) = NonZero::new(n.min(self.len)) else { return Vec::new() };
        let query = (p - self.origin).into();
        let found = tree.query(&query).nearest_n::<Metric>(want).execute();
        // Which of several points at the last distance were answered is the tree's whim: take all of them.
        let Some(last) = found.iter().map(|r| r.distance).reduce(f64::max) else { return Vec::new() };
        let mut all = Vec::with_capacity(want.get() + 1);
        self.visit(p, last, |index, squared| all.push((index, squared)));
        all.sort_unstable_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        all.truncate(want.get());
        all.iter().map(|&(index, squared)| (index, squared.sqrt())).collect()
    }

    /// Calls `each` with index and squared distance of every point within a squared distance.
    fn visit(&self, p: &Point3<f64>, limit: f64, mut each: impl FnMut(u32, f64)) {
        let Some(tree) = &self.tree else { return };
        let query = (p - self.origin).into();
        let wide = limit * SLACK + f64::MIN_POSITIVE;
        tree.query(&query).within::<Metric>(wide).unsorted().visit(|r| {
            if r.distance <= limit {
                each(r.item, r.distance);
            }
        });
    }
}

fn finite(p: &Point3<f64>) -> bool {
    p.iter().all(|v| v.is_finite())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn squared(cloud: &PointCloud, i: usize, p: &Point3<f64>) -> f64 {
        let d = (p - cloud.origin) - cloud.offset(i);
        d.x * d.x + d.y * d.y + d.z * d.z
    }

    fn brute_within(cloud: &PointCloud, p: &Point3<f64>, radius: f64) -> Vec<u32> {
        (0..cloud.len() as u32).filter(|&i| squared(cloud, i as usize, p) <= radius * radius).collect()
    }

    fn brute_nearest(cloud: &PointCloud, p: &Point3<f64>, n: usize) -> Vec<(u32, f64)> {
        // By the squares: two that differ may have the same root.
        let mut all: Vec<_> = (0..cloud.len()).map(|i| (i as u32, squared(cloud, i, p))).collect();
        all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        all.truncate(n);
        all.into_iter().map(|(index, squared)| (index, squared.sqrt())).collect()
    }

    fn agree(cloud: &PointCloud, p: &Point3<f64>, radius: f64, n: usize) {
        let tree = Neighbours::new(cloud);
        let mut out = vec![7];
        tree.within(p, radius, &mut out);
        assert_eq!(out, brute_within(cloud, p, radius), "within {radius} of {p}");
        assert_eq!(tree.nearest(p, n), brute_nearest(cloud, p, n), "{n} nearest of {p}");
    }

    #[test]
    fn an_empty_cloud_has_no_neighbours() {
        agree(&PointCloud::default(), &Point3::origin(), 1e9, 5);
    }

    #[test]
    fn hundreds_of_copies_of_one_point() {
        let mut points = vec![Point3::new(1.0, 2.0, 3.0); 700];
        points.extend((0..50).map(|i| Point3::new(i as f64, 0.0, 0.0)));
        let cloud = PointCloud::from_points(&points);
        for n in [0, 1, 31, 32, 33, 699, 700, 701, 750, 5000] {
            agree(&cloud, &Point3::new(1.0, 2.0, 3.0), 0.0, n);
            agree(&cloud, &Point3::new(0.5, 0.5, 0.5), 3.0, n);
        }
    }

    #[test]
    fn flat_grids_with_ties_at_the_radius() {
        for axis in 0..3 {
            let points: Vec<_> = (0..900)
                .map(|i| {
                    let mut p = [(i % 30) as f64, (i / 30) as f64, 0.0];
                    p.rotate_right(axis);
                    Point3::from(p)
                })
                .collect();
            let cloud = PointCloud::from_points(&points);
            for i in [0, 31, 435, 899] {
                [0.0, 1.0, 2.0, 5.0].iter().for_each(|&r| agree(&cloud, &points[i], r, 12));
            }
        }
    }

    #[test]
    fn squares_that_differ_by_less_than_their_roots_can_tell() {
        let points =
            [[-12.0, 5.0, -2.0], [-13.0, -10.0, 0.0], [3.0, 3.0, -1.0]].map(|p| Point3::from(p) * 0.1);
        agree(&PointCloud::from_points(&points), &points[0], 0.0, 2);
    }

    #[test]
    fn questions_that_are_not_numbers_find_nothing() {
        let cloud = PointCloud::from_points(&[Point3::origin(); 3]);
        let tree = Neighbours::new(&cloud);
        let mut out = vec![1];
        tree.within(&Point3::origin(), f64::NAN, &mut out);
        assert!(out.is_empty());
        tree.within(&Point3::origin(), -1.0, &mut out);
        assert!(out.is_empty());
        tree.within(&Point3::new(f64::NAN, 0.0, 0.0), 1.0, &mut out);
        assert!(out.is_empty());
        tree.within(&Point3::origin(), f64::INFINITY, &mut out);
        assert_eq!(out.len(), 3);
        assert!(tree.nearest(&Point3::new(f64::INFINITY, 0.0, 0.0), 1).is_empty());
    }

    proptest! {
        #[test]
        fn brute_force_agrees(
            // A coarse lattice makes ties and copies common.
            coords in prop::collection::vec((-20i32..20, -20i32..20, -3i32..3), 0..400),
            scale in prop_oneof![Just(1.0), Just(0.1), 0.01..10.0f64],
            at in (-25.0..25.0f64, -25.0..25.0f64, -5.0..5.0f64),
            radius in prop_oneof![Just(0.0), Just(1.0), 0.0..20.0f64],
            n in 0usize..40,
        ) {
            let points: Vec<_> =
                coords.iter().map(|&(x, y, z)| Point3::new(x as f64, y as f64, z as f64) * scale).collect();
            let cloud = PointCloud::from_points(&points);
            agree(&cloud, &(Point3::new(at.0, at.1, at.2) * scale), radius * scale, n);
            if let Some(p) = points.first() {
                agree(&cloud, p, radius * scale, n);
            }
        }
    }
}
