//! Voxels: ordering a cloud so that neighbours in space are neighbours in memory, and thinning it.
//!
//! The order is Morton's (z-order) over a grid anchored at the cloud's own corner: searches on a cloud in
//! this order are 2 to 4 times faster than on one in scan order. Points are not sorted: occupied voxels are numbered
//! in a small table, task by task, and only the voxels are sorted.

use rayon::prelude::*;

use super::PointCloud;
use super::cells::{Cells, Numbers, numbers};
use super::raw::TASK;

impl PointCloud {
    /// The same points sorted by voxel of the given edge, within a voxel by their index. A cell too small
    /// for the grid (or not above 0) is enlarged to the finest that the grid can hold.
    pub fn voxel_sorted(&self, cell_mm: f64) -> PointCloud {
        let Some(voxels) = Voxels::of(self, cell_mm) else { return self.clone() };
        // Where each voxel's next point goes, by the voxels' numbers.
        let mut next = vec![0; voxels.totals.len()];
        let mut end = 0;
        for &voxel in &voxels.order {
            next[voxel as usize] = end;
            end += voxels.totals[voxel as usize].count as u32;
        }
        let mut order = vec![0; self.len()];
        let all = voxels.tasks.iter().flat_map(|task| task.ids.iter().map(|&id| task.global[id as usize]));
        for (i, voxel) in (0..).zip(all) {
            let at = &mut next[voxel as usize];
            order[*at as usize] = i;
            *at += 1;
        }
        self.pick(&order)
    }

    /// One point per occupied voxel, the one nearest to the mean of the voxel's points, in voxel order. No
    /// point is moved, so noise is not averaged away.
    pub fn thinned(&self, cell_mm: f64) -> PointCloud {
        self.thinned_of(cell_mm, |_| 1.0)
    }

    /// The same without the voxels of a single point where they hold several as a rule: a flying point has a voxel of its own,
    /// and few of them among many points would be many among those that thinning leaves.
    pub fn thinned_without_strays(&self, cell_mm: f64) -> PointCloud {
        self.thinned_of(cell_mm, |usual| if usual >= SEVERAL { 2.0 } else { 1.0 })
    }

    /// One point of each voxel that holds enough of them, told how many they hold on average.
    fn thinned_of(&self, cell_mm: f64, enough: impl Fn(f64) -> f64) -> PointCloud {
        let Some(voxels) = Voxels::of(self, cell_mm) else { return self.clone() };
        let enough = enough(self.len() as f64 / voxels.order.len() as f64);
        let central = voxels.central(self);
        let holds = |voxel: &&u32| voxels.totals[**voxel as usize].count >= enough;
        let kept: Vec<u32> = voxels.order.iter().filter(holds).map(|&v| central[v as usize]).collect();
        self.pick(&kept)
    }
}

/// So many points on average are several: of a surface scanned as densely hardly a voxel holds one alone.
const SEVERAL: f64 = 5.0;

/// A cloud's occupied voxels.
struct Voxels {
    tasks: Vec<Task>,
    /// By number.
    totals: Vec<Total>,
    /// The numbers in Morton's order.
    order: Vec<u32>,
}

/// What consecutive points know of their voxels.
struct Task {
    /// The task's own number of each point's voxel.
    ids: Vec<u32>,
    own: Numbers,
    totals: Vec<Total>,
    /// The cloud's number for each of the task's own.
    global: Vec<u32>,
}

/// Number and sum of a voxel's points.
#[derive(Clone, Copy, Default)]
struct Total {
    sum: [f64; 3],
    count: f64,
}

impl Total {
    fn add(&mut self, other: &Total) {
        self.sum.iter_mut().zip(other.sum).for_each(|(a, b)| *a += b);
        self.count += other.count;
    }

    fn mean(&self) -> [f64; 3] {
        self.sum.map(|v| v / self.count)
    }
}

impl Voxels {
    /// None for an empty cloud.
    fn of(cloud: &PointCloud, cell_mm: f64) -> Option<Voxels> {
        let cells = Cells::of(cloud, cell_mm)?;
        // Fixed tasks, put together in order: the same sums whatever the number of threads.
        let mut tasks: Vec<Task> =
            in_tasks(cloud.offsets()).map(|(_, points)| Task::of(&cells, points)).collect();
        let (keys, totals) = numbered(&mut tasks);
        let mut order: Vec<(u64, u32)> = keys.iter().map(|&key| morton(key)).zip(0..).collect();
        if order.len() > TASK {
            order.par_sort_unstable_by_key(|cell| cell.0)
        } else {
            order.sort_unstable_by_key(|cell| cell.0)
        }
        Some(Voxels { tasks, totals, order: order.into_iter().map(|(_, number)| number).collect() })
    }

    /// By voxel's number, the index of the point nearest to the mean; the lowest where several are.
    fn central(&self, cloud: &PointCloud) -> Vec<u32> {
        let tasks = in_tasks(cloud.offsets());
        let parts: Vec<Vec<(f64, u32)>> = tasks.map(|(k, points)| self.nearest(k, points)).collect();
        let mut best = vec![(f64::INFINITY, 0); self.totals.len()];
        for (task, part) in self.tasks.iter().zip(parts) {
            for (&voxel, candidate) in task.global.iter().zip(part) {
                let best = &mut best[voxel as usize];
                if candidate.0 < best.0 {
                    *best = candidate;
                }
            }
        }
        best.into_iter().map(|(_, index)| index).collect()
    }

    /// The same among one task's points, by the task's own numbers.
    fn nearest(&self, k: usize, points: &[[f32; 3]]) -> Vec<(f64, u32)> {
        let task = &self.tasks[k];
        let means: Vec<[f64; 3]> = task.global.iter().map(|&v| self.totals[v as usize].mean()).collect();
        let mut best = vec![(f64::INFINITY, 0); means.len()];
        for ((p, &id), index) in points.iter().zip(&task.ids).zip((k * TASK) as u32..) {
            let mean = &means[id as usize];
            let [x, y, z] = [0, 1, 2].map(|i| f64::from(p[i]) - mean[i]);
            let distance = x * x + y * y + z * z;
            let best = &mut best[id as usize];
            if distance < best.0 {
                *best = (distance, index);
            }
        }
        best
    }
}

/// Keys and totals of all tasks' voxels by the cloud's numbers, which the tasks learn.
fn numbered(tasks: &mut [Task]) -> (Vec<u64>, Vec<Total>) {
    if let [only] = tasks {
        only.global = (0..only.own.keys.len() as u32).collect();
        return (only.own.keys.clone(), only.totals.clone());
    }
    let (mut all, mut totals) = (Numbers::new(), Vec::new());
    for task in tasks {
        for (&key, total) in task.own.keys.iter().zip(&task.totals) {
            let number = all.number(key);
            if number as usize == totals.len() {
                totals.push(Total::default());
            }
            totals[number as usize].add(total);
            task.global.push(number);
        }
    }
    (all.keys, totals)
}

impl Task {
    fn of(cells: &Cells, points: &[[f32; 3]]) -> Task {
        let (mut own, mut totals) = (Numbers::new(), Vec::new());
        let mut ids = Vec::with_capacity(points.len());
        // Points follow a scan line: the voxel is often the last one.
        let mut last = (u64::MAX, 0);
        for &p in points {
            let key = cells.key(p);
            if key != last.0 {
                last = (key, own.number(key));
                if last.1 as usize == totals.len() {
                    totals.push(Total::default());
                }
            }
            ids.push(last.1);
            totals[last.1 as usize].add(&Total { sum: p.map(f64::from), count: 1.0 });
        }
        Task { ids, own, totals, global: Vec::new() }
    }
}

/// A cloud's points in tasks of a fixed size, with the tasks' numbers.
fn in_tasks(points: &[[f32; 3]]) -> impl IndexedParallelIterator<Item = (usize, &[[f32; 3]])> {
    points.par_chunks(TASK).enumerate()
}

/// Interleaves the bits of a cell's three numbers.
fn morton(key: u64) -> u64 {
    let [x, y, z] = numbers(key);
    spread(x) | spread(y) << 1 | spread(z) << 2
}

/// Puts two empty bits between any two of the lowest 21.
fn spread(v: u64) -> u64 {
    let v = v & 0x1f_ffff;
    let v = (v | v << 32) & 0x1f_0000_0000_ffff;
    let v = (v | v << 16) & 0x1f_0000_ff00_00ff;
    let v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    let v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::*;

    fn key(cloud: &PointCloud, i: usize) -> [u64; 3] {
        cloud.point(i).coords.map(f64::to_bits).into()
    }

    fn cell_of(p: &Point3<f64>, corner: &Point3<f64>, cell: f64) -> [i64; 3] {
        ((p - corner) / cell).map(|v| v as i64).into()
    }

    #[test]
    fn the_order_follows_the_bits_of_the_cells() {
        // Eight cells of a cube in Morton's order: x fastest, then y, then z.
        let corner = |i: usize| Point3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) * 10.0;
        let cloud = PointCloud::from_points(&(0..8).rev().map(corner).collect::<Vec<_>>());
        let sorted = cloud.voxel_sorted(10.0);
        (0..8).for_each(|i| assert_eq!(sorted.point(i), corner(i)));
    }

    #[test]
    fn degenerate_clouds_and_cells() {
        let one = PointCloud::from_points(&vec![Point3::new(1.0, 2.0, 3.0); 500]);
        assert_eq!(one.thinned(0.1).len(), 1);
        assert_eq!(one.voxel_sorted(0.0).len(), 500);
        assert_eq!(one.thinned(f64::NAN).len(), 1);
        assert!(PointCloud::default().thinned(1.0).is_empty());
        // A cell far below what 21 bits can number: nothing may be folded over.
        let far = PointCloud::from_points(&[Point3::origin(), Point3::new(3000.0, 1.0, 0.0)]);
        assert_eq!(far.thinned(1e-9).len(), 2);
    }

    proptest! {
        #[test]
        fn sorting_is_a_permutation_and_thinning_keeps_one_point_per_cell(
            coords in prop::collection::vec((-50.0..50.0, -50.0..50.0, -5.0..5.0f64), 1..300),
            cell in 0.5..20.0f64,
        ) {
            let points: Vec<_> = coords.iter().map(|&(x, y, z)| Point3::new(x, y, z)).collect();
            let cloud = PointCloud::from_points(&points);
            let (corner, _) = cloud.bounds().unwrap();
            let sorted = cloud.voxel_sorted(cell);
            let keys = |c: &PointCloud| { let mut k: Vec<_> = (0..c.len()).map(|i| key(c, i)).collect(); k.sort(); k };
            prop_assert_eq!(keys(&cloud), keys(&sorted));
            // Each cell's points stand together.
            let cells: Vec<_> = sorted.iter().map(|p| cell_of(&p, &corner, cell)).collect();
            let runs = cells.chunk_by(|a, b| a == b).count();
            let distinct: BTreeSet<_> = cells.into_iter().collect();
            prop_assert_eq!(runs, distinct.len());
            let thin = cloud.thinned(cell);
            prop_assert_eq!(thin.len(), distinct.len());
            // Thinning picks, it does not invent.
            let all: BTreeSet<_> = keys(&cloud).into_iter().collect();
            prop_assert!((0..thin.len()).all(|i| all.contains(&key(&thin, i))));
        }
    }
}
