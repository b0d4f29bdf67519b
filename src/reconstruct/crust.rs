//! A polygon through the spine points: NN-Crust (T. K. Dey and P. Kumar, "A simple provable algorithm for curve
//! reconstruction", SODA 1999), made safe for open curves with gaps.
//!
//! Every point is joined to its nearest neighbour and to the nearest one on the other side. Edges that both
//! ends want make paths; paths are then joined end to end across what the scanner did not see.

use nalgebra::{Point3, Vector3};

use super::mls::SpinePoint;
use crate::cloud::{Neighbours, PointCloud};

/// A gap is bridged up to this many tube radii, when both ends point across it.
const GAP_RADII: f64 = 10.0;

/// Edges of the crust itself are no longer than this many spacings.
const REACH_SPACINGS: f64 = 4.0;

/// Neighbours that may be the nearest and the half neighbour.
const LOOKED_AT: usize = 24;

/// What the spine points form.
#[derive(Debug, Clone, PartialEq)]
pub struct Chains {
    /// Polygons, the longest first.
    pub chains: Vec<Vec<Point3<f64>>>,
    /// Whether the longest closes on itself.
    pub closed: bool,
}

/// Length of a polygon without its bridges: what was really seen.
pub fn solid_length_mm(chain: &[Point3<f64>], spacing_mm: f64) -> f64 {
    chain.windows(2).map(|w| (w[1] - w[0]).norm()).filter(|l| *l < REACH_SPACINGS * spacing_mm).sum()
}

/// Length of a polygon.
pub fn length_mm(chain: &[Point3<f64>]) -> f64 {
    chain.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
}

/// Joins points spaced by about `spacing_mm` on a tube of radius `radius_mm`.
pub fn connect(points: &[SpinePoint], spacing_mm: f64, radius_mm: f64) -> Chains {
    let wanted = wanted_edges(points, REACH_SPACINGS * spacing_mm);
    let mutual = |a: usize, b: usize| wanted[a].contains(&Some(b)) && wanted[b].contains(&Some(a));
    let links: Vec<Vec<usize>> = (0..points.len())
        .map(|a| wanted[a].iter().flatten().copied().filter(|&b| mutual(a, b)).collect())
        .collect();
    let (mut pieces, closed) = walk(&links);
    let closed = closed && pieces.len() == 1;
    join_ends(points, &mut pieces, radius_mm);
    let mut chains: Vec<Vec<Point3<f64>>> =
        pieces.into_iter().map(|piece| piece.into_iter().map(|i| points[i].point).collect()).collect();
    let solid = |c: &Vec<Point3<f64>>| solid_length_mm(c, spacing_mm);
    chains.sort_by(|a, b| solid(b).total_cmp(&solid(a)));
    Chains { chains, closed }
}

/// Nearest neighbour and half neighbour of every point, no farther than `reach_mm`.
fn wanted_edges(points: &[SpinePoint], reach_mm: f64) -> Vec<[Option<usize>; 2]> {
    let positions: Vec<Point3<f64>> = points.iter().map(|s| s.point).collect();
    let neighbours = Neighbours::new(&PointCloud::from_points(&positions));
    let edges = |i: usize| {
        let near = neighbours.nearest(&positions[i], LOOKED_AT);
        let mut near =
            near.iter().filter(|(k, d)| *k as usize != i && *d <= reach_mm).map(|(k, _)| *k as usize);
        let Some(first) = near.next() else { return [None, None] };
        let towards = positions[first] - positions[i];
        let half = near.find(|&k| (positions[k] - positions[i]).dot(&towards) <= 0.0);
        [Some(first), half]
    };
    (0..points.len()).map(edges).collect()
}

/// Paths of a graph whose nodes have at most two links; true when one of them was a circle (opened where it was
/// entered).
fn walk(links: &[Vec<usize>]) -> (Vec<Vec<usize>>, bool) {
    let mut seen = vec![false; links.len()];
    let mut paths = Vec::new();
    let mut closed = false;
    let ends = (0..links.len()).filter(|&i| links[i].len() < 2);
    for start in ends.chain(0..links.len()) {
        if seen[start] {
            continue;
        }
        closed |= links[start].len() == 2;
        let mut path = Vec::new();
        let mut at = Some(start);
        while let Some(i) = at {
            seen[i] = true;
            path.push(i);
            at = links[i].iter().copied().find(|&k| !seen[k]);
        }
        paths.push(path);
    }
    (paths, closed)
}

/// Joins path ends across gaps, the cheapest first, while both ends point across. Single points join too.
fn join_ends(points: &[SpinePoint], pieces: &mut Vec<Vec<usize>>, radius_mm: f64) {
    loop {
        let mut best: Option<(f64, usize, bool, usize, bool)> = None;
        for a in 0..pieces.len() {
            for b in a + 1..pieces.len() {
                for (end_a, end_b) in [(false, false), (false, true), (true, false), (true, true)] {
                    let cost = gap_cost(points, (&pieces[a], end_a), (&pieces[b], end_b), radius_mm);
                    if cost.is_some_and(|c| best.is_none_or(|(least, ..)| c < least)) {
                        best = cost.map(|c| (c, a, end_a, b, end_b));
                    }
                }
            }
        }
        let Some((_, a, end_a, b, end_b)) = best else { return };
        let mut tail = pieces.remove(b);
        if end_b {
            tail.reverse();
        }
        if !end_a {
            pieces[a].reverse();
        }
        pieces[a].append(&mut tail);
    }
}

/// Cost of a bridge between two ends (`true`: the last point of the piece); None when it may not be.
fn gap_cost(points: &[SpinePoint], a: (&[usize], bool), b: (&[usize], bool), radius_mm: f64) -> Option<f64> {
    let (from, out_a) = end(points, a)?;
    let (to, out_b) = end(points, b)?;
    let gap = to - from;
    let distance = gap.norm();
    if distance > GAP_RADII * radius_mm {
        return None;
    }
    let across = gap / distance.max(1e-12);
    let cosine = |out: Option<Vector3<f64>>, across: Vector3<f64>| out.map_or(1.0, |out| out.dot(&across));
    let (one, other) = (cosine(out_a, across), cosine(out_b, -across));
    // A bend may be hidden in the gap: 0.8 lets both ends look past each other by 66 degrees. Close by, the
    // neighbourhood's noise decides the direction: any forward one will do.
    let least = if distance < 1.5 * radius_mm { 0.0 } else { 0.8 };
    (one >= 0.0 && other >= 0.0 && one + other >= least).then_some(distance * (3.0 - one - other))
}

/// Position of an end and the direction in which the piece would go on (none for a single point).
fn end(
    points: &[SpinePoint],
    (piece, last): (&[usize], bool),
) -> Option<(Point3<f64>, Option<Vector3<f64>>)> {
    let at = if last { *piece.last()? } else { *piece.first()? };
    if piece.len() < 2 {
        return Some((points[at].point, None));
    }
    let inner = if last { piece[piece.len() - 2] } else { piece[1] };
    let outward = points[at].point - points[inner].point;
    let tangent = points[at].tangent;
    Some((points[at].point, Some(tangent * tangent.dot(&outward).signum())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn on_circle(turns: impl Iterator<Item = f64>) -> Vec<SpinePoint> {
        let at = |t: f64| SpinePoint {
            point: Point3::new(100.0 * t.cos(), 100.0 * t.sin(), 5.0 * t),
            tangent: Vector3::new(-100.0 * t.sin(), 100.0 * t.cos(), 5.0).normalize(),
        };
        turns.map(at).collect()
    }

    proptest! {
        #[test]
        fn an_open_curve_comes_out_in_order_whatever_the_order_of_its_points(
            shuffle in Just((0..150usize).collect::<Vec<_>>()).prop_shuffle(),
        ) {
            let ordered = on_circle((0..150).map(|i| i as f64 * 0.03 + 0.008 * (i as f64 * 1.7).sin()));
            let points: Vec<SpinePoint> = shuffle.iter().map(|&i| ordered[i]).collect();
            let chains = connect(&points, 3.0, 10.0);
            prop_assert_eq!(chains.chains.len(), 1);
            prop_assert!(!chains.closed);
            let expected: Vec<Point3<f64>> = ordered.iter().map(|s| s.point).collect();
            let mut found = chains.chains[0].clone();
            if found[0] != expected[0] {
                found.reverse();
            }
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn a_gap_is_bridged_and_two_curves_stay_two() {
        let gap = on_circle((0..100).filter(|i| !(40..60).contains(i)).map(|i| i as f64 * 0.03));
        let chains = connect(&gap, 3.0, 10.0);
        assert_eq!(chains.chains.len(), 1);
        let mut two = on_circle((0..50).map(|i| i as f64 * 0.03));
        let moved = two.clone().into_iter().map(|s| SpinePoint { point: s.point + Vector3::z() * 50.0, ..s });
        two.extend(moved);
        assert_eq!(connect(&two, 3.0, 10.0).chains.len(), 2);
    }

    #[test]
    fn a_ring_is_reported_as_closed() {
        let ring = on_circle((0..200).map(|i| i as f64 * std::f64::consts::TAU / 200.0));
        let flat: Vec<SpinePoint> = ring
            .into_iter()
            .map(|s| SpinePoint { point: Point3::new(s.point.x, s.point.y, 0.0), ..s })
            .collect();
        assert!(connect(&flat, 3.2, 10.0).closed);
    }
}
