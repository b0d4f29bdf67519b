//! The tube's radius before anything else is known: median curvature radius of jets (paper 000, section 3.1),
//! with the neighbourhood found by itself, then median of local cylinder fits.

use nalgebra::Point3;
use rayon::prelude::*;

use super::cylinder::{Cylinder, REACH_RADII, fit_cylinder};
use crate::cloud::{Neighbours, PointCloud};
use crate::recognize::{Jet, fit_jet};

/// Neighbourhood of a jet in tube radii (paper 000, section 7).
pub const JET_RADII: f64 = 2.0 / 3.0;

/// Places that are looked at.
const PLACES: usize = 400;

/// Points that are enough to find the radius by.
const ENOUGH_POINTS: usize = 60_000;

/// Ratio of neighbouring scales.
const SCALE_STEP: f64 = 0.75;

/// What one scale says of the radius.
#[derive(Debug, Clone, Copy)]
struct Reading {
    radius_mm: f64,
    /// Median absolute deviation of the curvature over its median.
    spread: f64,
}

/// The radius as far as jets and local cylinders tell; None when nothing in the cloud is curved like a tube.
pub fn estimate(cloud: &PointCloud) -> Option<f64> {
    let (low, high) = cloud.bounds()?;
    let diagonal = (high - low).norm();
    let mut coarse = thin_to(cloud, ENOUGH_POINTS, diagonal);
    let mut best: Option<Reading> = None;
    let mut readings = Vec::new();
    // From fine to coarse, each scale on the thinned cloud of the one before.
    let mut scale = diagonal / 1500.0;
    while scale < diagonal / 3.0 {
        coarse = coarse.thinned(scale / 6.0);
        if let Some(reading) = read_at(&coarse, scale) {
            readings.push((scale, reading));
        }
        scale /= SCALE_STEP;
    }
    for (scale, reading) in readings {
        // The neighbourhood must suit the radius that it finds; of those that do the sharpest counts.
        let suits = (0.45..1.0).contains(&(scale / reading.radius_mm));
        if suits && best.is_none_or(|b| reading.spread < b.spread) {
            best = Some(reading);
        }
    }
    let jets = best.filter(|b| b.spread < 0.35)?.radius_mm;
    Some(refine(cloud, jets).unwrap_or(jets))
}

fn thin_to(cloud: &PointCloud, enough: usize, diagonal: f64) -> PointCloud {
    let mut cell = diagonal / 2000.0;
    let mut out = cloud.clone();
    while out.len() > enough {
        out = out.thinned(cell);
        cell *= 1.5;
    }
    out
}

fn places(cloud: &PointCloud) -> Vec<Point3<f64>> {
    let stride = cloud.len().div_ceil(PLACES).max(1);
    (0..cloud.len()).step_by(stride).map(|i| cloud.point(i)).collect()
}

/// Jets at a number of places of the cloud.
fn jets_at(cloud: &PointCloud, neighbours: &Neighbours, scale: f64) -> Vec<Jet> {
    places(cloud)
        .par_iter()
        .filter_map(|p| {
            let mut found = Vec::new();
            neighbours.within(p, scale, &mut found);
            let near: Vec<Point3<f64>> = found.iter().map(|&i| cloud.point(i as usize)).collect();
            fit_jet(p, &near, scale)
        })
        .collect()
}

fn read_at(cloud: &PointCloud, scale: f64) -> Option<Reading> {
    let jets = jets_at(cloud, &Neighbours::new(cloud), scale);
    if jets.len() < places(cloud).len().min(PLACES) / 4 || jets.len() < 20 {
        return None;
    }
    let mut curvatures: Vec<f64> = jets.iter().map(|j| j.strong_per_mm).collect();
    let middle = median(&mut curvatures)?;
    let mut deviations: Vec<f64> = curvatures.iter().map(|c| (c - middle).abs()).collect();
    let spread = median(&mut deviations)? / middle;
    Some(Reading { radius_mm: 1.0 / middle, spread })
}

/// Median of cylinders of free radius, preferring places where the tube is straight.
fn refine(cloud: &PointCloud, radius_mm: f64) -> Option<f64> {
    let work = cloud.thinned(0.1 * radius_mm);
    let neighbours = Neighbours::new(&work);
    let jets = jets_at(&work, &neighbours, JET_RADII * radius_mm);
    let fitted: Vec<(f64, bool)> = jets
        .par_iter()
        .filter_map(|jet| {
            let start = Cylinder::guess(jet.foot - jet.normal * radius_mm, jet.weak_direction, radius_mm);
            let mut found = Vec::new();
            neighbours.within(&start.centre, REACH_RADII * radius_mm, &mut found);
            let near: Vec<Point3<f64>> = found.iter().map(|&i| work.point(i as usize)).collect();
            let cylinder = fit_cylinder(&near, &start, true)?;
            let straight = (jet.weak_per_mm * radius_mm).abs() < 0.08;
            Some((cylinder.radius_mm, straight))
        })
        .collect();
    let mut straight: Vec<f64> = fitted.iter().filter(|(_, s)| *s).map(|(r, _)| *r).collect();
    let mut all: Vec<f64> = fitted.iter().map(|(r, _)| *r).collect();
    if straight.len() >= 30 { median(&mut straight) } else { median(&mut all) }
}

/// Median; None without values.
pub fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    let (_, m, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    Some(*m)
}
