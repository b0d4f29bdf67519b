//! The tube's radius before anything else is known: curvature radii of jets (paper 000, section 3.1) with the
//! neighbourhood found by itself, then local cylinder fits.
//!
//! A tube may be a small part of what the scan shows, so it is not a median that counts but how many places agree: at
//! a scale that suits a tube, jets all over it give its radius, while edges and noise give any.

use nalgebra::Point3;
use rayon::prelude::*;

use super::cylinder::{Cylinder, REACH_RADII, fit_cylinder};
use crate::cloud::{Grid, PointCloud};
use crate::recognize::{Jet, fit_jet, median};

/// Neighbourhood of a jet in tube radii (paper 000, section 7).
pub const JET_RADII: f64 = 2.0 / 3.0;

/// Scales, in radii of the tube that they find, that suit it: more than one [`SCALE_STEP`] wide.
const SUITS: std::ops::Range<f64> = 0.42..1.05;

/// Ratio of neighbouring scales.
const SCALE_STEP: f64 = 1.8;

/// Places that are looked at to find a candidate and to weigh it.
const PLACES: usize = 72;
const JUDGES: usize = 90;

/// Radii within this share of each other are one tube's.
const AGREE: f64 = 0.12;

/// Share of the places that must agree on a radius to make it a candidate, and then a tube.
const LEAST_AGREEING: f64 = 0.12;
const LEAST_SUPPORT: f64 = 0.06;

/// Cylinders that must support a radius.
const LEAST_CYLINDERS: usize = 6;

/// A cylinder counts when this share of the points around it lie on it.
const LEAST_SHARE: f64 = 0.5;

/// Straight enough to tell the radius: weak curvature over strong.
const STRAIGHT: f64 = 0.08;

/// A radius with this support is what the scan shows.
const CLEAR_SUPPORT: f64 = 0.7;

/// A tube's radius is less than this share of the scene.
const WIDEST_SHARE: f64 = 0.25;

/// A candidate's cylinders may be this much less exact than the most exact ones.
const MOST_OVER_NOISE: f64 = 6.0;

/// Thinning from level to level.
const LEVEL_STEP: f64 = 1.7;

/// Points of a neighbourhood across, at a scale's thinning.
const ACROSS: f64 = 5.0;

/// A radius that tubes in the cloud may have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Outer radius.
    pub radius_mm: f64,
    /// Share of the places that lie on cylinders of this radius.
    pub support: f64,
    /// Distance of the points from these cylinders, root mean square, at the better places.
    pub rms_mm: f64,
}

/// What one scale says of the radius.
#[derive(Debug, Clone, Copy)]
struct Reading {
    radius_mm: f64,
    agreeing: f64,
}

/// Radii of tubes in a cloud whose points lie about `spacing_mm` apart, the best supported first; empty when nothing
/// in the cloud is curved like a tube.
pub fn candidates(cloud: &PointCloud, spacing_mm: f64) -> Vec<Candidate> {
    let coarse = spacing_mm * LEVEL_STEP;
    let mut out = judged(cloud, &readings(&cloud.thinned(coarse), coarse));
    // A tube so thin that its points must all be looked at.
    if out.iter().all(|c| c.support < CLEAR_SUPPORT) {
        out.extend(judged(cloud, &readings(cloud, spacing_mm)));
    }
    // One scanner, one noise: what is much farther off its cylinders is no cylinder.
    let noise = out.iter().map(|c| c.rms_mm).fold(f64::INFINITY, f64::min);
    out.retain(|c| c.rms_mm <= MOST_OVER_NOISE * noise);
    out.sort_by(|a, b| b.support.total_cmp(&a.support).then(a.radius_mm.total_cmp(&b.radius_mm)));
    out.dedup_by(|b, a| (a.radius_mm / b.radius_mm).ln().abs() < 2.0 * AGREE);
    out
}

/// The readings that cylinders bear out.
fn judged(cloud: &PointCloud, readings: &[Reading]) -> Vec<Candidate> {
    let mut out: Vec<Candidate> = Vec::new();
    for reading in readings {
        let known = out.iter().any(|c| (c.radius_mm / reading.radius_mm).ln().abs() < 2.0 * AGREE);
        if known {
            continue;
        }
        out.extend(judge(cloud, reading.radius_mm));
        if out.last().is_some_and(|c| c.support > CLEAR_SUPPORT) {
            break;
        }
    }
    out
}

/// One reading per scale, the most agreed on first.
fn readings(cloud: &PointCloud, spacing_mm: f64) -> Vec<Reading> {
    let Some((low, high)) = cloud.bounds() else { return Vec::new() };
    let widest = (high - low).norm() * WIDEST_SHARE;
    let mut readings = Vec::new();
    let mut scale = 2.0 * spacing_mm;
    let mut thinned: Option<PointCloud> = None;
    let mut index = Grid::new(cloud, 2.0 * scale);
    let mut cell = spacing_mm;
    while scale < SUITS.end * widest {
        if scale / ACROSS > LEVEL_STEP * cell {
            cell = scale / ACROSS;
            let next = thinned.as_ref().unwrap_or(cloud).thinned(cell);
            index = Grid::new(&next, 2.0 * scale);
            thinned = Some(next);
        }
        let level = thinned.as_ref().unwrap_or(cloud);
        readings.extend(read_at(level, &index, scale).filter(|r| r.radius_mm < widest));
        scale *= SCALE_STEP;
    }
    readings.sort_by(|a: &Reading, b| b.agreeing.total_cmp(&a.agreeing));
    readings
}

fn places(cloud: &PointCloud, most: usize) -> Vec<Point3<f64>> {
    let stride = cloud.len().div_ceil(most).max(1);
    (0..cloud.len()).step_by(stride).map(|i| cloud.point(i)).collect()
}

/// Jets at a number of places of the cloud; None where there is none.
fn jets_at(index: &Grid, scale: f64, places: &[Point3<f64>]) -> Vec<Option<Jet>> {
    places
        .par_iter()
        .map_init(Near::default, |near, p| fit_jet(p, near.within(index, p, scale), scale))
        .collect()
}

/// Room for the points of one neighbourhood, used again and again.
#[derive(Default)]
pub(super) struct Near {
    points: Vec<Point3<f64>>,
}

impl Near {
    /// The points within a radius.
    pub fn within(&mut self, index: &Grid, p: &Point3<f64>, radius_mm: f64) -> &[Point3<f64>] {
        self.points.clear();
        index.for_each_within(p, radius_mm, |_, way| self.points.push(p + way));
        &self.points
    }
}

/// The radius on which most places agree at one scale, of those that the scale suits.
fn read_at(cloud: &PointCloud, index: &Grid, scale: f64) -> Option<Reading> {
    let places = places(cloud, PLACES);
    let jets = jets_at(index, scale, &places);
    let mut logs: Vec<f64> = jets
        .iter()
        .flatten()
        .filter(|j| SUITS.contains(&(scale * j.strong_per_mm)))
        .map(|j| -j.strong_per_mm.ln())
        .collect();
    logs.sort_by(f64::total_cmp);
    let (from, count) = densest(&logs, 2.0 * AGREE)?;
    let radius_mm = logs[from + count / 2].exp();
    let agreeing = count as f64 / places.len() as f64;
    (agreeing >= LEAST_AGREEING && count >= LEAST_CYLINDERS).then_some(Reading { radius_mm, agreeing })
}

/// Start and number of the values in the fullest window of a sorted list.
fn densest(sorted: &[f64], width: f64) -> Option<(usize, usize)> {
    let count = |i: usize| sorted[i..].iter().take_while(|v| **v <= sorted[i] + width).count();
    (0..sorted.len()).map(|i| (i, count(i))).max_by_key(|&(i, n)| (n, std::cmp::Reverse(i)))
}

/// How many places lie on cylinders of about this radius, and their median radius, of straight places if there are
/// enough.
fn judge(cloud: &PointCloud, radius_mm: f64) -> Option<Candidate> {
    let work = cloud.thinned(0.13 * radius_mm);
    let index = Grid::new(&work, REACH_RADII * radius_mm);
    let places = places(&work, JUDGES);
    let fitted: Vec<(f64, bool, f64)> = places
        .par_iter()
        .map_init(Near::default, |near, p| {
            let reach = JET_RADII * radius_mm;
            let jet = fit_jet(p, near.within(&index, p, reach), reach)?;
            let start = Cylinder::guess(jet.foot - jet.normal * radius_mm, jet.weak_direction, radius_mm);
            let points = near.within(&index, &start.centre, REACH_RADII * radius_mm);
            let cylinder = fit_cylinder(points, &start, true)?;
            let straight = (jet.weak_per_mm * radius_mm).abs() < STRAIGHT;
            (cylinder.share > LEAST_SHARE).then_some((cylinder.radius_mm, straight, cylinder.rms_mm))
        })
        .collect::<Vec<_>>()
        .into_iter()
        .flatten()
        .collect();
    let mut logs: Vec<f64> = fitted.iter().map(|f| f.0.ln()).collect();
    logs.sort_by(f64::total_cmp);
    let (from, count) = densest(&logs, 2.0 * AGREE)?;
    let support = count as f64 / places.len() as f64;
    if count < LEAST_CYLINDERS || support < LEAST_SUPPORT {
        return None;
    }
    let window = logs[from].exp()..=logs[from + count - 1].exp();
    let within = |f: &&(f64, bool, f64)| window.contains(&f.0);
    let mut straight: Vec<f64> = fitted.iter().filter(within).filter(|f| f.1).map(|f| f.0).collect();
    let mut all: Vec<f64> = fitted.iter().filter(within).map(|f| f.0).collect();
    let radius_mm = if straight.len() >= 20 { median(&mut straight) } else { median(&mut all) };
    let mut rms: Vec<f64> = fitted.iter().filter(within).map(|f| f.2).collect();
    rms.sort_by(f64::total_cmp);
    Some(Candidate { radius_mm: radius_mm?, support, rms_mm: rms[rms.len() / 4] })
}
