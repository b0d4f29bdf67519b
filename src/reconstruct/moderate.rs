//! A moderate cloud from one of any size: all that is done before the final fit is done on it.
//!
//! Of many millions of points a pseudo-random share is enough to fill the cells of the thinning; its cell is derived
//! from the scanned area beforehand, so that a cloud is thinned once.

use nalgebra::Point3;
use rayon::prelude::*;

use crate::cloud::{Grid, PointCloud};
use crate::recognize::median;

/// A thinned cloud and the usual distance of its points.
#[derive(Debug, Clone)]
pub struct Moderate {
    /// The points.
    pub cloud: PointCloud,
    /// About the distance from a point to its next.
    pub spacing_mm: f64,
}

/// Points of the whole scene.
const ENOUGH_POINTS: usize = 30_000;

/// Points that are sorted into cells to get there.
const MOST_SORTED: usize = 200_000;

/// Points that tell the area, and cells that they are to fill.
const PROBE_POINTS: usize = 8_000;
const PROBE_CELLS: usize = 1_000;

/// Places that tell the spacing, and the neighbours looked at there.
const PLACES: usize = 64;
const NEIGHBOURS: usize = 12;

/// At most some tens of thousands of a cloud's points, evenly spread.
pub fn moderate(cloud: &PointCloud) -> Moderate {
    if cloud.len() <= ENOUGH_POINTS {
        return Moderate { cloud: cloud.clone(), spacing_mm: spacing_mm(cloud) };
    }
    let share = any_share(cloud, MOST_SORTED);
    let mut spacing_mm = (area_mm2(&any_share(&share, PROBE_POINTS)) / ENOUGH_POINTS as f64).sqrt();
    let mut out = share.thinned_without_strays(spacing_mm);
    // On a tube thinner than the probe's cells the area comes out too large.
    while out.len() < ENOUGH_POINTS / 2 && out.len() < share.len() / 2 {
        spacing_mm *= (out.len() as f64 / ENOUGH_POINTS as f64).sqrt();
        out = share.thinned_without_strays(spacing_mm);
    }
    Moderate { cloud: out, spacing_mm }
}

/// At most `most` of a cloud's points, one drawn from each of as many equal runs: in a file's order a fixed
/// stride could fall into step with the scanner's stripes.
pub fn any_share(cloud: &PointCloud, most: usize) -> PointCloud {
    if cloud.len() <= most {
        return cloud.clone();
    }
    cloud.select(&drawn(cloud.len(), most))
}

/// Indices of at most `most` of so many points, one drawn from each of as many equal runs.
pub fn drawn(points: usize, most: usize) -> Vec<usize> {
    let run = points.div_ceil(most.max(1)).max(1);
    let draw = |k: usize| k * run + (scrambled(k as u64) % run as u64) as usize;
    (0..points / run).map(draw).collect()
}

/// The finaliser of SplitMix64 (G. L. Steele et al., OOPSLA 2014).
fn scrambled(k: u64) -> u64 {
    let mut z = k.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// About the area of the surface on which the points lie: a cell's face for each cell that it cuts, which is half as
/// much again as it is, and half as much again are the cells that the thinning will find.
fn area_mm2(probe: &PointCloud) -> f64 {
    let diagonal = probe.bounds().map_or(0.0, |(low, high)| (high - low).norm());
    let mut cell = diagonal / 200.0;
    let mut cells = probe.thinned(cell);
    while cells.len() > PROBE_CELLS && cell < diagonal {
        cell *= 1.5;
        cells = cells.thinned(cell);
    }
    cells.len() as f64 * cell * cell
}

/// Usual distance of neighbouring points: as if those around a place filled a disc evenly.
fn spacing_mm(cloud: &PointCloud) -> f64 {
    let diagonal = cloud.bounds().map_or(0.0, |(low, high)| (high - low).norm());
    // Some tens of points on a surface.
    let usual_mm = diagonal / (cloud.len().max(1) as f64).sqrt();
    let index = Grid::new(cloud, usual_mm);
    let stride = cloud.len().div_ceil(PLACES).max(1);
    let places = (0..cloud.len()).into_par_iter().step_by(stride);
    let mut reaches: Vec<f64> =
        places.map(|i| reach_mm(&index, &cloud.point(i), usual_mm, diagonal)).collect();
    median(&mut reaches).unwrap_or(0.0) * (std::f64::consts::PI / NEIGHBOURS as f64).sqrt()
}

/// How far the last of the nearest few points is, the place itself among them; of all points if there are fewer.
fn reach_mm(index: &Grid, place: &Point3<f64>, usual_mm: f64, most_mm: f64) -> f64 {
    let mut squares = Vec::new();
    let mut radius_mm = usual_mm;
    loop {
        squares.clear();
        index.for_each_within(place, radius_mm, |_, way| squares.push(way.norm_squared()));
        if squares.len() >= NEIGHBOURS || radius_mm >= most_mm {
            break;
        }
        radius_mm *= 2.0;
    }
    squares.sort_unstable_by(f64::total_cmp);
    squares.get(NEIGHBOURS - 1).or(squares.last()).map_or(0.0, |square| square.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sheet(n: usize, step: f64) -> PointCloud {
        let at = |i: usize| Point3::new((i % n) as f64 * step, (i / n) as f64 * step, 0.0);
        PointCloud::from_points(&(0..n * n).map(at).collect::<Vec<_>>())
    }

    #[test]
    fn the_spacing_of_a_lattice_is_its_step() {
        let found = moderate(&sheet(100, 0.5));
        assert_eq!(found.cloud.len(), 10_000);
        assert!((found.spacing_mm / 0.5 - 1.0).abs() < 0.15, "{}", found.spacing_mm);
    }

    #[test]
    fn a_large_cloud_becomes_a_moderate_one() {
        let found = moderate(&sheet(1000, 0.1));
        assert!((10_000..60_000).contains(&found.cloud.len()), "{}", found.cloud.len());
        assert!((0.3..1.0).contains(&found.spacing_mm), "{}", found.spacing_mm);
    }

    #[test]
    fn a_share_is_drawn_from_all_over() {
        let share = any_share(&sheet(300, 1.0), 1000);
        assert!((900..=1000).contains(&share.len()));
        let (low, high) = share.bounds().unwrap();
        assert!(low.x < 15.0 && high.x > 285.0 && low.y < 15.0 && high.y > 285.0);
    }
}
