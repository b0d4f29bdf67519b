//! The edge of the outside's points at an end, from all points next to it together.
//!
//! A plane across the tube is pushed against the points until a few lie before it: of a scan with so many points per
//! millimetre of tube, it stops within a few millimetres over that number of the edge, much closer than a step of the
//! pattern. How close in this pattern, the pattern itself is asked: the same points are cut at known places further
//! inside, the same plane is pushed there, and its mean error is the correction, its scatter the covariance.

use std::ops::Range;

use nalgebra::{Matrix3, Vector2, Vector3};

use super::square::{Estimate, SAW_SPREAD};

/// Points that may lie before the plane: fewer would make it a prey to stray ones. Of a dense scan more, this share of
/// the points of one step: other errors are larger there.
const BEFORE: f64 = 4.0;
const BEFORE_SHARE: f64 = 0.1;
/// A point counts as half when on the plane, as a whole when so far before it that this share of those points fits in.
const SOFT_SHARE: f64 = 0.75;
/// How far behind the edge points are looked at, in steps.
const DEPTH_STEPS: f64 = 5.0;
/// Cuts at known places.
const CUTS: usize = 48;
/// What the cuts teach is uncertain as if from this many layers of points less.
const LEARNING: f64 = 2.0;
/// Arcs around the tube that are left out in turn, each half over the next.
const ARCS: usize = 10;
/// An arc that stands out so many times as far as any at the known cuts is not of the end.
const BURR_TIMES: f64 = 2.0;
/// Newton steps at most.
const ROUNDS: usize = 15;
/// A wedge longer than this, in steps, is no gap between two stripes.
const LURING_STEPS: f64 = 3.0;
/// Fewest points per step along the tube.
const FEWEST_PER_STEP: f64 = 6.0;

/// All of the tube that was scanned.
const EVERYWHERE: Range<f64> = f64::NEG_INFINITY..f64::INFINITY;

/// A point of the outside: along the tube (past a slope), y, z.
pub type Along = [f64; 3];

/// The points of an end.
pub struct Edge {
    /// In order along the tube.
    points: Vec<Along>,
    step_mm: f64,
    radius_mm: f64,
    pattern: Pattern,
}

/// What is common to all planes pushed against the same points.
#[derive(Clone, Copy)]
struct Pattern {
    before: f64,
    soft_mm: f64,
    /// Mean of 1, y, z.
    centre: Vector3<f64>,
}

impl Pattern {
    /// None of too few points, which come in order along the tube.
    fn of<'a>(mut points: impl Iterator<Item = &'a Along>, step_mm: f64) -> Option<Pattern> {
        let first = points.next()?;
        let (mut n, mut last, mut sum) = (1.0, first, row(first));
        for p in points {
            n += 1.0;
            last = p;
            sum += row(p);
        }
        let extent_mm = last[0] - first[0];
        let per_mm = n / extent_mm.max(1e-9);
        let before = BEFORE.max(BEFORE_SHARE * per_mm * step_mm);
        let pattern = Pattern { before, soft_mm: SOFT_SHARE * before / per_mm, centre: sum / n };
        (per_mm * step_mm >= FEWEST_PER_STEP && extent_mm > 8.0 * step_mm).then_some(pattern)
    }
}

impl Edge {
    /// None of too few points.
    pub fn new(mut points: Vec<Along>, radius_mm: f64, step_mm: f64) -> Option<Edge> {
        points.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]));
        let pattern = Pattern::of(points.iter(), step_mm)?;
        Some(Edge { points, step_mm, radius_mm, pattern })
    }

    /// The points within a range along the tube, past another slope besides.
    fn sloped(&self, slope: &Vector3<f64>, within_mm: Range<f64>) -> Edge {
        let at = |place: f64| self.points.partition_point(|p| p[0] < place);
        let near = &self.points[at(within_mm.start)..at(within_mm.end)];
        let turned = |p: &Along| [p[0] - slope.y * p[1] - slope.z * p[2], p[1], p[2]];
        let mut points: Vec<Along> = near.iter().map(turned).collect();
        points.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]));
        Edge { points, ..*self }
    }

    /// The same points past the slope of an edge that was found: along it they stop as at a square cut.
    pub fn along(&self, edge: &Estimate) -> Edge {
        self.sloped(&edge.value, EVERYWHERE)
    }

    /// The edge wherever the points say, close to a slope.
    pub fn free(&self, near: [f64; 2]) -> Option<Estimate> {
        // At 45 degrees it begins and ends a radius from where it meets the axis.
        let slope = self.slope(f64::NEG_INFINITY, near, 2.0 * self.radius_mm)?;
        let mut found = self.sloped(&slope, EVERYWHERE).estimate(true)?;
        found.value += slope;
        Some(found)
    }

    /// How far along the tube an edge of this slope begins before it ends, where it is seen.
    fn wedge_mm(&self, slope: &Vector2<f64>) -> f64 {
        let along = self.points.iter().map(|p| slope.x * p[1] + slope.y * p[2]);
        let (least, most) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, m), a| (l.min(a), m.max(a)));
        most - least
    }

    /// The slope to which the points from `from` on draw a plane that is close to it; the edge begins within `reach_mm` of the first.
    fn slope(&self, from: f64, near: [f64; 2], reach_mm: f64) -> Option<Vector3<f64>> {
        let mut slope = Vector3::new(0.0, near[0], near[1]);
        let first_mm = self.points.get(self.points.partition_point(|p| p[0] < from))?[0];
        let near_mm = first_mm + reach_mm + DEPTH_STEPS * self.step_mm;
        // Coarsely first: a plane is only drawn to points that are near it.
        for soft in [0.5 * self.step_mm, 0.2 * self.step_mm, 0.0, 0.0] {
            let value = self.sloped(&slope, from..near_mm).push(f64::NEG_INFINITY, true, soft)?;
            slope += Vector3::new(0.0, value.y, value.z);
        }
        Some(slope)
    }

    /// The slopes that square cuts at known places behind an edge that was found would be found with, sought close to its own: where
    /// stripes lie nearly along it some are drawn to theirs.
    pub fn lured(&self, edge: &Estimate) -> Vec<Vector2<f64>> {
        let slope = edge.value.yz();
        // Between two stripes there is no room for more.
        let wedge_mm = self.wedge_mm(&slope);
        if wedge_mm > LURING_STEPS * self.step_mm {
            return Vec::new();
        }
        let behind_mm = edge.value.x + slope.norm() * self.radius_mm;
        let cuts = self.cuts(behind_mm).into_iter().flatten();
        cuts.filter_map(|cut| self.slope(cut, slope.into(), 2.0 * wedge_mm)).map(|s| s.yz()).collect()
    }

    /// The edge of a square cut.
    pub fn square(&self) -> Option<Estimate> {
        let mut found = self.estimate(false)?;
        let (y, z, open) = (self.pattern.centre.y, self.pattern.centre.z, SAW_SPREAD * SAW_SPREAD);
        found.variance += Matrix3::new(y * y + z * z, -y, -z, -y, 1.0, 0.0, -z, 0.0, 1.0) * open;
        Some(found)
    }

    /// The edge without the arc that stands out before a square edge farther than any does at the known cuts: a burr, or
    /// something that touches the tube there. None where none does.
    pub fn without_burr(&self) -> Option<Edge> {
        // Every point knows the arcs that it is not in: ten copies of the others would be the most memory of a run.
        let outside = outside_arcs(&self.points);
        let beside = |arc: usize| {
            let outside = &outside;
            move |i: &usize| outside[*i] & (1 << arc) != 0
        };
        let others = (0..ARCS).filter_map(|arc| {
            let points = (0..self.points.len()).filter(beside(arc)).map(|i| &self.points[i]);
            Some((arc, Pattern::of(points, self.step_mm)?))
        });
        let others: Vec<(usize, Pattern)> = others.collect();
        let farthest = |from: f64| {
            let all = self.push(from, false, 0.0)?.x;
            let square = |(arc, pattern): &(usize, Pattern)| {
                Some((*arc, self.push_among(beside(*arc), pattern, from, false, 0.0)?.x - all))
            };
            others.iter().filter_map(square).max_by(|a, b| a.1.total_cmp(&b.1))
        };
        let (arc, off_mm) = farthest(f64::NEG_INFINITY)?;
        let begin = self.push(f64::NEG_INFINITY, false, 0.0)?.x;
        let usual: Vec<f64> = self.cuts(begin + off_mm)?.filter_map(|cut| Some(farthest(cut)?.1)).collect();
        let most = usual.iter().copied().fold(0.0, f64::max);
        let stands_out = usual.len() > CUTS / 2 && off_mm > BURR_TIMES * most;
        if !stands_out {
            return None;
        }
        let kept = (0..self.points.len()).filter(beside(arc)).map(|i| self.points[i]).collect();
        Edge::new(kept, self.radius_mm, self.step_mm)
    }

    /// The covariance with which a square edge would be found by [`Edge::free`].
    pub fn scatter(&self) -> Option<Matrix3<f64>> {
        self.estimate(true).map(|e| e.variance)
    }

    fn estimate(&self, free: bool) -> Option<Estimate> {
        let value = self.push(f64::NEG_INFINITY, free, 0.0)?;
        let at_cut = |cut: f64| Some(self.push(cut, free, 0.0)? - Vector3::new(cut, 0.0, 0.0));
        let known: Vec<Vector3<f64>> = self.cuts(value.x)?.filter_map(at_cut).collect();
        let n = known.len() as f64;
        let mean = known.iter().sum::<Vector3<f64>>() / n;
        let scatter = known.iter().map(|o| (o - mean) * (o - mean).transpose()).sum::<Matrix3<f64>>() / n;
        (n > 0.5 * CUTS as f64).then(|| Estimate {
            value: value - mean,
            variance: scatter * (1.0 + LEARNING / self.layers(value.x)),
        })
    }

    /// Layers of points from a step behind `begin_mm` to where the last plane still has points behind it.
    fn layers(&self, begin_mm: f64) -> f64 {
        let last_mm = self.points.last().map_or(begin_mm, |p| p[0]);
        (last_mm - begin_mm) / self.step_mm - 1.0 - DEPTH_STEPS
    }

    /// The known cuts; None where there is too little room for them.
    fn cuts(&self, begin_mm: f64) -> Option<impl Iterator<Item = f64>> {
        let (from, layers, step_mm) = (begin_mm + self.step_mm, self.layers(begin_mm), self.step_mm);
        let cut = move |k| from + layers * step_mm * (f64::from(k) + 0.5) / CUTS as f64;
        (layers >= 2.0).then(|| (0..CUTS as u32).map(cut))
    }

    /// The plane against the points from `from` on, which are taken for all there are.
    fn push(&self, from: f64, free: bool, soft_mm: f64) -> Option<Vector3<f64>> {
        self.push_among(|_| true, &self.pattern, from, free, soft_mm)
    }

    /// The same against those points only that are `kept`, by their indices; `pattern` is theirs.
    fn push_among(
        &self,
        kept: impl Fn(&usize) -> bool,
        pattern: &Pattern,
        from: f64,
        free: bool,
        soft_mm: f64,
    ) -> Option<Vector3<f64>> {
        let begin = self.points.partition_point(|p| p[0] < from);
        let start = (begin..self.points.len()).filter(&kept).nth(pattern.before as usize)?;
        let start = self.points[start][0];
        let end = self.points.partition_point(|p| p[0] < start + DEPTH_STEPS * self.step_mm);
        let near = (begin..end).filter(&kept).map(|i| &self.points[i]);
        let pattern = Pattern { soft_mm: pattern.soft_mm.max(soft_mm), ..*pattern };
        let mut value = Vector3::new(start, 0.0, 0.0);
        for _ in 0..ROUNDS {
            let step = self.newton(near.clone(), &pattern, &value, free)?;
            let reach = step.x.abs().max(self.radius_mm * step.y.hypot(step.z));
            value += step * (4.0 * pattern.soft_mm / reach).min(1.0);
            if reach < 0.01 * pattern.soft_mm {
                break;
            }
        }
        Some(value)
    }

    /// Every point before the plane costs, being farther from the points costs too.
    fn newton<'a>(
        &self,
        near: impl Iterator<Item = &'a Along>,
        pattern: &Pattern,
        value: &Vector3<f64>,
        free: bool,
    ) -> Option<Vector3<f64>> {
        let soft = pattern.soft_mm;
        let mut slope = pattern.centre * pattern.before;
        let mut bend = Matrix3::zeros();
        let reach = value.x + self.radius_mm * value.y.hypot(value.z) + soft;
        for p in near.take_while(|p| p[0] < reach) {
            let row = row(p);
            let share = 0.5 + (row.dot(value) - p[0]) / (2.0 * soft);
            if share > 0.0 {
                slope -= row * share.min(1.0);
                if share < 1.0 {
                    bend += row * row.transpose();
                }
            }
        }
        // Held where no point is near.
        let hold = Vector3::new(0.5, 0.1 * self.radius_mm.powi(2), 0.1 * self.radius_mm.powi(2));
        bend += Matrix3::from_diagonal(&hold);
        bend /= 2.0 * soft;
        if !free {
            return Some(Vector3::new(slope.x / bend[(0, 0)], 0.0, 0.0));
        }
        Some(bend.try_inverse()? * slope)
    }
}

fn row(p: &Along) -> Vector3<f64> {
    Vector3::new(1.0, p[1], p[2])
}

/// The arcs around the tube that each point is not in, a bit for each.
fn outside_arcs(points: &[Along]) -> Vec<u16> {
    let turn = std::f64::consts::TAU / ARCS as f64;
    let half = turn.cos();
    let middles: [(f64, f64); ARCS] = std::array::from_fn(|k| (turn * k as f64).sin_cos());
    let bits = |p: &Along| {
        let limit = half * p[1].hypot(p[2]);
        let outside = middles.iter().map(|(sin, cos)| p[1] * cos + p[2] * sin < limit);
        outside.enumerate().fold(0, |bits, (k, out)| bits | u16::from(out) << k)
    };
    points.iter().map(bits).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const RADIUS: f64 = 10.0;
    const STEP: f64 = 1.0;

    /// Points of half a tube, a square millimetre each and in no order, from the plane x = at + slope y on.
    fn points(at: f64, slope: f64) -> Vec<Along> {
        let point = |i: i32| {
            let i = f64::from(i);
            let turn = std::f64::consts::PI * (0.618_034 * i).fract();
            [70.0 * (0.754_878 * i).fract() - 10.0, RADIUS * turn.cos(), RADIUS * turn.sin()]
        };
        (0..2200).map(point).filter(|p| p[0] > at + slope * p[1]).collect()
    }

    fn edge(points: Vec<Along>) -> Edge {
        Edge::new(points, RADIUS, STEP).unwrap()
    }

    #[test]
    fn a_square_edge_is_found_to_a_small_part_of_a_step() {
        for k in 0..40 {
            let at = 1.0 + 0.13 * f64::from(k);
            let found = edge(points(at, 0.0)).square().unwrap();
            let sigma = found.variance[(0, 0)].sqrt();
            assert!((found.value.x - at).abs() < 3.5 * sigma && sigma < 0.1 * STEP, "{found:?} at {at}");
        }
    }

    #[test]
    fn an_oblique_edge_is_found_from_a_slope_close_to_it() {
        for slope in [-0.2, -0.05, 0.1, 0.25] {
            let found = edge(points(1.0, slope)).free([slope + 0.08, -0.1]).unwrap();
            for (k, truth) in [1.0, slope, 0.0].into_iter().enumerate() {
                let sigma = found.variance[(k, k)].sqrt();
                assert!((found.value[k] - truth).abs() < 3.5 * sigma, "{k}: {found:?} at {slope}");
            }
            assert!(found.variance[(1, 1)].sqrt() < 0.03, "{found:?}");
        }
    }

    #[test]
    fn two_stray_points_move_it_by_no_more_than_they_are_worth() {
        let clean = edge(points(1.0, 0.0)).square().unwrap();
        let mut with_stray = points(1.0, 0.0);
        with_stray.extend([[-1.0, 10.0, 0.0], [-4.0, 0.0, 10.0]]);
        let found = edge(with_stray).square().unwrap();
        // 31 points per millimetre.
        assert!((found.value.x - clean.value.x).abs() < 4.0 / 31.0, "{found:?} {clean:?}");
    }

    #[test]
    fn a_burr_is_left_out_and_a_clean_edge_has_none() {
        assert!(edge(points(1.0, 0.0)).without_burr().is_none());
        let mut with_burr = points(1.0, 0.0);
        // 0.6 mm of lip around a sixth of what is seen.
        with_burr.extend((0..60).map(|i| {
            let turn = 1.0 + 0.5 * f64::from(i) / 60.0;
            [0.4 + 0.6 * (0.618 * f64::from(i)).fract(), RADIUS * turn.cos(), RADIUS * turn.sin()]
        }));
        let found = edge(with_burr).without_burr().unwrap().square().unwrap();
        assert!((found.value.x - 1.0).abs() < 3.5 * found.variance[(0, 0)].sqrt(), "{found:?}");
    }

    #[test]
    fn too_few_points_say_nothing() {
        assert!(Edge::new(Vec::new(), RADIUS, STEP).is_none());
        assert!(Edge::new(points(55.0, 0.0), RADIUS, STEP).is_none());
    }
}
