//! Where the tube ends: the surface knows the end straights' axes but not their ends, the scanned extent does.
//!
//! Best is the end face itself ([`face`]); else the outside's outline ([`outline`]). An outline that is far from square
//! or that the sectors around the tube do not agree on is no tube's end but the scan's, and the length stays unknown.

use nalgebra::Point3;

use super::face::{self, Face, Search};
use super::outline::{self, Outline};
use super::square::MOST_OBLIQUE;

/// Faces steeper than a saw that is set square leaves them (7 degrees) are looked for only where the outline is that
/// oblique too.
const STEEPEST_FACES: [f64; 2] = [0.1228, MOST_OBLIQUE];
/// A cut angle less certain than this is not given.
const MAX_CUT_SIGMA_RAD: f64 = std::f64::consts::PI / 180.0;
/// Share of the sectors around the tube that must end together.
const LEAST_AGREEING: f64 = 0.6;
/// The same where the end is not square: a jaw whose shadow takes a third of a square end makes a mitre of it.
const LEAST_AGREEING_MITRED: f64 = 0.75;
/// Points this far from the outside, in standard deviations of noise and passes, show where it stops. Few are within it, where
/// the face's rim would pile up.
const OUTSIDE_SIGMAS: std::ops::Range<f64> = -1.0..3.5;
/// An outline is no sharper than this share of the noise: the rim of a face that does not show by itself blurs it.
const RIM_SIGMAS: f64 = 0.3;
/// So many points, and such a share of those before it, within a tube radius from so far beyond the outline are the tube's.
const FEWEST_BEYOND: usize = 8;
const SHARE_BEYOND: f64 = 0.04;
const BEYOND_RADII: f64 = 0.15;
/// An outline more oblique than any saw's by so many standard deviations is the shadow of another leg, or where the scan
/// stops: these come as often as a saw that is set to its last degree.
const OBLIQUE_SIGMAS: f64 = 1.5;
/// Fewest points of a face that the outline does not lead to.
const LEAST_FACE: usize = 60;
/// What differs by more than this many standard deviations is not the same.
const DIFFERENT_SIGMAS: f64 = 4.0;

/// What the points at an end are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum End {
    /// The tube's end.
    Found(Place),
    /// The scan stops here and the tube goes on: it ends with a slope (angle from square) that no saw leaves.
    CutOff {
        /// Where the scan stops, on the axis.
        at_mm: f64,
        /// Angle of the scan's edge from square.
        slope_rad: f64,
    },
    /// The points stop here and there; which is the tube's end cannot be told.
    Ragged {
        /// Where most of them begin.
        at_mm: f64,
    },
    /// Another leg of the tube hides what may follow.
    Shaded {
        /// Where the points begin.
        at_mm: f64,
    },
}

/// Where the end's plane meets the axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Coordinate along the axis.
    pub at_mm: f64,
    /// Its standard deviation.
    pub sigma_mm: f64,
    /// Angle of the cut from square and its standard deviation, where the scan shows it.
    pub cut_rad: Option<(f64, f64)>,
    /// Whether only the outside's outline was seen, not the end face.
    pub by_outline: bool,
}

impl End {
    /// Where the scanned tube stops.
    pub fn at_mm(&self) -> f64 {
        match self {
            End::Found(place) => place.at_mm,
            End::CutOff { at_mm, .. } | End::Ragged { at_mm } | End::Shaded { at_mm } => *at_mm,
        }
    }
}

/// The end of a tube that lies along +x from it: `points` on and in the tube in a frame whose x axis is the tube's, of
/// whose outside they scatter by `noise_mm`. None when too little was scanned there.
pub fn find(mut points: Vec<Point3<f64>>, radius_mm: f64, noise_mm: f64, passes_mm: f64) -> Option<End> {
    let inner: Vec<Point3<f64>> =
        points.iter().filter(|p| face::may_hold(p, radius_mm, noise_mm)).copied().collect();
    // Nearly all of the points, so they are not copied.
    let scatter_mm = noise_mm.hypot(passes_mm);
    points.retain(|p| OUTSIDE_SIGMAS.contains(&((p.y.hypot(p.z) - radius_mm) / scatter_mm)));
    let surface = points;
    let outline = outline::find(&surface, radius_mm, noise_mm, passes_mm)?;
    let near_mm = DIFFERENT_SIGMAS * outline.sigma_mm + outline.step_mm.max(3.0 * noise_mm);
    let oblique = outline.loose_size() - DIFFERENT_SIGMAS * outline.loose_sigma > 0.5 * STEEPEST_FACES[0];
    let about =
        if oblique { (outline.loose_at_mm, outline.loose_slope) } else { (outline.at_mm, outline.slope) };
    let steepest = STEEPEST_FACES[usize::from(oblique)];
    let near = Search { about_mm: about.0, near_mm, steepest };
    let same = |f: &Face| {
        let room = near_mm / radius_mm;
        let off = |k: usize, v: f64| {
            let sigma = (v + f.covariance[(k + 1, k + 1)]).sqrt();
            (f.slope[k] - about.1[k]).abs() < DIFFERENT_SIGMAS * sigma + 0.5 * room
        };
        off(0, outline.slope_variance[0]) && off(1, outline.slope_variance[2])
    };
    // An outline of which half is hidden may be far off; a face that is seen all around and has nothing before it is the end.
    let anywhere = Search {
        about_mm: outline.at_mm,
        near_mm: near_mm + MOST_OBLIQUE * radius_mm,
        steepest: MOST_OBLIQUE,
    };
    let is_last =
        |f: &Face| f.points >= LEAST_FACE && !goes_on(&surface, (f.at_mm, f.slope), radius_mm, near_mm);
    let look = |search: &Search| face::find(&inner, radius_mm, noise_mm, search);
    let face = look(&near).filter(same).or_else(|| look(&anywhere).filter(is_last));
    if let Some(face) = face {
        let sigma_mm = face.covariance[(0, 0)].sqrt();
        if sigma_mm < outline.sigma_mm {
            let variance = [face.covariance[(1, 1)], face.covariance[(1, 2)], face.covariance[(2, 2)]];
            let cut_rad = cut(&face.slope, &variance);
            let sigma_mm = sigma_mm.hypot(passes_mm);
            return Some(End::Found(Place { at_mm: face.at_mm, sigma_mm, cut_rad, by_outline: false }));
        }
    }
    if goes_on(&surface, (outline.at_mm, outline.slope), radius_mm, near_mm) {
        return Some(End::Ragged { at_mm: outline.at_mm });
    }
    Some(by_outline(&outline, noise_mm))
}

/// Whether the outside goes on past a plane (where on the axis, slope) somewhere: an outline is then that of a jaw that hides
/// the rest, or of a patch that was not scanned.
fn goes_on(surface: &[Point3<f64>], (at_mm, slope): (f64, [f64; 2]), radius_mm: f64, near_mm: f64) -> bool {
    let beyond_mm = near_mm.max(BEYOND_RADII * radius_mm);
    let (mut before, mut beyond) = (0, 0);
    for p in surface {
        let x = p.x - at_mm - slope[0] * p.y - slope[1] * p.z;
        before += usize::from((0.0..radius_mm).contains(&x));
        beyond += usize::from((-radius_mm..0.0).contains(&(x + beyond_mm)));
    }
    beyond >= FEWEST_BEYOND && beyond as f64 > SHARE_BEYOND * before as f64
}

fn by_outline(outline: &Outline, noise_mm: f64) -> End {
    let at_mm = outline.at_mm;
    let slope = outline.loose_size();
    if slope - OBLIQUE_SIGMAS * outline.loose_sigma > MOST_OBLIQUE {
        return End::CutOff { at_mm: outline.loose_at_mm, slope_rad: slope.atan() };
    }
    let mitre = outline.slope[0].hypot(outline.slope[1]);
    let is_mitred = mitre > DIFFERENT_SIGMAS * outline.loose_sigma;
    if outline.agreeing < if is_mitred { LEAST_AGREEING_MITRED } else { LEAST_AGREEING } {
        return End::Ragged { at_mm };
    }
    let cut_rad = cut(&outline.slope, &outline.slope_variance);
    let sigma_mm = outline.sigma_mm.hypot(RIM_SIGMAS * noise_mm);
    End::Found(Place { at_mm, sigma_mm, cut_rad, by_outline: true })
}

/// Angle from square of a plane with this slope, without what its uncertainty adds to it on average.
fn cut(slope: &[f64; 2], variance: &[f64; 3]) -> Option<(f64, f64)> {
    let size = slope[0].hypot(slope[1]);
    let (u, v) = if size > 0.0 { (slope[0] / size, slope[1] / size) } else { (1.0, 0.0) };
    let [yy, yz, zz] = *variance;
    let sigma = (u * u * yy + 2.0 * u * v * yz + v * v * zz).max(0.0).sqrt();
    let across = (v * v * yy - 2.0 * u * v * yz + u * u * zz).max(0.0).sqrt();
    let angle = (size * size - yy - zz).max(0.0).sqrt().atan();
    // Near square the direction is open, and so the worse of the two counts.
    let sigma = if size > 2.0 * across { sigma } else { sigma.max(across) };
    (sigma.atan() <= MAX_CUT_SIGMA_RAD).then_some((angle, sigma.atan()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    const RADIUS: f64 = 10.0;
    const NOISE: f64 = 0.02;

    /// Stripes 0.7 mm apart along half of a tube that begins at the plane x = at + slope y, a little irregular, with
    /// points every 0.4 mm. Skewed, as a hand guides them.
    fn half_tube(at: f64, slope: f64) -> Vec<Point3<f64>> {
        let mut points = Vec::new();
        for stripe in -40..80 {
            for k in 0..80 {
                let turn = -1.6 + 0.04 * f64::from(k);
                let (i, k) = (f64::from(stripe), f64::from(k));
                let x = 0.7 * i + 0.02 * k + 0.1 * (5.1 * i).sin();
                let r = RADIUS + NOISE * (1.7 * i + 2.3 * k).sin();
                let p = Point3::new(x, r * turn.cos(), r * turn.sin());
                if p.x > at + slope * p.y && p.x < 50.0 {
                    points.push(p);
                }
            }
        }
        points
    }

    /// The ring between bore and outside, as a grid.
    fn ring(at: f64, slope: f64) -> Vec<Point3<f64>> {
        let grid = (-25..=25).flat_map(|i| (-25..=25).map(move |k| (0.4 * f64::from(i), 0.4 * f64::from(k))));
        grid.filter(|(y, z)| (8.5..RADIUS).contains(&y.hypot(*z)))
            .map(|(y, z)| Point3::new(at + slope * y + NOISE * (7.0 * y + 3.0 * z).sin(), y, z))
            .collect()
    }

    fn found(points: &[Point3<f64>]) -> Place {
        match find(points.to_vec(), RADIUS, NOISE, 0.0) {
            Some(End::Found(place)) => place,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_square_end_is_found_within_its_sigma() {
        for step in 0..20 {
            let at = 3.0 + 0.05 * f64::from(step);
            let end = found(&half_tube(at, 0.0));
            assert!((end.at_mm - at).abs() < 3.0 * end.sigma_mm, "{end:?} at {at}");
            assert!(end.sigma_mm < 0.35, "better than half a stripe: {end:?}");
            assert!(end.by_outline);
        }
    }

    #[test]
    fn the_cut_goes_through_the_axis_where_the_face_says() {
        let slope = 3f64.to_radians().tan();
        let mut points = half_tube(3.3, slope);
        points.extend(ring(3.3, slope));
        let end = found(&points);
        assert!(!end.by_outline);
        assert!(end.sigma_mm < 0.01 && (end.at_mm - 3.3).abs() < 4.0 * end.sigma_mm, "{end:?}");
        let (cut, sigma) = end.cut_rad.unwrap();
        assert!((cut.to_degrees() - 3.0).abs() < 0.1 && sigma.to_degrees() < 0.1, "{end:?}");
    }

    #[test]
    fn the_bore_is_no_face() {
        let mut points = half_tube(3.3, 0.0);
        // The far side of the bore, seen through the opening.
        for i in 0..400 {
            let turn = 0.3 + 2.5 * (f64::from(i) * 0.618).fract();
            points.push(Point3::new(3.3 + 0.004 * f64::from(i), 8.5 * turn.cos(), -8.5 * turn.sin()));
        }
        let end = found(&points);
        assert!(end.by_outline && (end.at_mm - 3.3).abs() < 3.0 * end.sigma_mm, "{end:?}");
    }

    #[test]
    fn a_burr_moves_the_end_by_less_than_its_sigma() {
        let mut points = half_tube(3.3, 0.0);
        let clean = found(&points);
        // A lip 0.3 mm long over a fifth of what is seen.
        for i in 0..60 {
            let turn = 0.2 + 0.6 * f64::from(i) / 60.0;
            points.push(Point3::new(
                3.0 + 0.3 * (f64::from(i) * 0.618).fract(),
                10.0 * turn.cos(),
                10.0 * turn.sin(),
            ));
        }
        let end = found(&points);
        // It might be the tip of a mitre: the sigma knows.
        let moved_mm = (end.at_mm - clean.at_mm).abs();
        assert!(moved_mm < end.sigma_mm && moved_mm < 0.15, "{end:?} {clean:?}");
        points.extend(ring(3.3, 0.0));
        for p in points.iter_mut().filter(|p| p.x < 3.4 && p.y > 9.0 && p.y.hypot(p.z) < 9.95) {
            p.x -= 0.25;
        }
        let end = found(&points);
        assert!(!end.by_outline && (end.at_mm - 3.3).abs() < 3.0 * end.sigma_mm, "{end:?}");
    }

    #[test]
    fn the_edge_of_the_scan_is_no_end() {
        let Some(End::CutOff { slope_rad, .. }) = find(half_tube(3.0, 0.6), RADIUS, NOISE, 0.0) else {
            panic!("31 degrees from square is no saw's work");
        };
        assert!((slope_rad.to_degrees() - 31.0).abs() < 3.0, "{}", slope_rad.to_degrees());
        // Steps of two radii: no plane at all.
        let steps = |p: &Point3<f64>| p.x > 20.0 * (0.8 * p.z).sin().signum();
        let ragged: Vec<_> = half_tube(-20.0, 0.0).into_iter().filter(steps).collect();
        assert!(!matches!(find(ragged, RADIUS, NOISE, 0.0), Some(End::Found(_))));
    }

    #[test]
    fn an_end_that_was_not_scanned_is_unknown() {
        assert_eq!(find(Vec::new(), RADIUS, NOISE, 0.0), None);
        assert_eq!(find(half_tube(3.0, 0.0)[..2].to_vec(), RADIUS, NOISE, 0.0), None);
        assert_eq!(find(vec![Point3::new(f64::NAN, 0.0, 0.0)], RADIUS, NOISE, 0.0), None);
    }

    #[test]
    fn stray_points_before_the_end_do_not_move_it() {
        let mut points = half_tube(3.3, 0.0);
        let clean = found(&points);
        points.extend([-30.0, -12.0, -4.0].map(|x| Point3::new(x, 10.0, 0.1)));
        assert!((found(&points).at_mm - clean.at_mm).abs() < clean.sigma_mm);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn the_end_moves_and_turns_with_the_tube(shift in -500.0..500.0f64, turn in 0.0..TAU, tilt in -0.08..0.08f64) {
            let mut points = half_tube(3.3, tilt);
            points.extend(ring(3.3, tilt));
            let still = found(&points);
            let (sin, cos) = turn.sin_cos();
            for p in &mut points {
                *p = Point3::new(p.x + shift, cos * p.y - sin * p.z, sin * p.y + cos * p.z);
            }
            let moved = found(&points);
            prop_assert!(!moved.by_outline);
            prop_assert!((moved.at_mm - shift - still.at_mm).abs() < still.sigma_mm, "{moved:?} {still:?}");
        }
    }
}
