//! Points of the cloud projected onto the tube's spine: moving least squares with cylinders (paper 000,
//! section 3), with that paper's outlier rules (section 7).

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::cylinder::{Cylinder, REACH_RADII, fit_cylinder};
use super::follow::followed;
use super::radius::{JET_RADII, Near};
use crate::cloud::{Grid, Neighbours, PointCloud};
use crate::recognize::{Jet, fit_jet, median};

/// Distance of the spine's points, in tube radii.
pub const SPINE_SPACING_RADII: f64 = 0.3;

/// Cell of the cloud in which neighbourhoods are looked up, in tube radii.
pub const WORK_CELL_RADII: f64 = 0.15;

/// Cell of the points whose jets guess the spine, in tube radii.
const SEED_CELL_RADII: f64 = 0.5;

/// Distance of the places at which cylinders are fitted, in tube radii.
const GUESS_SPACING_RADII: f64 = 0.2;

/// Curvatures that differ more are something else's and say nothing of the noise.
const MOST_ERROR: f64 = 0.5;

/// Spine points this near to each other must be on one spine: no farther aside of the other's tangent than errors and
/// a bend of two radii explain (its sagitta is along^2 / 4).
const APART_RADII: f64 = 1.4;
const ASIDE_RADII: f64 = 0.15;
const TIGHTEST_RADII: f64 = 0.25;

/// Share of the points around a cylinder that must lie on it.
const LEAST_SHARE: f64 = 0.5;

/// Curvature may differ from the tube's by this share (paper 000, section 7), or by what noise explains.
const CURVATURE_SHARE: f64 = 0.1;

/// A strip of surface narrower than about 50 degrees (see [`Cylinder::opening`]) tells no axis. On the inside of a
/// tight bend both curvatures are about equal and the normal may point either way; this rule finds the wrong ones.
const LEAST_OPENING: f64 = 0.06;

/// One point near the spine with the direction of the tube there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpinePoint {
    /// Position.
    pub point: Point3<f64>,
    /// Unit tangent, of either sign.
    pub tangent: Vector3<f64>,
    /// Distance of the points from the cylinder that it is the axis of, root mean square.
    pub rms_mm: f64,
}

/// Projects a thinned set of the cloud's points onto the spine: what the jets guess is gathered first, so that one
/// cylinder per place is fitted, from a good start.
pub fn spine_cloud(work: &PointCloud, radius_mm: f64) -> Vec<SpinePoint> {
    let seeds = work.thinned(SEED_CELL_RADII * radius_mm);
    let reach = JET_RADII * radius_mm;
    let index = Grid::new(work, reach);
    let jets: Vec<Option<Jet>> = (0..seeds.len())
        .into_par_iter()
        .map_init(Near::default, |near, i| {
            let p = seeds.point(i);
            fit_jet(&p, near.within(&index, &p, reach), reach)
        })
        .collect();
    let error = |j: &Jet| (j.strong_per_mm * radius_mm - 1.0).abs();
    let mut errors: Vec<f64> = jets.iter().flatten().map(error).filter(|e| *e < MOST_ERROR).collect();
    let usual = median(&mut errors).unwrap_or(0.0);
    let allowed = CURVATURE_SHARE.max(4.0 * usual);
    let guesses: Vec<SpinePoint> = jets
        .iter()
        .flatten()
        .filter(|j| error(j) <= allowed)
        .map(|j| SpinePoint { point: j.foot - j.normal * radius_mm, tangent: j.weak_direction, rms_mm: 0.0 })
        .collect();
    let places = condense(&guesses, GUESS_SPACING_RADII * radius_mm);
    let found: Vec<Option<Projected>> = places
        .par_iter()
        .map_init(Near::default, |near, place| project(place, radius_mm, near, &index))
        .collect();
    followed(strongest(found.into_iter().flatten().collect(), radius_mm), radius_mm)
}

/// A spine point and how many points bear it out.
type Projected = (SpinePoint, f64);

/// Two tubes cannot be nearer than two radii: of spine points that lie side by side only the better borne out stay.
fn strongest(found: Vec<Projected>, radius_mm: f64) -> Vec<SpinePoint> {
    let mut order: Vec<usize> = (0..found.len()).collect();
    order.sort_by(|&a, &b| found[b].1.total_cmp(&found[a].1).then(a.cmp(&b)));
    let points: Vec<Point3<f64>> = found.iter().map(|f| f.0.point).collect();
    let index = Neighbours::new(&PointCloud::from_points(&points));
    let mut state = vec![Stand::Open; found.len()];
    let mut near = Vec::new();
    for i in order {
        if state[i] == Stand::Dropped {
            continue;
        }
        state[i] = Stand::Stays;
        let spine = &found[i].0;
        index.within(&spine.point, APART_RADII * radius_mm, &mut near);
        for k in near.iter().map(|&k| k as usize) {
            let gap = (points[k] - spine.point) / radius_mm;
            let along = gap.dot(&spine.tangent);
            let aside = (gap.norm_squared() - along * along).max(0.0).sqrt();
            if state[k] == Stand::Open && aside > ASIDE_RADII + TIGHTEST_RADII * along * along {
                state[k] = Stand::Dropped;
            }
        }
    }
    found.iter().zip(state).filter(|(_, s)| *s == Stand::Stays).map(|(f, _)| f.0).collect()
}

/// What is known of a spine point beside others.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Stand {
    Open,
    Stays,
    Dropped,
}

/// One projection: a cylinder from the guessed axis, and the outlier rules.
fn project(place: &SpinePoint, radius_mm: f64, near: &mut Near, index: &Grid) -> Option<Projected> {
    let start = Cylinder::guess(place.point, place.tangent, radius_mm);
    let points = near.within(index, &start.centre, REACH_RADII * radius_mm);
    let cylinder = fit_cylinder(points, &start, false)?;
    let fits = cylinder.opening > LEAST_OPENING && cylinder.share > LEAST_SHARE;
    let spine = SpinePoint { point: cylinder.centre, tangent: cylinder.axis, rms_mm: cylinder.rms_mm };
    fits.then_some((spine, cylinder.count as f64 * cylinder.share))
}

/// Thins the spine cloud to points about `spacing_mm` apart, each moved sideways onto the mean of its
/// neighbourhood.
pub fn condense(spine: &[SpinePoint], spacing_mm: f64) -> Vec<SpinePoint> {
    if spine.is_empty() {
        return Vec::new();
    }
    let points: Vec<Point3<f64>> = spine.iter().map(|s| s.point).collect();
    let neighbours = Neighbours::new(&PointCloud::from_points(&points));
    let mut taken = vec![false; spine.len()];
    let mut out = Vec::new();
    let mut found = Vec::new();
    for i in 0..spine.len() {
        if taken[i] {
            continue;
        }
        neighbours.within(&points[i], spacing_mm, &mut found);
        found.iter().for_each(|&k| taken[k as usize] = true);
        let along: Vec<&SpinePoint> = found
            .iter()
            .map(|&k| &spine[k as usize])
            .filter(|s| s.tangent.dot(&spine[i].tangent).abs() > 0.8)
            .collect();
        let n = along.len() as f64;
        let mean: Vector3<f64> = along.iter().map(|s| s.point.coords).sum::<Vector3<f64>>() / n;
        let turn = |s: &SpinePoint| s.tangent * s.tangent.dot(&spine[i].tangent).signum();
        let tangent = along.iter().map(|s| turn(s)).sum::<Vector3<f64>>().normalize();
        let forward = (points[i].coords - mean).dot(&tangent);
        out.push(SpinePoint {
            point: Point3::from(mean + tangent * forward),
            tangent,
            rms_mm: spine[i].rms_mm,
        });
    }
    out
}
