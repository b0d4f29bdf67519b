//! Radius search on a grid: for thinned clouds, where it is built faster than a tree and asked without allocating.

use nalgebra::{Point3, Vector3};

use super::PointCloud;
use super::cells::{Cells, Numbers, key};

/// Points looked at together.
const CHUNK: usize = 32;

/// A cloud's points sorted into cubes; answers indices into that cloud.
///
/// Fastest when the cells' edge is about the radius that will be asked for; any other works too.
#[derive(Debug, Clone)]
pub struct Grid {
    origin: Point3<f64>,
    /// None for an empty cloud.
    cells: Option<Cells>,
    /// Highest cell along each axis.
    last: [u32; 3],
    occupied: Numbers,
    /// Where each occupied cell's points begin, and the end of all.
    starts: Vec<u32>,
    /// Offsets and indices of the points, cell by cell, within a cell by their index.
    points: Vec<([f32; 3], u32)>,
}

impl Grid {
    /// Sorts a cloud into cells of the given edge (enlarged as in [`PointCloud::thinned`]).
    pub fn new(cloud: &PointCloud, cell_mm: f64) -> Grid {
        let mut grid = Grid {
            origin: cloud.origin(),
            cells: Cells::of(cloud, cell_mm),
            last: [0; 3],
            occupied: Numbers::new(),
            starts: vec![0],
            points: vec![([0.0; 3], 0); cloud.len()],
        };
        let Some((cells, (_, max))) = grid.cells.zip(cloud.offset_bounds()) else { return grid };
        grid.last = cells.at(max.cast().into());
        let ids: Vec<u32> = cloud.offsets().iter().map(|&o| grid.occupied.number(cells.key(o))).collect();
        let mut counts = vec![0; grid.occupied.keys.len()];
        ids.iter().for_each(|&id| counts[id as usize] += 1);
        grid.starts.extend(counts.iter().scan(0, |end, n| {
            *end += n;
            Some(*end)
        }));
        let mut next = grid.starts.clone();
        for ((&offset, &id), index) in cloud.offsets().iter().zip(&ids).zip(0..) {
            grid.points[next[id as usize] as usize] = (offset, index);
            next[id as usize] += 1;
        }
        grid
    }

    /// Calls `each` with the index of every point no farther than `radius_mm` from `p` and the way to it from `p`
    /// in millimetres. The order depends on cloud, cell, point and radius alone. A radius or point that is not a
    /// number finds nothing.
    pub fn for_each_within(&self, p: &Point3<f64>, radius_mm: f64, mut each: impl FnMut(u32, Vector3<f64>)) {
        let Some(cells) = self.cells.filter(|_| radius_mm >= 0.0 && p.iter().all(|v| v.is_finite())) else {
            return;
        };
        let at = p - self.origin;
        let limit = radius_mm * radius_mm;
        let mut visit = |cell: u32| {
            let cell = cell as usize;
            let points = &self.points[self.starts[cell] as usize..self.starts[cell + 1] as usize];
            points.chunks(CHUNK).for_each(|chunk| among(chunk, &at, limit, &mut each));
        };
        // A hair more, so that rounding cannot leave out the cell of a point just at the radius.
        let reach = radius_mm * (1.0 + 1e-9) + 1e-6 * cells.edge_mm() + 1e-15 * at.amax();
        let low = cells.at(at.add_scalar(-reach).into());
        let high = cells.at(at.add_scalar(reach).into());
        let [xs, ys, zs] = [0, 1, 2].map(|i| low[i]..high[i].min(self.last[i]) + 1);
        let size = |r: &std::ops::Range<u32>| u64::from(r.end.saturating_sub(r.start));
        let count = size(&xs) * size(&ys) * size(&zs);
        // Beside the cloud; not left to the loops, two of which may be long.
        if count == 0 {
            return;
        }
        if count > self.occupied.keys.len() as u64 {
            (0..self.occupied.keys.len() as u32).for_each(visit);
            return;
        }
        for z in zs {
            for y in ys.clone() {
                for x in xs.clone() {
                    if let Some(cell) = self.occupied.find(key([x, y, z])) {
                        visit(cell);
                    }
                }
            }
        }
    }
}

/// Collects first and calls after: whether a point is near is a guess that a processor gets wrong too often.
fn among(chunk: &[([f32; 3], u32)], at: &Vector3<f64>, limit: f64, each: &mut impl FnMut(u32, Vector3<f64>)) {
    let way = |offset: &[f32; 3]| Vector3::from(*offset).cast::<f64>() - at;
    let (mut near, mut count) = ([0u8; CHUNK], 0);
    for (i, (offset, _)) in (0..).zip(chunk) {
        let way = way(offset);
        near[count] = i;
        count += usize::from(way.x * way.x + way.y * way.y + way.z * way.z <= limit);
    }
    for &i in &near[..count] {
        let (offset, index) = &chunk[usize::from(i)];
        each(*index, way(offset));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn agree(cloud: &PointCloud, cell: f64, p: &Point3<f64>, radius: f64) {
        let mut found = Vec::new();
        Grid::new(cloud, cell).for_each_within(p, radius, |i, way| {
            assert!((p + way - cloud.point(i as usize)).norm() < 1e-9);
            found.push(i);
        });
        found.sort_unstable();
        let near = |i: &u32| {
            let d = cloud.offset(*i as usize) - (p - cloud.origin());
            d.x * d.x + d.y * d.y + d.z * d.z <= radius * radius
        };
        let expected: Vec<u32> = (0..cloud.len() as u32).filter(near).collect();
        assert_eq!(found, expected, "within {radius} of {p}, cells of {cell}");
    }

    #[test]
    fn nothing_to_find_and_questions_that_are_none() {
        agree(&PointCloud::default(), 1.0, &Point3::origin(), 1e9);
        let cloud = PointCloud::from_points(&[Point3::origin(); 3]);
        let count = |p: f64, radius: f64| {
            let mut n = 0;
            Grid::new(&cloud, 1.0).for_each_within(&Point3::new(p, 0.0, 0.0), radius, |_, _| n += 1);
            n
        };
        assert_eq!([count(0.0, f64::NAN), count(0.0, -1.0), count(f64::NAN, 1.0)], [0; 3]);
        assert_eq!([count(0.0, 0.0), count(0.0, f64::INFINITY), count(1e30, 1.0)], [3, 3, 0]);
    }

    proptest! {
        #[test]
        fn brute_force_agrees(
            // A coarse lattice makes ties, copies and points on the cells' faces common.
            coords in prop::collection::vec((-20i32..20, -20i32..20, -3i32..3), 0..300),
            scale in prop_oneof![Just(1.0), Just(0.1), 0.01..10.0f64],
            cell in prop_oneof![Just(1.0), Just(5.0), Just(0.0), 0.1..50.0f64],
            at in (-40.0..40.0f64, -25.0..25.0f64, -5.0..5.0f64),
            radius in prop_oneof![Just(0.0), Just(1.0), 0.0..20.0f64],
        ) {
            let points: Vec<_> =
                coords.iter().map(|&(x, y, z)| Point3::new(x as f64, y as f64, z as f64) * scale).collect();
            let cloud = PointCloud::from_points(&points);
            agree(&cloud, cell * scale, &(Point3::new(at.0, at.1, at.2) * scale), radius * scale);
            if let Some(p) = points.first() {
                agree(&cloud, cell * scale, p, radius * scale);
            }
        }
    }
}
