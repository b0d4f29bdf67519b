//! Where the tube's outside stops: the outline of the scanned points at an end, sector by sector around the tube.
//!
//! The first points of a sector fall short of the edge by up to a step of the scan's pattern. How much, and how alike
//! in all sectors, depends on how the stripes run; so the pattern itself is asked: the same points are cut at known
//! places further inside, the same estimate is made there, and its mean error is the correction, its scatter the sigma.

use nalgebra::{Matrix3, Point3, Vector3};

use super::radius::median;

/// Sectors around the tube: not narrower than this many steps of the pattern.
const SECTOR_STEPS: f64 = 1.5;
const MOST_SECTORS: f64 = 36.0;
const FEWEST_SECTORS: f64 = 8.0;

/// How far from the end the pattern is looked at, in tube radii.
const REACH_RADII: f64 = 6.0;

/// Fewest points of a sector and fewest sectors.
const MIN_POINTS: usize = 4;
const MIN_SECTORS: usize = 3;

/// A sawn end is this square: standard deviation of each component of its slope (2.5 degrees).
const SQUARE_SPREAD: f64 = 0.0437;

/// The outline's own slope before anything is expected of it (45 degrees).
const LOOSE_SPREAD: f64 = 1.0;

/// Cuts at known places.
const CUTS: usize = 96;

/// What the cuts teach is uncertain as if from this many layers of points less.
const LEARNING: f64 = 5.0;

/// Cut-off of the biweight over sectors, in standard deviations of one sector.
const CUTOFF_SECTORS: f64 = 5.0;

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

/// One sector: its points along the tube (past the plane's slope), in order.
struct Sector {
    /// Of the plane: 1, y, z at the sector's middle.
    row: Vector3<f64>,
    along: Vec<f64>,
    /// Sums of `along` up to each point.
    sums: Vec<f64>,
    /// Points per millimetre, and how many make the first layer.
    per_mm: f64,
    layer: usize,
}

impl Sector {
    /// Where the sector begins if nothing before `from` were known: mean of its first layer less half the layer.
    fn begins(&self, from: f64) -> Option<f64> {
        let i = self.along.partition_point(|u| *u < from);
        let k = i + self.layer;
        (k < self.sums.len()).then(|| {
            (self.sums[k] - self.sums[i]) / self.layer as f64 - 0.5 * self.layer as f64 / self.per_mm
        })
    }
}

/// Finds the outline at the beginning of points of the tube's outside, in a frame whose x axis is the tube's and leads
/// into it. None when too little was scanned there.
pub fn find(points: &[Point3<f64>], radius_mm: f64, noise_mm: f64) -> Option<Outline> {
    let mut along: Vec<f64> = points.iter().map(|p| p.x).collect();
    along.sort_by(f64::total_cmp);
    let first = solid_start(&along, 2.0 * radius_mm)?;
    let step = step_mm(points, first, radius_mm)?;
    let mut slope = [0.0, 0.0];
    let mut loose_at_mm = first;
    // The slope first, by the data alone; then all again along it.
    for _ in 0..3 {
        let sectors = sectors(points, &slope, first, radius_mm, step, noise_mm);
        let value = Plane::loose(&sectors, radius_mm)?;
        slope = [slope[0] + value.y, slope[1] + value.z];
        loose_at_mm = value.x;
    }
    let loose_slope = slope;
    let size = slope[0].hypot(slope[1]);
    // Cuts are made along the slope that is expected of a sawn end.
    let shrink = if size > 2.0 * SQUARE_SPREAD { 2.0 * SQUARE_SPREAD / size } else { 1.0 };
    let base = [slope[0] * shrink, slope[1] * shrink];
    let sectors = sectors(points, &base, first, radius_mm, step, noise_mm);
    let plane = Plane::fit(&sectors, base, step)?;
    Some(Outline {
        at_mm: plane.value.x,
        sigma_mm: plane.variance[(0, 0)].sqrt(),
        slope: [base[0] + plane.value.y, base[1] + plane.value.z],
        slope_variance: [plane.variance[(1, 1)], plane.variance[(1, 2)], plane.variance[(2, 2)]],
        loose_at_mm,
        loose_slope,
        loose_sigma: plane.loose_sigma(&loose_slope),
        step_mm: step,
        agreeing: plane.agreeing,
    })
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

fn sectors(
    points: &[Point3<f64>],
    slope: &[f64; 2],
    first: f64,
    radius_mm: f64,
    step: f64,
    noise_mm: f64,
) -> Vec<Sector> {
    let around = std::f64::consts::TAU * radius_mm;
    let count = (around / (SECTOR_STEPS * step)).clamp(FEWEST_SECTORS, MOST_SECTORS) as usize;
    let mut along: Vec<Vec<f64>> = vec![Vec::new(); count];
    // A slope of 45 degrees begins a radius before the axis does.
    let (from, to) = (first - 1.5 * radius_mm, first + REACH_RADII * radius_mm);
    for p in points {
        let u = p.x - slope[0] * p.y - slope[1] * p.z;
        if u >= from && u < to {
            along[sector_of(p, count)].push(u);
        }
    }
    let depth = step.max(3.0 * noise_mm);
    let seen = along.into_iter().enumerate().filter(|(_, a)| a.len() >= MIN_POINTS);
    seen.filter_map(|(i, mut along)| {
        along.sort_by(f64::total_cmp);
        let begin = solid_start(&along, 2.0 * radius_mm)?;
        along.drain(..along.partition_point(|u| *u < begin));
        let per_mm = (along.len() - 1) as f64 / (along[along.len() - 1] - along[0]).max(1e-9);
        let turn = ((i as f64 + 0.5) / count as f64 - 0.5) * std::f64::consts::TAU;
        let mut sums = vec![0.0];
        along.iter().for_each(|u| sums.push(sums[sums.len() - 1] + u));
        let layer = ((per_mm * depth).round() as usize).clamp(1, along.len());
        let row = Vector3::new(1.0, radius_mm * turn.cos(), radius_mm * turn.sin());
        (along.len() >= MIN_POINTS).then_some(Sector { row, along, sums, per_mm, layer })
    })
    .collect()
}

/// How far one sector's beginning errs.
#[derive(Debug, Clone, Copy)]
struct Scatter {
    /// Mean at the known cuts.
    bias_mm: f64,
    /// Standard deviation there.
    sigma_mm: f64,
    /// None begins earlier than this before the others: a burr does.
    early_mm: f64,
}

impl Scatter {
    fn of(errors: &[Vec<f64>], step: f64) -> Scatter {
        let mut all: Vec<f64> = errors.iter().flatten().copied().collect();
        if all.is_empty() {
            return Scatter { bias_mm: 0.0, sigma_mm: 0.4 * step, early_mm: step };
        }
        let n = all.len() as f64;
        let bias_mm = all.iter().sum::<f64>() / n;
        let variance = all.iter().map(|e| (e - bias_mm).powi(2)).sum::<f64>() / n;
        let sigma_mm = variance.sqrt().max(1e-6 * step);
        all.sort_by(f64::total_cmp);
        let early_mm = (bias_mm - all[all.len() / 200]).max(sigma_mm);
        Scatter { bias_mm, sigma_mm, early_mm }
    }

    /// Weight of a sector that begins `off_mm` after the plane.
    fn weight(&self, off_mm: f64) -> f64 {
        if off_mm < 0.0 {
            biweight((-off_mm - self.early_mm).max(0.0) / (0.5 * self.early_mm))
        } else {
            biweight(off_mm / (CUTOFF_SECTORS * self.sigma_mm))
        }
    }
}

/// A plane fitted to the sectors' beginnings.
struct Plane {
    value: Vector3<f64>,
    variance: Matrix3<f64>,
    /// Of the plane by the data alone.
    loose: Matrix3<f64>,
    agreeing: f64,
}

/// Weighted least squares with the slope expected near 0: the estimate is `operator` times the sectors' values.
struct Solver {
    inverse: Matrix3<f64>,
    rows: Vec<(Vector3<f64>, f64)>,
}

impl Solver {
    /// `variance` of one sector's value against `spread` of the slope decides how far the slope is drawn to 0.
    fn new(rows: Vec<(Vector3<f64>, f64)>, variance: f64, spread: f64) -> Option<Solver> {
        let own: Matrix3<f64> = rows.iter().map(|(r, w)| r * r.transpose() * *w).sum();
        let prior = variance / (spread * spread);
        let normal = own + Matrix3::from_diagonal(&Vector3::new(0.0, prior, prior));
        Some(Solver { inverse: normal.try_inverse()?, rows })
    }

    /// The plane that most values agree on, with one value's standard deviation known: weights and solver.
    fn robust(
        rows: &[Vector3<f64>],
        values: &[f64],
        scatter: &Scatter,
        variance: f64,
    ) -> Option<(Solver, Vector3<f64>)> {
        let mut weights = vec![1.0; rows.len()];
        let mut best = None;
        for _ in 0..6 {
            let weighted = rows.iter().copied().zip(weights.iter().copied()).collect();
            let solver = Solver::new(weighted, variance, SQUARE_SPREAD)?;
            let value = solver.solve(values.iter().copied());
            for ((w, row), v) in weights.iter_mut().zip(rows).zip(values) {
                *w = scatter.weight(v - row.dot(&value));
            }
            best = Some((solver, value));
        }
        best
    }

    /// Mean and covariance of its errors where no cut can be made: as if the sectors erred alike.
    fn unknown(&self, sector: f64) -> (Vector3<f64>, Matrix3<f64>) {
        let n = self.rows.iter().map(|r| r.1).sum::<f64>();
        (Vector3::zeros(), self.inverse * (sector * sector * n.sqrt()))
    }

    fn solve(&self, values: impl Iterator<Item = f64>) -> Vector3<f64> {
        let sum: Vector3<f64> = self.rows.iter().zip(values).map(|((r, w), v)| r * (w * v)).sum();
        self.inverse * sum
    }

    /// Covariance that the expectation of the slope leaves: what is drawn to 0 may not be 0.
    fn left_open(&self, spread: f64) -> Matrix3<f64> {
        let own: Matrix3<f64> = self.rows.iter().map(|(r, w)| r * r.transpose() * *w).sum();
        let missed = Matrix3::identity() - self.inverse * own;
        let prior = Matrix3::from_diagonal(&Vector3::new(0.0, spread * spread, spread * spread));
        missed * prior * missed.transpose()
    }
}

impl Plane {
    /// Standard deviation of a slope by the data alone, along itself.
    fn loose_sigma(&self, slope: &[f64; 2]) -> f64 {
        let along = Vector3::new(0.0, slope[0], slope[1]).try_normalize(1e-12).unwrap_or_default();
        along.dot(&(self.loose * along)).max(0.0).sqrt()
    }

    /// The plane by the data alone.
    fn loose(sectors: &[Sector], radius_mm: f64) -> Option<Vector3<f64>> {
        if sectors.len() < MIN_SECTORS {
            return None;
        }
        let begins: Vec<f64> = sectors.iter().filter_map(|s| s.begins(f64::NEG_INFINITY)).collect();
        let mut value = Vector3::new(median(&mut begins.clone())?, 0.0, 0.0);
        for _ in 0..12 {
            let off: Vec<f64> = sectors.iter().zip(&begins).map(|(s, b)| b - s.row.dot(&value)).collect();
            let mut sizes: Vec<f64> = off.iter().map(|r| r.abs()).collect();
            let scale = (1.4826 * median(&mut sizes)?).max(1e-6 * radius_mm);
            let weigh = |r: f64| biweight(r / (CUTOFF_SECTORS * scale));
            let rows = sectors.iter().zip(&off).map(|(s, r)| (s.row, weigh(*r))).collect();
            let solver = Solver::new(rows, scale * scale, LOOSE_SPREAD)?;
            value = solver.solve(begins.iter().copied());
        }
        Some(value)
    }

    /// The plane along which the sectors begin, corrected and weighed by what cuts at known places say.
    fn fit(sectors: &[Sector], base: [f64; 2], step: f64) -> Option<Plane> {
        let begins: Vec<f64> = sectors.iter().filter_map(|s| s.begins(f64::NEG_INFINITY)).collect();
        if begins.len() < MIN_SECTORS || begins.len() < sectors.len() {
            return None;
        }
        let middle = median(&mut begins.clone())?;
        let errors = known_errors(sectors, middle, step);
        let one = Scatter::of(&errors, step);
        let (bias, sector) = (one.bias_mm, one.sigma_mm);
        // What is learned from few layers of the pattern is itself uncertain.
        let few = 1.0 + LEARNING / (errors.len() as f64 / CUTS as f64 * layers(sectors, step)).max(1.0);
        let own = Vector3::new(0.0, base[0], base[1]);
        // The data says base; the expectation draws the slope from there to 0.
        let centred: Vec<f64> = begins.iter().zip(sectors).map(|(b, s)| b - bias + s.row.dot(&own)).collect();
        let rows: Vec<Vector3<f64>> = sectors.iter().map(|s| s.row).collect();
        // As much of the expectation as makes the whole variance least.
        let candidates = [0.25, 1.0, 4.0, 16.0, 64.0].into_iter().filter_map(|share| {
            let variance = share * sector * sector;
            let (solver, value) = Solver::robust(&rows, &centred, &one, variance)?;
            let at_cuts = |e: &Vec<f64>| {
                let off: Vec<f64> = e.iter().map(|e| e - bias).collect();
                Some(Solver::robust(&rows, &off, &one, variance)?.1)
            };
            let known: Vec<Vector3<f64>> = errors.iter().filter_map(at_cuts).collect();
            let (mean, spread) = moments(&known).unwrap_or_else(|| solver.unknown(sector));
            Some((value - mean, spread * few + solver.left_open(SQUARE_SPREAD), solver))
        });
        let (value, variance, solver) = candidates.min_by(|a, b| a.1[(0, 0)].total_cmp(&b.1[(0, 0)]))?;
        let free = Solver::new(rows.iter().map(|r| (*r, 1.0)).collect(), sector * sector, LOOSE_SPREAD)?;
        let known: Vec<Vector3<f64>> =
            errors.iter().map(|e| free.solve(e.iter().map(|e| e - bias))).collect();
        let (_, loose) = moments(&known).unwrap_or_else(|| free.unknown(sector));
        let agreeing = solver.rows.iter().map(|r| r.1).sum::<f64>() / rows.len() as f64;
        Some(Plane { value: value - own, variance, loose, agreeing })
    }
}

fn biweight(share: f64) -> f64 {
    let keep = (1.0 - share * share).max(0.0);
    keep * keep
}

/// Layers of points along the sectors.
fn layers(sectors: &[Sector], step: f64) -> f64 {
    let mut spans: Vec<f64> = sectors.iter().map(|s| s.along[s.along.len() - 1] - s.along[0]).collect();
    median(&mut spans).map_or(0.0, |span| span / step)
}

/// Errors of all sectors' beginnings at cuts further inside, one row per cut.
fn known_errors(sectors: &[Sector], begin: f64, step: f64) -> Vec<Vec<f64>> {
    let mut lasts: Vec<f64> = sectors.iter().map(|s| s.along[s.along.len() - 1]).collect();
    let (Some(last), from) = (median(&mut lasts), begin + step) else { return Vec::new() };
    let to = last - 3.0 * step;
    if to < from + 2.0 * step {
        return Vec::new();
    }
    let at = |k: usize| from + (to - from) * (k as f64 + 0.5) / CUTS as f64;
    let row = |cut: f64| -> Vec<f64> {
        sectors.iter().map(|s| s.begins(cut).map_or(0.0, |b| (b - cut).min(4.0 * step))).collect()
    };
    (0..CUTS).map(|k| row(at(k))).collect()
}

/// Mean and covariance; None of nothing.
fn moments(values: &[Vector3<f64>]) -> Option<(Vector3<f64>, Matrix3<f64>)> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<Vector3<f64>>() / n;
    let spread = values.iter().map(|o| (o - mean) * (o - mean).transpose()).sum::<Matrix3<f64>>() / n;
    (n > 0.0).then_some((mean, spread))
}
