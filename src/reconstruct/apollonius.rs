//! Arcs that touch two directed lines and pass within a tolerance of given points: the line-line-circle problem of
//! Apollonius (paper 000, sections 4.2 and 4.3), for turns below and above 180 degrees.
//!
//! In the plane: the first line is the x axis, travelled towards +x; the turn is to the left. Centres at the same
//! signed distance from both lines form a line; along it the radius is linear, and a circle touches the disk around
//! a point at the roots of two quadratics. Between neighbouring roots a point's verdict does not change.

use std::f64::consts::TAU;

use nalgebra::Vector2;

type Vec2 = Vector2<f64>;

/// The vertices between two tangent lines.
#[derive(Debug, Clone)]
pub struct Chain {
    /// Vertices with the distance that each may have in this plane.
    pub points: Vec<(Vec2, f64)>,
    /// A point on the second line: travel goes from here ...
    pub turning: Vec2,
    /// ... to here.
    pub finish: Vec2,
    /// The first line may not be left before this x.
    pub begin_at: f64,
    /// By how much the order of arcs along a line may be violated.
    pub tolerance_mm: f64,
    /// Smallest radius.
    pub min_radius_mm: f64,
}

/// An arc between the lines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    /// Where it leaves the first line.
    pub begin: Vec2,
    /// Where it reaches the second.
    pub end: Vec2,
    /// Its radius.
    pub radius_mm: f64,
    /// Its angle, 0 to 360 degrees.
    pub angle_rad: f64,
    /// Sum of the vertices' squared distances.
    pub squared_error: f64,
}

/// Turns smaller than this, or that close to a full turn, make no arc.
const LEAST_TURN: f64 = 2e-3;

/// Places at which each interval of centres is tried.
const TRIES: usize = 9;

/// The curve may be this much longer or shorter than the polygon: a shallow corner must not be taken for a
/// nearly full turn the other way round, whose loop no vertex lies on.
const LENGTH_SHARE: f64 = 0.1;

/// One family of arcs: centre = base + lambda * along, radius = base_radius + lambda * slope.
struct Family {
    base: Vec2,
    along: Vec2,
    base_radius: f64,
    slope: f64,
    angle: f64,
    out: Vec2,
    finish: Vec2,
}

/// The left-turning arc with the smallest squared error among those within tolerance of all points; None if there is
/// none.
pub fn solve(chain: &Chain) -> Option<Found> {
    let family = Family::new(chain)?;
    let mut allowed = vec![family.bounds(chain)?];
    for (point, tolerance) in &chain.points {
        allowed = family.allowed(point, *tolerance, &allowed);
        if allowed.is_empty() {
            return None;
        }
    }
    let tried = allowed.iter().flat_map(|&(low, high)| {
        (0..TRIES).map(move |k| low + (high - low) * (k as f64 + 0.5) / TRIES as f64)
    });
    let length = chain.length();
    let slack = LENGTH_SHARE * length + 2.0 * chain.tolerance_mm;
    let tried = tried.filter(|&lambda| (family.length(lambda) - length).abs() < slack);
    let error =
        |lambda: f64| chain.points.iter().map(|(p, _)| family.distance(p, lambda).powi(2)).sum::<f64>();
    let (lambda, squared_error) = tried.map(|l| (l, error(l))).min_by(|a, b| a.1.total_cmp(&b.1))?;
    let (centre, radius_mm) = family.circle(lambda);
    let normal = Vec2::new(-family.out.y, family.out.x);
    Some(Found {
        begin: Vec2::new(centre.x, 0.0),
        end: centre - normal * radius_mm,
        radius_mm,
        angle_rad: family.angle,
        squared_error,
    })
}

impl Chain {
    /// Length of the polygon from the start of the first line to the end of the second.
    fn length(&self) -> f64 {
        let inner = self.points.iter().map(|(p, _)| *p);
        let all: Vec<Vec2> = [Vec2::zeros()].into_iter().chain(inner).chain([self.finish]).collect();
        all.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
    }
}

impl Family {
    fn new(chain: &Chain) -> Option<Family> {
        let out = (chain.finish - chain.turning).try_normalize(1e-9)?;
        let angle = out.y.atan2(out.x).rem_euclid(TAU);
        if !(LEAST_TURN..TAU - LEAST_TURN).contains(&angle) {
            return None;
        }
        let normals = (Vec2::new(0.0, 1.0), Vec2::new(-out.y, out.x));
        // Equal signed distances: (c . n1) - ((c - turning) . n2) = 0.
        let across = normals.0 - normals.1;
        let offset = -chain.turning.dot(&normals.1);
        let near = chain.turning * 0.5;
        let base = near - across * ((near.dot(&across) - offset) / across.norm_squared());
        let along = Vec2::new(-across.y, across.x).normalize();
        // Along the direction in which the radius grows (either, for parallel lines).
        let along = if along.y < 0.0 { -along } else { along };
        Some(Family { base, along, base_radius: base.y, slope: along.y, angle, out, finish: chain.finish })
    }

    fn circle(&self, lambda: f64) -> (Vec2, f64) {
        (self.base + self.along * lambda, self.base_radius + self.slope * lambda)
    }

    /// Length of line, arc, line.
    fn length(&self, lambda: f64) -> f64 {
        let (centre, radius) = self.circle(lambda);
        // The end of the arc lies at (centre . out) along the second line.
        centre.x + radius * self.angle + (self.finish - centre).dot(&self.out)
    }

    /// Interval of lambda in which the radius is allowed and the arc lies between the ends of both lines.
    fn bounds(&self, chain: &Chain) -> Option<(f64, f64)> {
        let reach = chain.points.iter().map(|(p, _)| p.norm()).fold(self.finish.norm(), f64::max);
        let mut interval = (-20.0 * reach, 20.0 * reach);
        // Each condition: at + lambda * slope >= 0.
        let mut require = |at: f64, slope: f64| {
            if slope.abs() < 1e-12 {
                if at < 0.0 {
                    interval = (1.0, -1.0);
                }
            } else if slope > 0.0 {
                interval.0 = interval.0.max(-at / slope);
            } else {
                interval.1 = interval.1.min(-at / slope);
            }
        };
        require(self.base_radius - chain.min_radius_mm, self.slope);
        require(20.0 * reach - self.base_radius, -self.slope);
        require(self.base.x - chain.begin_at + chain.tolerance_mm, self.along.x);
        let left = (self.finish - self.base).dot(&self.out) + chain.tolerance_mm;
        require(left, -self.along.dot(&self.out));
        (interval.0 < interval.1).then_some(interval)
    }

    /// The parts of `intervals` in which the point lies within tolerance of the curve.
    fn allowed(&self, point: &Vec2, tolerance: f64, intervals: &[(f64, f64)]) -> Vec<(f64, f64)> {
        let mut breaks: Vec<f64> = Vec::with_capacity(4);
        for grow in [tolerance, -tolerance] {
            let (from, radius) = (self.base - point, self.base_radius + grow);
            let a = 1.0 - self.slope * self.slope;
            let half_b = from.dot(&self.along) - self.slope * radius;
            let c = from.norm_squared() - radius * radius;
            let root = half_b * half_b - a * c;
            if root >= 0.0 {
                // Stable form: one root by subtraction-free division, the other by Vieta.
                let q = -half_b - half_b.signum() * root.sqrt();
                breaks.extend([q / a, c / q].into_iter().filter(|x| x.is_finite()));
            }
        }
        breaks.sort_by(f64::total_cmp);
        let mut out: Vec<(f64, f64)> = Vec::new();
        for &(low, high) in intervals {
            let inner = breaks.iter().copied().filter(|b| *b > low && *b < high);
            let edges: Vec<f64> = [low].into_iter().chain(inner).chain([high]).collect();
            for w in edges.windows(2) {
                if self.distance(point, 0.5 * (w[0] + w[1])) > tolerance {
                    continue;
                }
                match out.last_mut() {
                    Some(last) if last.1 == w[0] => last.1 = w[1],
                    _ => out.push((w[0], w[1])),
                }
            }
        }
        out
    }

    /// Distance of a point from line, arc, line.
    fn distance(&self, point: &Vec2, lambda: f64) -> f64 {
        let (centre, radius) = self.circle(lambda);
        let from = point - centre;
        let turn = from.x.atan2(-from.y).rem_euclid(TAU);
        let on_arc = if turn <= self.angle { (from.norm() - radius).abs() } else { f64::INFINITY };
        let before = (point - Vec2::new(point.x.clamp(0.0, centre.x.max(0.0)), 0.0)).norm();
        let end = centre - Vec2::new(-self.out.y, self.out.x) * radius;
        let length = (self.finish - end).dot(&self.out).max(0.0);
        let along = (point - end).dot(&self.out).clamp(0.0, length);
        let after = (point - end - self.out * along).norm();
        on_arc.min(before).min(after)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    use proptest::prelude::*;

    /// Vertices on line, arc, line with the turn to the left.
    fn chain(angle: f64, radius: f64, before: f64, after: f64) -> Chain {
        let centre = Vec2::new(before, radius);
        let on_arc = (0..=6).map(|k| {
            let t = angle * k as f64 / 6.0;
            centre + Vec2::new(t.sin(), -t.cos()) * radius
        });
        let out = Vec2::new(angle.cos(), angle.sin());
        let end = centre + Vec2::new(angle.sin(), -angle.cos()) * radius;
        let mut points: Vec<(Vec2, f64)> = on_arc.map(|p| (p, 0.05 * radius)).collect();
        points.push((end + out * 0.5 * after, 0.05 * radius));
        Chain {
            points,
            turning: end + out * 0.5 * after,
            finish: end + out * after,
            begin_at: 0.0,
            tolerance_mm: 0.05 * radius,
            min_radius_mm: 0.1 * radius,
        }
    }

    proptest! {
        #[test]
        fn finds_the_arc_that_made_the_points(
            angle in 0.2..5.8f64, radius in 5.0..100.0f64, before in 0.5..10.0f64, after in 0.5..10.0f64,
        ) {
            let found = solve(&chain(angle, radius, before * radius, after * radius)).unwrap();
            prop_assert!((found.angle_rad - angle).abs() < 1e-9);
            prop_assert!(found.squared_error <= 9.0 * (0.05 * radius).powi(2));
            // A shallow turn hardly knows its radius.
            prop_assert!(angle < 0.8 || (found.radius_mm / radius - 1.0).abs() < 0.5, "{found:?}");
        }
    }

    #[test]
    fn parallel_lines_are_no_exception() {
        let chain = chain(PI, 20.0, 50.0, 60.0);
        assert!((chain.finish - chain.turning).y.abs() < 1e-12);
        let found = solve(&chain).unwrap();
        assert!((found.radius_mm - 20.0).abs() < 1.0 && (found.begin.x - 50.0).abs() < 3.0, "{found:?}");
    }

    #[test]
    fn points_off_every_arc_have_none() {
        let mut chain = chain(1.5, 20.0, 50.0, 60.0);
        chain.points[3].0 += Vec2::new(5.0, -5.0);
        assert_eq!(solve(&chain), None);
    }
}
