//! One short stretch of the tube: the sums over its points, the five values that they determine, and how the tube is cut
//! into such stretches.
//!
//! Under `sections` (the search's measured centre line) and `stretches` (what the last fit's residuals share).

use nalgebra::{Cholesky, Matrix5, SMatrix, Vector3, Vector5};

use super::model::TubeModel;
use crate::tube::Spine;

/// Values of a section: radius, place along the first and second direction across, ovality along them and between.
pub const VALUES: usize = 5;

/// Weighted sums of the products of the values' derivatives and of the residual.
pub type Sums = SMatrix<f64, 6, 6>;

/// The five values of a section.
pub type Values = Vector5<f64>;

/// Length of a section in tube radii, and how many points it should hold.
const SECTION_RADII: f64 = 0.5;
const ENOUGH_POINTS: f64 = 15.0;
/// Sections are no longer than this, however few the points.
const LONGEST_RADII: f64 = 2.0;

/// What is expected of the values before anything is measured, in tube radii.
pub const SPREADS: [f64; VALUES] = [0.01, 0.3, 0.3, 0.02, 0.02];
/// How far a section's ovality may differ from the model's, in tube radii; beside the tangent points, where it grows in
/// some way or other, also this share of the bend's; and how far beside.
pub const OVAL_DOUBT: f64 = 1e-5;
/// See [`OVAL_DOUBT`].
pub const OVAL_DOUBT_SHARE: f64 = 0.15;
const OVAL_DOUBT_RADII: f64 = 1.2;
/// How oval a bend may be that is too short to tell, in tube radii; sections that lie on it hardly reach beyond it by this.
pub const OVAL_UNTOLD: f64 = 0.02;
const OVAL_UNTOLD_RADII: f64 = 0.25;

/// Fewest points that judge a section, and the median of chi-squared with five degrees of freedom.
pub const JUDGED_POINTS: f64 = 8.0;
pub const MEDIAN_CHI2: f64 = 4.351;

/// Cost of values: sum of the squared residuals that they leave.
pub fn cost(sums: &Sums, values: &Values) -> f64 {
    let square = sums.fixed_view::<VALUES, VALUES>(0, 0);
    let mixed = sums.fixed_view::<VALUES, 1>(0, VALUES);
    sums[(VALUES, VALUES)] - 2.0 * mixed.dot(values) + (square * values).dot(values)
}

/// The values that fit best, held by what is expected where the points do not tell.
pub fn solve(sums: &Sums, spreads_mm: &[f64; VALUES], noise_mm: f64) -> Values {
    let mut square: Matrix5<f64> = sums.fixed_view::<VALUES, VALUES>(0, 0).into_owned();
    for (k, spread) in spreads_mm.iter().enumerate() {
        square[(k, k)] += (noise_mm / spread).powi(2);
    }
    let mixed: Values = sums.fixed_view::<VALUES, 1>(0, VALUES).into_owned();
    Cholesky::new(square).map_or(Values::zeros(), |c| c.solve(&mixed))
}

/// Lets the section's ovality differ from the model's by as much as `stiffness` (noise over spread) allows: the sums with
/// that difference eliminated.
pub fn doubt_ovality(sums: &mut Sums, stiffness: f64) {
    let free: SMatrix<f64, 2, 2> =
        sums.fixed_view::<2, 2>(3, 3) + SMatrix::identity() * (stiffness * stiffness);
    let rows: SMatrix<f64, 2, 6> = sums.fixed_view::<2, 6>(3, 0).into_owned();
    if let Some(inverse) = free.try_inverse() {
        *sums -= rows.transpose() * (inverse * rows);
    }
}

/// Spread of a section's ovality about the model's at a place of the base tube.
pub fn oval_doubt_mm(base: &TubeModel, spine: &Spine, at_mm: f64) -> f64 {
    let radius = base.tube_radius_mm;
    let beside = |(i, e): (usize, &f64)| {
        let arc = &spine.segments()[2 * i + 1];
        let (from, to) = (arc.start_mm, arc.start_mm + arc.length_mm);
        if !base.may_be_oval(i) {
            let reach = OVAL_UNTOLD_RADII * radius;
            return if (from - reach..=to + reach).contains(&at_mm) { OVAL_UNTOLD * radius } else { 0.0 };
        }
        let near = |tangent_mm: f64| (at_mm - tangent_mm).abs() < OVAL_DOUBT_RADII * radius;
        if near(from) || near(to) { OVAL_DOUBT_SHARE * e.abs() } else { 0.0 }
    };
    let most = base.ovality_mm.iter().enumerate().map(beside).fold(0.0, f64::max);
    most.hypot(OVAL_DOUBT * radius)
}

/// How many neighbouring sections say one thing, from the shifts across the tube by which they lie off the model, in order: 1
/// when each lies off to a side of its own. One and twice the correlations (the variance of a mean of a stationary
/// series over that of independent values) of sections up to `farthest` apart, each from how often two such
/// sections lie off to the same side, so that a local misfit counts little; as far as they stand out of chance.
pub fn persistence(offs: &[Vector3<f64>], farthest: usize) -> f64 {
    let mut out = 1.0;
    for apart in 1..=farthest.min(offs.len() / 4) {
        let pairs = (offs.len() - apart) as f64;
        let alike = (0..offs.len() - apart).filter(|&i| offs[i].dot(&offs[i + apart]) > 0.0).count();
        // Of two normal values with that correlation.
        let follows = (std::f64::consts::PI * (alike as f64 / pairs - 0.5)).sin();
        if follows < std::f64::consts::FRAC_PI_2 / pairs.sqrt() {
            break;
        }
        out += 2.0 * follows;
    }
    out
}

/// How the segments are cut into sections.
pub struct Bins {
    /// First section of every segment, how many there are, where the segment begins, and its length.
    segments: Vec<(usize, usize, f64, f64)>,
    /// Sections of the whole tube.
    pub total: usize,
    /// How long a section is at most.
    pub length_mm: f64,
}

/// Of so many points along a tube, every how many-th still fills sections of the least length.
pub fn filling(points: usize, radius_mm: f64, length_mm: f64) -> usize {
    let per_radius = points as f64 * radius_mm / length_mm.max(1e-9);
    ((per_radius * SECTION_RADII / ENOUGH_POINTS) as usize).max(1)
}

impl Bins {
    /// Sections that hold enough of `points` points.
    pub fn new(spine: &Spine, radius_mm: f64, points: usize) -> Bins {
        let per_radius = points as f64 * radius_mm / spine.length_mm().max(1e-9);
        let length_mm = (ENOUGH_POINTS / per_radius).clamp(SECTION_RADII, LONGEST_RADII) * radius_mm;
        let mut bins = Bins { segments: Vec::new(), total: 0, length_mm };
        for segment in spine.segments() {
            let count = (segment.length_mm / length_mm).ceil().max(1.0) as usize;
            bins.segments.push((bins.total, count, segment.start_mm, segment.length_mm));
            bins.total += count;
        }
        bins
    }

    /// The section at a share of a segment's length.
    pub fn of(&self, segment: usize, share: f64) -> usize {
        let (first, count, ..) = self.segments[segment];
        first + ((share.clamp(0.0, 1.0) * count as f64) as usize).min(count - 1)
    }

    /// The segment of every section.
    pub fn places(&self) -> impl Iterator<Item = usize> + '_ {
        self.segments.iter().enumerate().flat_map(|(k, &(_, count, ..))| (0..count).map(move |_| k))
    }

    /// The middle of every section: arc length.
    pub fn places_mm(&self) -> impl Iterator<Item = f64> + '_ {
        self.segments.iter().flat_map(|&(_, count, start_mm, length_mm)| {
            (0..count).map(move |i| start_mm + (i as f64 + 0.5) / count as f64 * length_mm)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    /// A long series of shifts, each following the one before by `follows` (0 to 1).
    fn series(follows: f64) -> Vec<Vector3<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let fresh = (1.0 - follows * follows).sqrt();
        let mut at = 0.0;
        let mut step = || {
            at = follows * at + fresh * rng.sample::<f64, _>(StandardNormal);
            Vector3::new(0.0, at, 0.0)
        };
        (0..20_000).map(|_| step()).collect()
    }

    #[test]
    fn shifts_that_follow_each_other_count_as_one() {
        assert!((persistence(&series(0.0), 4) - 1.0).abs() < 0.05);
        for follows in [0.3_f64, 0.6, 0.8] {
            let expected = 1.0 + 2.0 * (1..=4).map(|k| follows.powi(k)).sum::<f64>();
            assert!((persistence(&series(follows), 4) / expected - 1.0).abs() < 0.1, "{follows}");
        }
        assert_eq!(persistence(&[], 4), 1.0);
    }
}
