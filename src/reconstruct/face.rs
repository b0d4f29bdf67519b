//! The end face where the scanner saw it: a ring of points on a plane across the axis, within the tube's outside.
//!
//! The bore behind it was seen too, and its points lie on a cylinder; so the plane is looked for by trial planes through
//! three points each, and accepted only when points are dense on it and rare before it.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::recognize::{MEDIAN_TO_SIGMA, median};

/// Trial planes, and most points that vote on them.
const TRIALS: usize = 400;
const VOTERS: usize = 1500;
/// Points nearer than this to the outside may belong to it, in standard deviations of the noise.
const EDGE_SIGMAS: f64 = 4.0;
/// A face's points differ by more than this in their distance from the axis, in standard deviations of the noise; where
/// only the bore was seen, they do not.
const BROAD_SIGMAS: f64 = 6.0;
/// Fewest points of a face. The scanner sees all of it or nothing: points lie in all but one of the sixths.
const MIN_POINTS: usize = 12;
const SIXTHS: usize = 6;
/// Sectors around the axis that must agree: one with a burr does not.
const SECTORS: usize = 24;
/// A sector this many standard deviations off the others does not count.
const SECTOR_SIGMAS: f64 = 3.0;
/// Cut-off of the biweight in standard deviations.
const CUTOFF_SIGMAS: f64 = 5.0;

/// A plane x = at + slope . (y, z).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Face {
    /// Where the plane meets the axis.
    pub at_mm: f64,
    /// Its slope along y and z.
    pub slope: [f64; 2],
    /// Covariance of the three.
    pub covariance: Matrix3<f64>,
    /// Points on it.
    pub points: usize,
}

/// Where a face is looked for.
#[derive(Debug, Clone, Copy)]
pub struct Search {
    /// About where on the axis, and how far from there at most.
    pub about_mm: f64,
    pub near_mm: f64,
    /// Steepest plane that is looked at, as a slope.
    pub steepest: f64,
}

/// Whether a point is too far from the outside to belong to it.
pub fn may_hold(p: &Point3<f64>, radius_mm: f64, noise_mm: f64) -> bool {
    p.y.hypot(p.z) < radius_mm - EDGE_SIGMAS * noise_mm
}

/// Looks for the face among those of `points` that it [may hold](may_hold), in a frame whose x axis is the tube's and leads
/// into it.
pub fn find(points: &[Point3<f64>], radius_mm: f64, noise_mm: f64, place: &Search) -> Option<Face> {
    let reach = place.near_mm + place.steepest * radius_mm;
    let near = |p: &&Point3<f64>| may_hold(p, radius_mm, noise_mm) && (p.x - place.about_mm).abs() < reach;
    let mut candidates: Vec<Point3<f64>> = points.iter().filter(near).copied().collect();
    if candidates.len() < MIN_POINTS {
        return None;
    }
    let mut plane = best_trial(&candidates, noise_mm, place.steepest)?;
    (plane, _) = refine(&candidates, plane, noise_mm, noise_mm)?;
    // The bore begins where the face ends: its first points would draw the plane inwards.
    let mut rings: Vec<f64> = on_plane(&candidates, &plane, 2.0 * noise_mm).map(|p| p.y.hypot(p.z)).collect();
    rings.sort_by(f64::total_cmp);
    let (inmost, outmost) = (rings.get(rings.len() / 10)?, rings.get(rings.len() * 9 / 10)?);
    if outmost - inmost < BROAD_SIGMAS * noise_mm {
        return None;
    }
    let bore = rings.get(rings.len() / 50)? + EDGE_SIGMAS * noise_mm;
    let face = |p: &&Point3<f64>| p.y.hypot(p.z) > bore;
    if on_plane(&candidates, &plane, 3.0 * noise_mm).filter(face).count() >= 3 * MIN_POINTS {
        candidates.retain(|p| face(&p));
    }
    let scale = spread(&candidates, &plane, noise_mm).max(0.5 * noise_mm);
    let (mut plane, mut covariance) = refine(&candidates, plane, noise_mm, scale)?;
    let mut unrest = 1.0;
    for _ in 0..3 {
        let keep;
        (keep, unrest) = agreeing_sectors(&candidates, &plane, scale);
        let kept: Vec<Point3<f64>> =
            candidates.iter().filter(|p| keep[sector_of(p, SECTORS)]).copied().collect();
        (plane, covariance) = refine(&kept, plane, noise_mm, scale)?;
    }
    covariance *= unrest;
    let points = on_plane(&candidates, &plane, 3.0 * scale).count();
    let face = Face { at_mm: plane.x, slope: [plane.y, plane.z], covariance, points };
    (stands_out(&candidates, &plane, scale) && (plane.x - place.about_mm).abs() < place.near_mm)
        .then_some(face)
}

fn sector_of(p: &Point3<f64>, sectors: usize) -> usize {
    let turn = p.z.atan2(p.y) / std::f64::consts::TAU + 0.5;
    ((turn * sectors as f64) as usize).min(sectors - 1)
}

/// Which sectors lie on the plane, and by how much the variance of their means exceeds what the points' scatter
/// explains.
fn agreeing_sectors(points: &[Point3<f64>], plane: &Vector3<f64>, scale_mm: f64) -> ([bool; SECTORS], f64) {
    let mut sums = [(0.0f64, 0.0f64); SECTORS];
    for p in on_plane(points, plane, CUTOFF_SIGMAS * scale_mm) {
        let sum = &mut sums[sector_of(p, SECTORS)];
        *sum = (sum.0 + 1.0, sum.1 + off(p, plane));
    }
    let normed = sums.map(|(n, sum)| if n > 0.0 { sum / (scale_mm * n.sqrt()) } else { 0.0 });
    let mut sizes: Vec<f64> =
        normed.iter().zip(&sums).filter(|(_, s)| s.0 > 0.0).map(|(z, _)| z.abs()).collect();
    let typical = (MEDIAN_TO_SIGMA * median(&mut sizes).unwrap_or(0.0)).max(1.0);
    let keep = normed.map(|z| z.abs() < SECTOR_SIGMAS * typical);
    let kept = normed.iter().zip(&sums).filter(|(z, s)| s.0 > 0.0 && z.abs() < SECTOR_SIGMAS * typical);
    let (n, squares) = kept.fold((0.0, 0.0), |(n, sum), (z, _)| (n + 1.0, sum + z * z));
    (keep, (squares / f64::max(n - 3.0, 1.0)).max(1.0))
}

fn off(p: &Point3<f64>, plane: &Vector3<f64>) -> f64 {
    p.x - plane.x - plane.y * p.y - plane.z * p.z
}

fn on_plane<'a>(
    points: &'a [Point3<f64>],
    plane: &'a Vector3<f64>,
    within_mm: f64,
) -> impl Iterator<Item = &'a Point3<f64>> {
    points.iter().filter(move |p| off(p, plane).abs() < within_mm)
}

/// The trial plane with the most points.
fn best_trial(points: &[Point3<f64>], noise_mm: f64, steepest: f64) -> Option<Vector3<f64>> {
    let step = points.len().div_ceil(VOTERS);
    let voters: Vec<Point3<f64>> = points.iter().step_by(step).copied().collect();
    // A plain congruential generator: the same points, the same trials.
    let mut state = 0x2545_f491_4f6c_dd1d_u64;
    let mut draw = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        voters[((state >> 33) as usize) % voters.len()]
    };
    let mut best: Option<(usize, Vector3<f64>)> = None;
    for _ in 0..TRIALS {
        let rows = [draw(), draw(), draw()];
        let matrix = Matrix3::from_fn(|i, j| if j == 0 { 1.0 } else { rows[i][j] });
        let values = Vector3::new(rows[0].x, rows[1].x, rows[2].x);
        let Some(plane) = matrix.try_inverse().map(|m| m * values) else { continue };
        if plane.y.hypot(plane.z) >= steepest {
            continue;
        }
        let around = sixths(&voters, &plane, 3.0 * noise_mm);
        let votes: usize = around.iter().sum();
        if is_ring(&around) && best.is_none_or(|(most, _)| votes > most) {
            best = Some((votes, plane));
        }
    }
    best.map(|(_, plane)| plane)
}

/// Robust least squares from a plane close by; with its covariance.
fn refine(
    points: &[Point3<f64>],
    start: Vector3<f64>,
    noise_mm: f64,
    scale_mm: f64,
) -> Option<(Vector3<f64>, Matrix3<f64>)> {
    let mut plane = start;
    let mut covariance = Matrix3::zeros();
    let cutoff = CUTOFF_SIGMAS * scale_mm.max(0.2 * noise_mm);
    for _ in 0..15 {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        let (mut squares, mut slopes, mut weights, mut used) = (0.0, 0.0, 0.0, 0.0);
        for p in points {
            let r = off(p, &plane);
            let share = r / cutoff;
            let keep = 1.0 - share * share;
            if keep <= 0.0 {
                continue;
            }
            let (row, w) = (Vector3::new(1.0, p.y, p.z), keep * keep);
            normal += row * row.transpose() * w;
            right += row * (w * r);
            squares += (w * r).powi(2);
            slopes += w - 4.0 * share * share * keep;
            weights += w;
            used += 1.0;
        }
        if used < MIN_POINTS as f64 {
            return None;
        }
        let inverse = normal.try_inverse()?;
        plane += inverse * right;
        // As in the tube's own fit: the variance of an M-estimate; of few points, with Student's wider scatter.
        covariance = inverse * (squares * weights / f64::max(slopes, 1e-12).powi(2) * used / (used - 5.0));
    }
    Some((plane, covariance))
}

/// Standard deviation of the points about the plane, from the median of their distances.
fn spread(points: &[Point3<f64>], plane: &Vector3<f64>, noise_mm: f64) -> f64 {
    let mut sizes: Vec<f64> = on_plane(points, plane, 4.0 * noise_mm).map(|p| off(p, plane).abs()).collect();
    median(&mut sizes).map_or(noise_mm, |m| MEDIAN_TO_SIGMA * m)
}

/// Points on the plane in each sixth of the ring.
fn sixths(points: &[Point3<f64>], plane: &Vector3<f64>, within_mm: f64) -> [usize; SIXTHS] {
    let mut around = [0; SIXTHS];
    on_plane(points, plane, within_mm).for_each(|p| around[sector_of(p, SIXTHS)] += 1);
    around
}

/// Whether all but one of the sixths have their share, or a fifth of it: a bore is seen on its far side only.
fn is_ring(around: &[usize; SIXTHS]) -> bool {
    let mut counts = *around;
    counts.sort_unstable();
    let share = counts.iter().sum::<usize>() as f64 / SIXTHS as f64;
    counts[1] > 0 && counts[1] as f64 >= 0.2 * share
}

/// Whether points are many on the plane, all around, few right behind it and none to speak of before it.
fn stands_out(points: &[Point3<f64>], plane: &Vector3<f64>, scale_mm: f64) -> bool {
    let within = |p: &&Point3<f64>, from: f64, to: f64| (from..to).contains(&(off(p, plane) / scale_mm));
    let count = |from: f64, to: f64| points.iter().filter(|p| within(p, from, to)).count();
    let (before, on, behind) = (count(-12.0, -6.0), count(-3.0, 3.0), count(6.0, 12.0));
    let around = sixths(points, plane, 3.0 * scale_mm);
    on >= MIN_POINTS && on > 2 * behind && on > 5 * before && is_ring(&around)
}
