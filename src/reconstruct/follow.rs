//! Which points of the spine are a tube's: those that follow one another. Where a jaw, a block or an edge was scanned, a
//! cylinder sometimes fits by chance; such points lie scattered, point anywhere, and fit worse than the tube's.
//!
//! Between [`mls`](super::mls), which projects, and [`crust`](super::crust), which joins.

use nalgebra::Point3;

use super::mls::SpinePoint;
use crate::cloud::{Neighbours, PointCloud};
use crate::recognize::median;

/// Points farther apart than this many tube radii do not tell whether one follows the other.
const REACH_RADII: f64 = 1.2;

/// The tightest bend, in tube radii: nothing bends around less.
pub(super) const TIGHTEST_RADII: f64 = 1.5;

/// Errors of a spine point across the tube, in tube radii, and of its direction.
const ASIDE_RADII: f64 = 0.06;
const ASTRAY: f64 = 0.12;

/// A stretch of this many tube radii is a tube's: no jaw is fitted so far along.
const SURE_RADII: f64 = 4.0;

/// A shorter one is a tube's when it is at least this long, holds so many points, and its cylinders fit about as well
/// as the sure ones do in median.
const LEAST_RADII: f64 = 0.5;
const LEAST_POINTS: usize = 3;
const MOST_MISFIT: f64 = 4.0;

/// The points of the spine that others follow. Where no long stretch is (few points, a short tube), all are kept.
pub fn followed(spine: Vec<SpinePoint>, radius_mm: f64) -> Vec<SpinePoint> {
    let stretches = stretches(&spine, radius_mm);
    let long = |s: &&Stretch| s.extent_mm >= SURE_RADII * radius_mm;
    let mut misfits: Vec<f64> = stretches.iter().filter(long).map(|s| s.misfit_mm).collect();
    let Some(usual_mm) = median(&mut misfits) else { return spine };
    let tells = |s: &&Stretch| {
        let solid = s.extent_mm >= LEAST_RADII * radius_mm && s.members.len() >= LEAST_POINTS;
        long(s) || (solid && s.misfit_mm <= MOST_MISFIT * usual_mm)
    };
    let mut kept: Vec<usize> = stretches.iter().filter(tells).flat_map(|s| &s.members).copied().collect();
    kept.sort_unstable();
    kept.into_iter().map(|i| spine[i]).collect()
}

/// Points that follow one another.
struct Stretch {
    members: Vec<usize>,
    /// Distance of its two ends, about.
    extent_mm: f64,
    /// Median distance of the scan's points from the cylinders.
    misfit_mm: f64,
}

fn stretches(spine: &[SpinePoint], radius_mm: f64) -> Vec<Stretch> {
    let points: Vec<Point3<f64>> = spine.iter().map(|s| s.point).collect();
    let index = Neighbours::new(&PointCloud::from_points(&points));
    let mut seen = vec![false; spine.len()];
    let (mut out, mut near) = (Vec::new(), Vec::new());
    for start in 0..spine.len() {
        if std::mem::replace(&mut seen[start], true) {
            continue;
        }
        let mut members = vec![start];
        let mut next = 0;
        while let Some(&i) = members.get(next) {
            next += 1;
            index.within(&points[i], REACH_RADII * radius_mm, &mut near);
            for k in near.iter().map(|&k| k as usize) {
                if !seen[k] && follows(&spine[i], &spine[k], radius_mm) {
                    seen[k] = true;
                    members.push(k);
                }
            }
        }
        out.push(Stretch::new(members, spine));
    }
    out
}

impl Stretch {
    fn new(members: Vec<usize>, spine: &[SpinePoint]) -> Stretch {
        let mut misfits: Vec<f64> = members.iter().map(|&i| spine[i].rms_mm).collect();
        // The farthest from any one, and the farthest from that: the extent of a line.
        let farthest = |from: usize| {
            let away = |i: usize| (spine[i].point - spine[from].point).norm();
            let at = members.iter().copied().max_by(|&a, &b| away(a).total_cmp(&away(b)));
            at.map_or((from, 0.0), |i| (i, away(i)))
        };
        let extent_mm = farthest(farthest(members[0]).0).1;
        Stretch { extent_mm, misfit_mm: median(&mut misfits).unwrap_or(0.0), members }
    }
}

/// Whether one arc that a tube can have leads from the one to the other.
fn follows(one: &SpinePoint, other: &SpinePoint, radius_mm: f64) -> bool {
    let way = other.point - one.point;
    let distance = way.norm();
    let bent = distance / (2.0 * TIGHTEST_RADII * radius_mm);
    let aside = |s: &SpinePoint| way.cross(&s.tangent).norm();
    let allowed = distance * bent + ASIDE_RADII * radius_mm;
    let turn = one.tangent.cross(&other.tangent).norm();
    aside(one) <= allowed && aside(other) <= allowed && turn <= 2.0 * bent + ASTRAY
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    const RADIUS: f64 = 10.0;

    /// A point of the spine, with the misfit of a true cylinder.
    fn on(x: f64, y: f64, direction: Vector3<f64>) -> SpinePoint {
        SpinePoint { point: Point3::new(x, y, 0.0), tangent: direction.normalize(), rms_mm: 0.03 }
    }

    /// A straight of sixteen radii with a gap that a jaw hides.
    fn held_tube() -> Vec<SpinePoint> {
        (0..80)
            .map(|i| 2.0 * f64::from(i))
            .filter(|x| !(60.0..80.0).contains(x))
            .map(|x| on(x, 0.0, Vector3::x()))
            .collect()
    }

    #[test]
    fn cylinders_on_a_jaws_edges_are_dropped() {
        let mut spine = held_tube();
        let tube = spine.len();
        // Across the tube; along it beside it, a short stretch that fits badly; alone.
        spine.extend([on(64.0, 14.0, Vector3::y()), on(65.0, 19.0, Vector3::y())]);
        spine.extend(
            (0..4).map(|i| SpinePoint { rms_mm: 0.5, ..on(66.0 + 2.0 * f64::from(i), 11.0, Vector3::x()) }),
        );
        spine.push(on(70.0, -25.0, Vector3::z()));
        let kept = followed(spine, RADIUS);
        assert_eq!(kept.len(), tube);
        assert!(kept.iter().all(|s| s.point.y == 0.0));
    }

    #[test]
    fn a_short_stretch_that_fits_as_well_as_the_rest_stays() {
        let mut spine = held_tube();
        let tube = spine.len();
        spine.extend((0..4).map(|i| on(67.0 + 2.0 * f64::from(i), 0.0, Vector3::x())));
        assert_eq!(followed(spine, RADIUS).len(), tube + 4);
    }

    #[test]
    fn the_tightest_bend_is_followed() {
        let r = TIGHTEST_RADII * RADIUS;
        let arc = (0..30).map(|i| 0.1 * f64::from(i));
        let bend: Vec<SpinePoint> =
            arc.map(|t| on(r * t.sin(), r * t.cos(), Vector3::new(t.cos(), -t.sin(), 0.0))).collect();
        assert_eq!(stretches(&bend, RADIUS).len(), 1);
    }

    #[test]
    fn a_tube_shorter_than_any_sure_stretch_is_kept_as_it_is() {
        let short: Vec<SpinePoint> = (0..8).map(|i| on(3.0 * f64::from(i), 0.0, Vector3::x())).collect();
        assert_eq!(followed(short.clone(), RADIUS), short);
    }
}
