//! How far the passes of a scan disagree, from what they leave of it on the end straights.
//!
//! Where only some of the passes saw an end, it lies where those put it, not where all together put the tube; no fit to
//! that end's own points can tell. But the passes also disagree across the tube, and there it shows: seen from
//! different sides, the surface lies off the fitted cylinder, here out and there in.

use nalgebra::Point3;

/// Places of a straight: so many around it, and along it one per radius.
const SECTORS: usize = 24;
const MOST_SLABS: usize = 40;
/// A place with fewer points says nothing.
const MIN_POINTS: f64 = 4.0;
/// Points farther off than this are not of the surface, in standard deviations of the noise.
const SURFACE_SIGMAS: f64 = 4.0;
/// The fitted cylinder goes half the way with a pass: so much more than what is left of a displacement it was.
const ALONG_PER_ACROSS: f64 = 2.0;

/// Points, sum and sum of squares of their distances from the surface.
type Place = (f64, f64, f64);

/// Standard deviation of a pass's displacement along the tube. Each of `ends` holds points in a frame whose x axis is
/// the tube's.
pub fn disagreement_mm(ends: [&[Point3<f64>]; 2], radius_mm: f64, noise_mm: f64) -> f64 {
    let places: Vec<Place> = ends.iter().flat_map(|points| places(points, radius_mm, noise_mm)).collect();
    let told = || places.iter().filter(|p| p.0 >= MIN_POINTS);
    let (within, freedom) = told().fold((0.0, 0.0), |(squares, freedom), (n, sum, square)| {
        (squares + square - sum * sum / n, freedom + n - 1.0)
    });
    let own = within / f64::max(freedom, 1.0);
    let (shared, count) = told().fold((0.0, 0.0), |(squares, count), (n, sum, _)| {
        (squares + (sum / n).powi(2) - own / n, count + 1.0)
    });
    ALONG_PER_ACROSS * f64::max(shared / f64::max(count, 1.0), 0.0).sqrt()
}

fn places(points: &[Point3<f64>], radius_mm: f64, noise_mm: f64) -> Vec<Place> {
    let first = points.iter().map(|p| p.x).fold(f64::INFINITY, f64::min);
    let mut places = vec![(0.0, 0.0, 0.0); SECTORS * MOST_SLABS];
    for p in points {
        let off = p.y.hypot(p.z) - radius_mm;
        let slab = ((p.x - first) / radius_mm) as usize;
        if off.abs() < SURFACE_SIGMAS * noise_mm && slab < MOST_SLABS {
            let turn = p.z.atan2(p.y) / std::f64::consts::TAU + 0.5;
            let place = &mut places[slab * SECTORS + ((turn * SECTORS as f64) as usize).min(SECTORS - 1)];
            *place = (place.0 + 1.0, place.1 + off, place.2 + off * off);
        }
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    const RADIUS: f64 = 10.0;
    const NOISE: f64 = 0.03;

    /// The upper and the lower half of 100 mm of tube, the upper one displaced across the tube.
    fn two_passes(sideways_mm: f64) -> Vec<Point3<f64>> {
        let point = |i: i32| {
            let i = f64::from(i);
            let turn = std::f64::consts::TAU * (0.618_034 * i).fract();
            let r = RADIUS + NOISE * 1.4 * (2.3 * i).sin();
            let shift = if turn < std::f64::consts::PI { 0.5 } else { -0.5 };
            Point3::new((0.7549 * i).fract() * 100.0, r * turn.cos() + shift * sideways_mm, r * turn.sin())
        };
        (0..6000).map(point).collect()
    }

    #[test]
    fn passes_that_agree_leave_next_to_nothing() {
        let points = two_passes(0.0);
        assert!(disagreement_mm([&points, &points], RADIUS, NOISE) < 0.2 * NOISE);
        assert_eq!(disagreement_mm([&[], &[]], RADIUS, NOISE), 0.0);
    }

    #[test]
    fn what_passes_disagree_by_shows_as_much_as_it_is() {
        for sideways in [0.03, 0.06, 0.09] {
            let points = two_passes(sideways);
            let found = disagreement_mm([&points, &[]], RADIUS, NOISE);
            assert!((0.5..1.2).contains(&(found / sideways)), "{found} of {sideways}");
        }
    }
}
