//! What an end's plane is before it is seen: sawn square, or mitred. Both are held against the outline, and what it
//! leaves open between them is in the sigma.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// A saw that is set square cuts this square: standard deviation of each component of the slope (0.1 degrees).
pub const SAW_SPREAD: f64 = 0.0017;
/// No saw cuts this far from square (16 degrees).
pub const MOST_OBLIQUE: f64 = 0.2867;
/// A mitre's slope, or a poor saw's, may be any up to that: then each component scatters by this (one over the root of 6). A
/// narrower one would claim to know what an outline leaves open.
const MITRE_SPREAD: f64 = 0.408 * MOST_OBLIQUE;
/// Share of the ends that are cut square: there are shops that saw nothing else, and shops that mitre every other end.
const SQUARE_SHARE: f64 = 0.75;
/// So many standard deviations are to hold such a share of where the plane may be: as of a normal distribution, but that three
/// would hold 99.7 %; to have them do so would widen the others to twice what they should be.
const WITHIN: [(f64, f64); 3] = [(1.0, 0.6827), (2.0, 0.9545), (3.0, 0.99)];

/// A plane x = at + slope . (y, z) with its covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Where it meets the axis and its slope along y and z.
    pub value: Vector3<f64>,
    /// Their covariance.
    pub variance: Matrix3<f64>,
}

/// Both expectations together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weighed {
    /// Their mean, each with its share, and the covariance about it.
    pub estimate: Estimate,
    /// This holds 68.3 % of where the plane may meet the axis, or more, twice this 95.4 % and three times this 99 %. The two together
    /// are no normal distribution: its standard deviation would speak for a mitre even where that is all but excluded, and
    /// twice it alone would be silent of one that is not.
    pub sigma_mm: f64,
    /// How likely it is cut square.
    pub square_share: f64,
}

/// How a square edge is estimated freely in the pattern of the scan: stripes that lie nearly along it draw the plane to
/// themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct Lure {
    /// The covariance of such estimates.
    pub scatter: Matrix3<f64>,
    /// Slopes of some of them: most lie close to square, a few on the stripes' slope.
    pub slopes: Vec<Vector2<f64>>,
}

impl Lure {
    /// The likelihood of a slope if the cut is square: as normally distributed, or near one of the slopes.
    fn log_likelihood(&self, free: &Estimate) -> f64 {
        let smooth = log_likelihood(&Estimate { variance: self.scatter, ..*free }, SAW_SPREAD);
        if self.slopes.is_empty() {
            return smooth;
        }
        let near = |slope: &Vector2<f64>| {
            let off = Vector3::new(0.0, slope.x, slope.y);
            log_likelihood(&Estimate { value: free.value - off, ..*free }, SAW_SPREAD).exp()
        };
        let lured = self.slopes.iter().map(near).sum::<f64>() / self.slopes.len() as f64;
        (0.5 * (smooth.exp() + lured)).max(f64::MIN_POSITIVE).ln()
    }
}

/// Weighs a plane that was estimated freely against one that was expected to be square.
pub fn weigh(free: &Estimate, square: &Estimate, lure: &Lure) -> Weighed {
    let mitred = expected(free, MITRE_SPREAD);
    let log_odds = lure.log_likelihood(free) - log_likelihood(free, MITRE_SPREAD)
        + (SQUARE_SHARE / (1.0 - SQUARE_SHARE)).ln();
    let share = 1.0 / (1.0 + (-log_odds).exp());
    let (estimate, sigma_mm) = mixed(square, share, &mitred);
    Weighed { estimate, sigma_mm, square_share: share }
}

impl Weighed {
    /// Where nothing tells which of two is true.
    pub fn or(&self, other: &Weighed) -> Weighed {
        let (estimate, sigma_mm) = mixed(&self.estimate, 0.5, &other.estimate);
        Weighed { estimate, sigma_mm, square_share: 0.5 * (self.square_share + other.square_share) }
    }
}

/// The mean of two planes, one with this share, their covariance about it, and its sigma.
fn mixed(one: &Estimate, share: f64, other: &Estimate) -> (Estimate, f64) {
    let apart = one.value - other.value;
    let estimate = Estimate {
        value: other.value + apart * share,
        variance: one.variance * share
            + other.variance * (1.0 - share)
            + apart * apart.transpose() * (share * (1.0 - share)),
    };
    let parts = [(share, one), (1.0 - share, other)];
    let at_sigmas = |(sigmas, within)| reach_mm(&parts, estimate.value.x, within) / sigmas;
    (estimate, WITHIN.map(at_sigmas).into_iter().fold(0.0, f64::max))
}

/// How far around `about_mm` such a share of several normal distributions lies, each with its own share.
fn reach_mm(parts: &[(f64, &Estimate)], about_mm: f64, share: f64) -> f64 {
    let within = |reach: f64| -> f64 {
        let one = |(share, part): &(f64, &Estimate)| {
            let (off, sigma) = (part.value.x - about_mm, part.variance[(0, 0)].sqrt().max(1e-12));
            share * (below((reach - off) / sigma) - below((-reach - off) / sigma))
        };
        parts.iter().map(one).sum()
    };
    let widest =
        |(_, part): &(f64, &Estimate)| (part.value.x - about_mm).abs() + 3.0 * part.variance[(0, 0)].sqrt();
    let (mut low, mut high) = (0.0, parts.iter().map(widest).fold(0.0, f64::max));
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        *(if within(middle) < share { &mut low } else { &mut high }) = middle;
    }
    high
}

/// Share of a normal distribution below so many standard deviations, to a few ten-thousandths (Hastings' polynomial).
fn below(sigmas: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.33267 * sigmas.abs());
    let tail = (-0.5 * sigmas * sigmas).exp() / std::f64::consts::TAU.sqrt()
        * t
        * (0.436_183_6 + t * (-0.120_167_6 + t * 0.937_298));
    if sigmas > 0.0 { 1.0 - tail } else { tail }
}

/// The plane whose slope is expected within `spread` of square beforehand.
fn expected(free: &Estimate, spread: f64) -> Estimate {
    let gain = open(free, spread)
        .try_inverse()
        .map_or_else(Default::default, |inverse| free.variance.fixed_columns::<2>(1) * inverse);
    let slope = Vector2::new(free.value.y, free.value.z);
    Estimate {
        value: free.value - gain * slope,
        variance: free.variance - gain * free.variance.fixed_rows::<2>(1),
    }
}

/// Covariance of the slope that is seen when it is expected within `spread` of square.
fn open(free: &Estimate, spread: f64) -> Matrix2<f64> {
    free.variance.fixed_view::<2, 2>(1, 1) + Matrix2::identity() * (spread * spread)
}

/// Of the slope that is seen; without the constant that all expectations share.
fn log_likelihood(free: &Estimate, spread: f64) -> f64 {
    let open = open(free, spread);
    let slope = Vector2::new(free.value.y, free.value.z);
    let Some(inverse) = open.try_inverse() else { return 0.0 };
    -0.5 * (slope.dot(&(inverse * slope)) + open.determinant().ln())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plane(at: f64, slope: f64, sigmas: [f64; 2]) -> Estimate {
        let [at_sigma, slope_sigma] = sigmas.map(|s| s * s);
        let variance = Matrix3::from_diagonal(&Vector3::new(at_sigma, slope_sigma, slope_sigma));
        Estimate { value: Vector3::new(at, slope, 0.0), variance }
    }

    fn weighed(free: Estimate, square: Estimate) -> Weighed {
        weigh(&free, &square, &Lure { scatter: free.variance, slopes: Vec::new() })
    }

    #[test]
    fn what_looks_square_is_taken_for_square() {
        let both = weighed(plane(5.3, 0.01, [0.3, 0.01]), plane(5.0, 0.0, [0.05, SAW_SPREAD]));
        assert!(both.square_share > 0.98 && (both.estimate.value.x - 5.0).abs() < 0.02, "{both:?}");
        // Three sigmas reach into the mitres that are left: 2 % of all.
        assert!((0.05..0.2).contains(&both.sigma_mm), "{both:?}");
    }

    #[test]
    fn a_mitre_is_taken_for_one() {
        let both = weighed(plane(5.3, 0.1, [0.3, 0.01]), plane(5.0, 0.0, [0.05, SAW_SPREAD]));
        assert!(both.square_share < 0.01 && (both.estimate.value.x - 5.3).abs() < 0.02, "{both:?}");
        assert!((both.sigma_mm - 0.3).abs() < 0.01, "{both:?}");
        assert!((both.estimate.value.y - 0.1).abs() < 0.003, "{both:?}");
    }

    #[test]
    fn what_may_be_either_is_uncertain_by_what_lies_between() {
        // Three sigmas from square is rare of a square cut, and mitres are rare.
        let both = weighed(plane(6.0, 0.06, [0.1, 0.02]), plane(5.0, 0.0, [0.05, SAW_SPREAD]));
        assert!((0.4..0.9).contains(&both.square_share), "{both:?}");
        assert!(both.sigma_mm > 0.3, "{both:?}");
    }

    #[test]
    fn a_slope_that_square_edges_show_too_is_no_mitre() {
        let (free, square) = (plane(5.3, 0.06, [0.3, 0.01]), plane(5.0, 0.0, [0.05, SAW_SPREAD]));
        assert!(weighed(free, square).square_share < 0.1);
        let scatter = Matrix3::from_diagonal(&Vector3::new(0.1, 2e-3, 2e-3));
        let lure = Lure { scatter, slopes: Vec::new() };
        assert!(weigh(&free, &square, &lure).square_share > 0.7);
    }

    #[test]
    fn a_slope_that_one_square_edge_in_fifty_shows_is_likelier_than_a_steep_mitre() {
        let (free, square) = (plane(5.3, 0.2, [0.3, 0.015]), plane(5.0, 0.0, [0.05, SAW_SPREAD]));
        let scatter = Matrix3::from_diagonal(&Vector3::new(0.1, 1e-3, 1e-3));
        let mut lure = Lure { scatter, slopes: vec![Vector2::new(0.01, -0.02); 49] };
        assert!(weigh(&free, &square, &lure).square_share < 0.1);
        lure.slopes.push(Vector2::new(0.18, 0.01));
        assert!(weigh(&free, &square, &lure).square_share > 0.7);
    }

    #[test]
    fn the_polynomial_is_the_normal_distribution() {
        for (sigmas, share) in [(0.0, 0.5), (1.0, 0.841_345), (2.0, 0.977_250), (-1.0, 0.158_655), (9.0, 1.0)]
        {
            assert!((below(sigmas) - share).abs() < 1e-4, "{sigmas}");
        }
    }
}
