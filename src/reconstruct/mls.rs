//! Points of the cloud projected onto the tube's spine: moving least squares with cylinders (paper 000,
//! section 3), with that paper's outlier rules (section 7).

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::cylinder::{Cylinder, REACH_RADII, fit_cylinder};
use super::radius::{JET_RADII, median};
use crate::cloud::{Neighbours, PointCloud};
use crate::recognize::{Jet, fit_jet};

/// Cell of the cloud in which neighbourhoods are looked up, in tube radii.
const WORK_CELL_RADII: f64 = 0.12;

/// Cell of the points that are projected, in tube radii.
const SEED_CELL_RADII: f64 = 0.28;

/// Curvature may differ from the tube's by this share (paper 000, section 7), or by what noise explains.
const CURVATURE_SHARE: f64 = 0.1;

/// Distance of a point from its spine point may differ from the radius by this share (same section).
const RADIUS_SHARE: f64 = 0.1;

/// A strip of surface narrower than about 50 degrees (see [`Cylinder::opening`]) tells no axis. On the inside of a
/// tight bend both curvatures are about equal and the normal may point either way; this rule finds the wrong ones.
const LEAST_OPENING: f64 = 0.06;

/// Spine points with less than this share of the usual number of neighbours are strays.
const LEAST_DENSITY: f64 = 0.2;

/// One point near the spine with the direction of the tube there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpinePoint {
    /// Position.
    pub point: Point3<f64>,
    /// Unit tangent, of either sign.
    pub tangent: Vector3<f64>,
}

/// Projects a thinned set of the cloud's points onto the spine.
pub fn spine_cloud(cloud: &PointCloud, radius_mm: f64) -> Vec<SpinePoint> {
    let work = cloud.thinned(WORK_CELL_RADII * radius_mm);
    let neighbours = Neighbours::new(&work);
    let seeds = work.thinned(SEED_CELL_RADII * radius_mm);
    let jets: Vec<Option<Jet>> = (0..seeds.len())
        .into_par_iter()
        .map(|i| {
            let near = near(&work, &neighbours, &seeds.point(i), JET_RADII * radius_mm);
            fit_jet(&seeds.point(i), &near, JET_RADII * radius_mm)
        })
        .collect();
    let mut errors: Vec<f64> =
        jets.iter().flatten().map(|j| (j.strong_per_mm * radius_mm - 1.0).abs()).collect();
    let usual = median(&mut errors).unwrap_or(0.0);
    let allowed = CURVATURE_SHARE.max(4.0 * usual);
    (0..seeds.len())
        .into_par_iter()
        .filter_map(|i| {
            let jet = jets[i].as_ref()?;
            if (jet.strong_per_mm * radius_mm - 1.0).abs() > allowed {
                return None;
            }
            project(&seeds.point(i), jet, radius_mm, |p, reach| near(&work, &neighbours, p, reach))
        })
        .collect()
}

fn near(work: &PointCloud, neighbours: &Neighbours, p: &Point3<f64>, reach_mm: f64) -> Vec<Point3<f64>> {
    let mut found = Vec::new();
    neighbours.within(p, reach_mm, &mut found);
    found.iter().map(|&i| work.point(i as usize)).collect()
}

/// One projection: starting values from the jet (paper 000, sections 3.3 and 3.4), cylinder, outlier rule.
fn project(
    p: &Point3<f64>,
    jet: &Jet,
    radius_mm: f64,
    near: impl Fn(&Point3<f64>, f64) -> Vec<Point3<f64>>,
) -> Option<SpinePoint> {
    let start = Cylinder::guess(jet.foot - jet.normal * radius_mm, jet.weak_direction, radius_mm);
    let points = near(&start.centre, REACH_RADII * radius_mm);
    let cylinder = fit_cylinder(&points, &start, false)?;
    let distance = (p - cylinder.centre).norm();
    let fits = (distance - radius_mm).abs() < RADIUS_SHARE * radius_mm && cylinder.opening > LEAST_OPENING;
    fits.then_some(SpinePoint { point: cylinder.centre, tangent: cylinder.axis })
}

/// Thins the spine cloud to points about `spacing_mm` apart, each moved sideways onto the mean of its
/// neighbourhood; strays vanish.
pub fn condense(spine: &[SpinePoint], spacing_mm: f64) -> Vec<SpinePoint> {
    if spine.is_empty() {
        return Vec::new();
    }
    let points: Vec<Point3<f64>> = spine.iter().map(|s| s.point).collect();
    let neighbours = Neighbours::new(&PointCloud::from_points(&points));
    let near = |i: usize| {
        let mut found = Vec::new();
        neighbours.within(&points[i], spacing_mm, &mut found);
        found
    };
    let mut counts: Vec<f64> = (0..spine.len()).step_by(7).map(|i| near(i).len() as f64).collect();
    let least = median(&mut counts).map_or(3.0, |usual| (LEAST_DENSITY * usual).max(3.0)) as usize;
    let mut taken = vec![false; spine.len()];
    let mut out = Vec::new();
    for i in 0..spine.len() {
        if taken[i] {
            continue;
        }
        let found = near(i);
        found.iter().for_each(|&k| taken[k as usize] = true);
        let along: Vec<&SpinePoint> = found
            .iter()
            .map(|&k| &spine[k as usize])
            .filter(|s| s.tangent.dot(&spine[i].tangent).abs() > 0.8)
            .collect();
        if along.len() < least {
            continue;
        }
        let n = along.len() as f64;
        let mean: Vector3<f64> = along.iter().map(|s| s.point.coords).sum::<Vector3<f64>>() / n;
        let turn = |s: &SpinePoint| s.tangent * s.tangent.dot(&spine[i].tangent).signum();
        let tangent = along.iter().map(|s| turn(s)).sum::<Vector3<f64>>().normalize();
        let forward = (points[i].coords - mean).dot(&tangent);
        out.push(SpinePoint { point: Point3::from(mean + tangent * forward), tangent });
    }
    out
}
