//! Where the tube's outside stops: the outline of the scanned points at an end.
//!
//! Sector by sector around the tube first: the plane on which most of them begin tells which ones count, those with a burr or
//! with something that touches the tube do not. Then by all points of these together ([`edge`](super::edge)), which is much
//! closer. Whether the end was cut square or mitred is weighed last ([`square`]).

use nalgebra::{Matrix3, Point3, Vector3};

use super::edge::Edge;
use super::square::{self, Estimate, Lure, Weighed};
use crate::recognize::{MEDIAN_TO_SIGMA, median};

/// Sectors around the tube: not narrower than this many steps of the pattern.
const SECTOR_STEPS: f64 = 1.5;
const MOST_SECTORS: f64 = 36.0;
const FEWEST_SECTORS: f64 = 8.0;

/// How far from the end the pattern is looked at, in tube radii.
const REACH_RADII: f64 = 6.0;

/// Fewest points of a sector and fewest sectors.
const MIN_POINTS: usize = 4;
const MIN_SECTORS: usize = 3;
/// A sector with less than this share of the densest one's points per millimetre holds stray ones.
const LEAST_DENSE: f64 = 0.1;

/// The outline's own slope before anything is expected of it (45 degrees).
const LOOSE_SPREAD: f64 = 1.0;
/// Cut-off of the biweight over sectors, in standard deviations of one sector.
const CUTOFF_SECTORS: f64 = 5.0;
/// A few sectors that agree better than to this share of a step do so by chance: the others are not wrong.
const CHANCE_STEPS: f64 = 0.1;
/// How far a sector's beginning errs, in steps: its first points fall short of the edge by up to one.
const SECTOR_STEPS_SIGMA: f64 = 0.4;
/// A sector that begins farther from the plane than this does not agree, however much the others scatter.
const AGREE_STEPS: f64 = 2.0;
/// What is left of an end beside a burr is square within so many standard deviations of its slope.
const SQUARE_SIGMAS: f64 = 2.0;
/// An edge that is more likely mitred is held against what square ones look like in the pattern, one by one.
const MAYBE_SQUARE: f64 = 0.5;
/// Sectors of less weight do not stop at the plane.
const LEAST_WEIGHT: f64 = 0.5;

/// The outline of an end as a plane: x = at + slope . (y, z).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outline {
    /// Where the plane meets the axis.
    pub at_mm: f64,
    /// Its standard deviation.
    pub sigma_mm: f64,
    /// The plane's slope along y and z, drawn towards square as far as the data leaves it open.
    pub slope: [f64; 2],
    /// Its standard deviations and covariance: yy, yz, zz.
    pub slope_variance: [f64; 3],
    /// The plane's place and slope by the data alone.
    pub loose_at_mm: f64,
    pub loose_slope: [f64; 2],
    /// Standard deviation of that slope along itself.
    pub loose_sigma: f64,
    /// Side of the square that belongs to one point.
    pub step_mm: f64,
    /// Share of the sectors whose points stop at the plane.
    pub agreeing: f64,
}

impl Outline {
    /// The slope by the data alone, whichever way.
    pub fn loose_size(&self) -> f64 {
        self.loose_slope[0].hypot(self.loose_slope[1])
    }
}

/// Finds the outline at the beginning of points of the tube's outside, in a frame whose x axis is the tube's and leads
/// into it, scanned in passes that disagree by `passes_mm`. None when too little was scanned there.
pub fn find(points: &[Point3<f64>], radius_mm: f64, noise_mm: f64, passes_mm: f64) -> Option<Outline> {
    let rim = Rim::new(points, radius_mm, noise_mm)?;
    // The slope first; then all again along it.
    let mut rough = Rough::find(&rim, [0.0, 0.0])?;
    for _ in 0..2 {
        rough = Rough::find(&rim, rough.slope())?;
    }
    // Passes that see different sides also tilt what they see together.
    let tilt = passes_mm / radius_mm;
    let passes = Matrix3::from_diagonal(&Vector3::new(passes_mm, tilt, tilt).map(|s| s * s));
    let edge = rough.edge(&rim);
    let mut fine = rough.refined(edge.as_ref(), &passes);
    if let Some(clean) = edge.as_ref().and_then(Edge::without_burr) {
        let other = rough.refined(Some(&clean), &passes);
        // Past an oblique edge's own slope no part of it stands out: then it may be either.
        let is_burr = || edge.as_ref().is_some_and(|e| e.along(&fine.free).without_burr().is_some());
        if other.is_square() {
            fine = if is_burr() { other } else { Fine { both: fine.both.or(&other.both), ..fine } };
        }
    }
    let Fine { free, both } = fine;
    let Estimate { value, variance } = both.estimate;
    Some(Outline {
        at_mm: value.x,
        sigma_mm: both.sigma_mm,
        slope: [value.y, value.z],
        slope_variance: [variance[(1, 1)], variance[(1, 2)], variance[(2, 2)]],
        loose_at_mm: free.value.x,
        loose_slope: [free.value.y, free.value.z],
        loose_sigma: slope_sigma(&free),
        step_mm: rim.step_mm,
        agreeing: rough.agreeing(rim.step_mm),
    })
}

/// Standard deviation of a plane's slope along itself.
fn slope_sigma(plane: &Estimate) -> f64 {
    let along = Vector3::new(0.0, plane.value.y, plane.value.z).try_normalize(1e-12).unwrap_or_default();
    along.dot(&(plane.variance * along)).max(0.0).sqrt()
}

/// First coordinate from which on the points come as densely as usual: stray points before it do not count.
pub(super) fn solid_start(sorted: &[f64], reach_mm: f64) -> Option<f64> {
    let last = *sorted.last()?;
    let window = 0.1 * reach_mm;
    let count_from = |i: usize| sorted[i..].partition_point(|x| *x < sorted[i] + window);
    let span = (last - sorted[0]).min(3.0 * reach_mm).max(window);
    let within = sorted.partition_point(|x| *x <= sorted[0] + span);
    let usual = within as f64 * window / span;
    (0..sorted.len()).find(|&i| count_from(i) as f64 >= 0.3 * usual).map(|i| sorted[i])
}

/// Side of the square that belongs to one point.
fn step_mm(points: &[Point3<f64>], first: f64, radius_mm: f64) -> Option<f64> {
    let mut filled = [0usize; MOST_SECTORS as usize];
    let (mut n, mut last) = (0usize, first);
    for p in points.iter().filter(|p| p.x >= first && p.x < first + REACH_RADII * radius_mm) {
        filled[sector_of(p, filled.len())] += 1;
        n += 1;
        last = last.max(p.x);
    }
    let seen = filled.iter().filter(|n| **n > 0).count() as f64 / filled.len() as f64;
    let area = seen * std::f64::consts::TAU * radius_mm * (last - first);
    (n > 0 && area > 0.0).then(|| (area / n as f64).sqrt())
}

fn sector_of(p: &Point3<f64>, sectors: usize) -> usize {
    let turn = p.z.atan2(p.y) / std::f64::consts::TAU + 0.5;
    ((turn * sectors as f64) as usize).min(sectors - 1)
}

/// Place along the tube past a slope.
fn past(p: &Point3<f64>, slope: [f64; 2]) -> f64 {
    p.x - slope[0] * p.y - slope[1] * p.z
}

/// The points at an end and the pattern they lie in.
struct Rim<'a> {
    points: &'a [Point3<f64>],
    radius_mm: f64,
    noise_mm: f64,
    /// Where they begin.
    first_mm: f64,
    step_mm: f64,
    /// Number of sectors.
    count: usize,
}

/// One sector with points.
struct Sector {
    index: usize,
    /// Of the plane: 1, y, z at the sector's middle.
    row: Vector3<f64>,
    /// Its first point along the tube past a slope.
    first_mm: f64,
    /// Where it begins: mean of its first layer less half the layer.
    begin_mm: f64,
    per_mm: f64,
}

impl Rim<'_> {
    fn new(points: &[Point3<f64>], radius_mm: f64, noise_mm: f64) -> Option<Rim<'_>> {
        let mut along: Vec<f64> = points.iter().map(|p| p.x).collect();
        along.sort_unstable_by(f64::total_cmp);
        let first_mm = solid_start(&along, 2.0 * radius_mm)?;
        let step_mm = step_mm(points, first_mm, radius_mm)?;
        let around = std::f64::consts::TAU * radius_mm;
        let count = (around / (SECTOR_STEPS * step_mm)).clamp(FEWEST_SECTORS, MOST_SECTORS) as usize;
        Some(Rim { points, radius_mm, noise_mm, first_mm, step_mm, count })
    }

    fn to_mm(&self) -> f64 {
        self.first_mm + REACH_RADII * self.radius_mm
    }

    /// The sectors, their points taken along the tube past a slope.
    fn sectors(&self, slope: [f64; 2]) -> Vec<Sector> {
        let mut along: Vec<Vec<f64>> = vec![Vec::new(); self.count];
        // A slope of 45 degrees begins a radius before the axis does.
        let from = self.first_mm - 1.5 * self.radius_mm;
        for p in self.points {
            let u = past(p, slope);
            if u >= from && u < self.to_mm() {
                along[sector_of(p, self.count)].push(u);
            }
        }
        let seen = along.into_iter().enumerate();
        let mut sectors: Vec<Sector> = seen.filter_map(|(i, along)| self.sector(i, along)).collect();
        let densest = sectors.iter().map(|s| s.per_mm).fold(0.0, f64::max);
        sectors.retain(|s| s.per_mm >= LEAST_DENSE * densest);
        sectors
    }

    fn sector(&self, index: usize, mut along: Vec<f64>) -> Option<Sector> {
        along.sort_by(f64::total_cmp);
        let first_mm = solid_start(&along, 2.0 * self.radius_mm)?;
        along.drain(..along.partition_point(|u| *u < first_mm));
        if along.len() < MIN_POINTS {
            return None;
        }
        let per_mm = (along.len() - 1) as f64 / (along[along.len() - 1] - first_mm).max(1e-9);
        let depth = self.step_mm.max(3.0 * self.noise_mm);
        let layer = ((per_mm * depth).round() as usize).clamp(1, along.len());
        let mean = along[..layer].iter().sum::<f64>() / layer as f64;
        let turn = ((index as f64 + 0.5) / self.count as f64 - 0.5) * std::f64::consts::TAU;
        let row = Vector3::new(1.0, self.radius_mm * turn.cos(), self.radius_mm * turn.sin());
        Some(Sector { index, row, first_mm, begin_mm: mean - 0.5 * layer as f64 / per_mm, per_mm })
    }
}

/// The outline's plane by the data alone, and after square and mitred were weighed.
struct Fine {
    free: Estimate,
    both: Weighed,
}

impl Fine {
    /// Whether nothing speaks for a mitre, whose tip stands out as a burr does but leaves an oblique edge without it.
    fn is_square(&self) -> bool {
        let slope = self.free.value.y.hypot(self.free.value.z);
        self.both.square_share > 0.5 && slope < SQUARE_SIGMAS * slope_sigma(&self.free)
    }
}

/// The plane on which most sectors begin.
struct Rough {
    plane: Estimate,
    /// The slope along which the sectors were taken.
    base: [f64; 2],
    sectors: Vec<Sector>,
    /// How far each lies on the plane, 0 to 1.
    weights: Vec<f64>,
}

impl Rough {
    fn find(rim: &Rim, base: [f64; 2]) -> Option<Rough> {
        let sectors = rim.sectors(base);
        if sectors.len() < MIN_SECTORS {
            return None;
        }
        let middle = median(&mut sectors.iter().map(|s| s.begin_mm).collect::<Vec<_>>())?;
        let mut value = Vector3::new(middle, 0.0, 0.0);
        let (mut weights, mut variance) = (Vec::new(), Matrix3::zeros());
        for _ in 0..12 {
            let off: Vec<f64> = sectors.iter().map(|s| s.begin_mm - s.row.dot(&value)).collect();
            let mut sizes: Vec<f64> = off.iter().map(|r| r.abs()).collect();
            let scale = (MEDIAN_TO_SIGMA * median(&mut sizes)?).max(CHANCE_STEPS * rim.step_mm);
            weights = off.iter().map(|r| biweight(r / (CUTOFF_SECTORS * scale))).collect();
            let prior = (scale / LOOSE_SPREAD).powi(2);
            let mut normal = Matrix3::from_diagonal(&Vector3::new(0.0, prior, prior));
            let mut right = Vector3::zeros();
            for (s, w) in sectors.iter().zip(&weights) {
                normal += s.row * s.row.transpose() * *w;
                right += s.row * (w * s.begin_mm);
            }
            let inverse = normal.try_inverse()?;
            value = inverse * right;
            // As if the sectors erred alike: stripes lie across many of them.
            let sector = scale.max(SECTOR_STEPS_SIGMA * rim.step_mm);
            variance = inverse * (sector * sector * weights.iter().sum::<f64>().sqrt());
        }
        value += Vector3::new(0.0, base[0], base[1]);
        Some(Rough { plane: Estimate { value, variance }, base, sectors, weights })
    }

    /// The plane by all points next to it together where that is closer; square and mitred weighed. `passes` is the covariance
    /// of what passes disagree by.
    fn refined(&self, edge: Option<&Edge>, passes: &Matrix3<f64>) -> Fine {
        let slope_variance = |e: &Estimate| e.variance[(1, 1)] + e.variance[(2, 2)];
        let closer = |e: &Estimate| slope_variance(e) < slope_variance(&self.plane);
        let by_points = edge.and_then(|e| e.free(self.slope())).filter(closer);
        let free = by_points.unwrap_or(self.plane);
        let square = edge.and_then(Edge::square).unwrap_or(free);
        let scatter = edge.filter(|_| by_points.is_some()).and_then(Edge::scatter);
        let scatter = scatter.unwrap_or(free.variance) + passes;
        let [free, square] = [free, square].map(|e| Estimate { variance: e.variance + passes, ..e });
        let mut lure = Lure { scatter, slopes: Vec::new() };
        let both = square::weigh(&free, &square, &lure);
        if by_points.is_none() || both.square_share > MAYBE_SQUARE {
            return Fine { free, both };
        }
        lure.slopes = edge.map_or_else(Vec::new, |e| e.lured(&free));
        Fine { free, both: square::weigh(&free, &square, &lure) }
    }

    fn slope(&self) -> [f64; 2] {
        [self.plane.value.y, self.plane.value.z]
    }

    /// Share of the sectors that stop at the plane.
    fn agreeing(&self, step_mm: f64) -> f64 {
        let value = self.plane.value - Vector3::new(0.0, self.base[0], self.base[1]);
        let agrees = |s: &Sector| biweight((s.begin_mm - s.row.dot(&value)) / (AGREE_STEPS * step_mm));
        self.sectors.iter().map(agrees).sum::<f64>() / self.sectors.len() as f64
    }

    /// The points of the sectors that stop at the plane.
    fn edge(&self, rim: &Rim) -> Option<Edge> {
        let mut from = vec![f64::INFINITY; rim.count];
        for (sector, _) in self.sectors.iter().zip(&self.weights).filter(|(_, w)| **w > LEAST_WEIGHT) {
            from[sector.index] = sector.first_mm;
        }
        let own = |p: &&Point3<f64>| p.x < rim.to_mm() && past(p, self.base) >= from[sector_of(p, rim.count)];
        let points = rim.points.iter().filter(own).map(|p| [p.x, p.y, p.z]).collect();
        Edge::new(points, rim.radius_mm, rim.step_mm)
    }
}

fn biweight(share: f64) -> f64 {
    let keep = (1.0 - share * share).max(0.0);
    keep * keep
}
