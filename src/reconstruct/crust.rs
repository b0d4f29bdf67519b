//! A polygon through the spine points: NN-Crust (T. K. Dey and P. Kumar, "A simple provable algorithm for curve
//! reconstruction", SODA 1999), made safe for open curves with gaps.
//!
//! Every point is joined to its nearest neighbour and to the nearest one on the other side. Edges that both
//! ends want make paths; paths are then joined end to end across what the scanner did not see.

use std::collections::BinaryHeap;

use nalgebra::{Point3, Vector3};

use super::follow::TIGHTEST_RADII;
use super::mls::SpinePoint;
use crate::cloud::{Neighbours, PointCloud};

/// A gap is bridged up to this many tube radii, when both ends point across it.
const GAP_RADII: f64 = 10.0;

/// Edges of the crust itself are no longer than this many spacings.
const REACH_SPACINGS: f64 = 4.0;

/// The way that a chain goes is told over this many tube radii, to about such an angle; lines that meet at less are parallel; and
/// where they meet is told to so many tube radii.
const DIRECTION_RADII: f64 = 2.0;
const ASTRAY: f64 = 0.15;
const PARALLEL: f64 = 0.2;
const SLACK_RADII: f64 = 0.5;

/// Neighbours that may be the nearest and the half neighbour.
const LOOKED_AT: usize = 24;

/// Ends near an end that may be across a gap from it.
const ENDS_LOOKED_AT: usize = 48;

/// Length of a polygon without its bridges: what was really seen.
pub fn solid_length_mm(chain: &[Point3<f64>], spacing_mm: f64) -> f64 {
    chain.windows(2).map(|w| (w[1] - w[0]).norm()).filter(|l| *l < REACH_SPACINGS * spacing_mm).sum()
}

/// Length of a polygon.
pub fn length_mm(chain: &[Point3<f64>]) -> f64 {
    chain.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
}

/// Whether a chain ends where it began: nearer than two ends of tubes can come.
pub fn is_closed(chain: &[Point3<f64>], spacing_mm: f64, radius_mm: f64) -> bool {
    let (Some(first), Some(last)) = (chain.first(), chain.last()) else { return false };
    (last - first).norm() < REACH_SPACINGS * spacing_mm && length_mm(chain) > 6.0 * radius_mm
}

/// A chain that leads straight on from its end to its own begin, over less of a gap than it has itself, with its ends where that one
/// was: a tube whose ends come near each other, seen in two pieces that were joined the wrong way round.
pub fn opened(mut chain: Vec<Point3<f64>>, spacing_mm: f64, radius_mm: f64) -> Vec<Point3<f64>> {
    let gap_mm = |i: &usize| (chain[*i] - chain[i - 1]).norm();
    let Some(widest) = (1..chain.len()).max_by(|a, b| gap_mm(a).total_cmp(&gap_mm(b))) else { return chain };
    let widest_mm = gap_mm(&widest);
    let around_mm = (chain[0] - chain[chain.len() - 1]).norm();
    let is_bridge = widest_mm >= REACH_SPACINGS * spacing_mm && around_mm < widest_mm;
    if is_bridge && is_straight_across(&chain, &chain, radius_mm) {
        chain.rotate_left(widest);
    }
    chain
}

/// A chain without the pieces between two gaps that are shorter than either and than a tube radius, where the gap without
/// such a piece may be one bend's: a scrap of a jaw that hides the tube there.
pub fn without_scraps(mut chain: Vec<Point3<f64>>, spacing_mm: f64, radius_mm: f64) -> Vec<Point3<f64>> {
    let mut from = None;
    let mut i = 1;
    while i < chain.len() {
        let gap_mm = (chain[i] - chain[i - 1]).norm();
        if gap_mm < REACH_SPACINGS * spacing_mm {
            i += 1;
            continue;
        }
        if let Some((begin, before_mm)) = from {
            let length_mm = length_mm(&chain[begin..i]);
            let is_scrap = length_mm < radius_mm.min(gap_mm).min(before_mm);
            if is_scrap && is_across_one_bend(&chain[..begin], &chain[i..], radius_mm) {
                chain.drain(begin..i);
                (from, i) = (Some((begin, (chain[begin] - chain[begin - 1]).norm())), begin + 1);
                continue;
            }
        }
        (from, i) = (Some((i, gap_mm)), i + 1);
    }
    chain
}

/// A chain without scraps at its ends: what is shorter than the gap before it, and than a tube radius or where no single bend
/// leads across the gap, is no continuation that anyone could vouch for.
pub fn trimmed(mut chain: Vec<Point3<f64>>, spacing_mm: f64, radius_mm: f64) -> Vec<Point3<f64>> {
    for _ in 0..2 {
        chain.reverse();
        while let Some(sound) = sound(&chain, spacing_mm, radius_mm) {
            chain.truncate(sound);
        }
    }
    chain
}

/// How many of a chain's points there are before a gap that only a scrap lies behind; the first such gap.
fn sound(chain: &[Point3<f64>], spacing_mm: f64, radius_mm: f64) -> Option<usize> {
    let scrap = |i: &usize| {
        let (before, behind) = chain.split_at(*i);
        let gap_mm = (behind[0] - before[i - 1]).norm();
        let length_mm = solid_length_mm(behind, spacing_mm);
        gap_mm >= REACH_SPACINGS * spacing_mm
            && length_mm < gap_mm
            && (length_mm < radius_mm || !is_across_one_bend(before, behind, radius_mm))
    };
    (1..chain.len()).find(scrap)
}

/// Direction from a point along the way that begins there.
fn heading<'a>(
    from: Point3<f64>,
    way: impl Iterator<Item = &'a Point3<f64>>,
    radius_mm: f64,
) -> Option<Vector3<f64>> {
    let mut along = Vector3::zeros();
    for p in way {
        along = p - from;
        if along.norm() > DIRECTION_RADII * radius_mm {
            break;
        }
    }
    along.try_normalize(1e-12)
}

/// A gap between the end of one piece and the begin of another.
struct Across {
    /// The way that the one piece leaves.
    out: Vector3<f64>,
    /// The way that the other goes on.
    on: Vector3<f64>,
    /// From end to begin.
    gap: Vector3<f64>,
}

impl Across {
    /// None where a piece is too short to have a way.
    fn of(before: &[Point3<f64>], behind: &[Point3<f64>], radius_mm: f64) -> Option<Across> {
        let (from, to) = (before[before.len() - 1], behind[0]);
        let back = heading(from, before.iter().rev(), radius_mm)?;
        Some(Across { out: -back, on: heading(to, behind.iter(), radius_mm)?, gap: to - from })
    }
}

/// Whether a straight or one bend leads from the end of one piece to the begin of another.
fn is_across_one_bend(before: &[Point3<f64>], behind: &[Point3<f64>], radius_mm: f64) -> bool {
    let Some(Across { out, on, gap }) = Across::of(before, behind, radius_mm) else { return true };
    let cos = out.dot(&on);
    let tangent_mm = TIGHTEST_RADII * radius_mm * ((1.0 - cos) / (1.0 + cos).max(1e-3)).sqrt();
    // The two lines are nearest to each other where the bend's corner is.
    let square = 1.0 - cos * cos;
    let slack_mm = SLACK_RADII * radius_mm + ASTRAY * gap.norm();
    if square < PARALLEL * PARALLEL {
        let aside_mm = gap.cross(&out).norm();
        return if cos > 0.0 {
            aside_mm < slack_mm
        } else {
            aside_mm > 2.0 * TIGHTEST_RADII * radius_mm - slack_mm
        };
    }
    let (along_out, along_on) = (gap.dot(&out), gap.dot(&on));
    let before_mm = (along_out - cos * along_on) / square;
    let behind_mm = (along_on - cos * along_out) / square;
    let skew_mm = (gap - out * before_mm - on * behind_mm).norm();
    skew_mm < slack_mm && before_mm.min(behind_mm) > tangent_mm - slack_mm
}

/// Whether a straight leads from the end of one piece to the begin of another.
fn is_straight_across(before: &[Point3<f64>], behind: &[Point3<f64>], radius_mm: f64) -> bool {
    let Some(Across { out, on, gap }) = Across::of(before, behind, radius_mm) else { return false };
    let slack_mm = SLACK_RADII * radius_mm + ASTRAY * gap.norm();
    out.dot(&on) > 0.0
        && gap.dot(&out) > 0.0
        && out.cross(&on).norm() < PARALLEL
        && gap.cross(&out).norm() < slack_mm
}

/// Joins points spaced by about `spacing_mm` on tubes of radius `radius_mm` to polygons, the longest first.
pub fn connect(points: &[SpinePoint], spacing_mm: f64, radius_mm: f64) -> Vec<Vec<Point3<f64>>> {
    let wanted = wanted_edges(points, REACH_SPACINGS * spacing_mm);
    let mutual = |a: usize, b: usize| wanted[a].contains(&Some(b)) && wanted[b].contains(&Some(a));
    let links: Vec<Vec<usize>> = (0..points.len())
        .map(|a| wanted[a].iter().flatten().copied().filter(|&b| mutual(a, b)).collect())
        .collect();
    let mut pieces = walk(&links);
    join_ends(points, &mut pieces, radius_mm);
    let mut chains: Vec<Vec<Point3<f64>>> =
        pieces.into_iter().map(|piece| piece.into_iter().map(|i| points[i].point).collect()).collect();
    let solid = |c: &Vec<Point3<f64>>| solid_length_mm(c, spacing_mm);
    chains.sort_by(|a, b| solid(b).total_cmp(&solid(a)));
    chains
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

/// Paths of a graph whose nodes have at most two links; a circle is opened where it is entered.
fn walk(links: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let mut seen = vec![false; links.len()];
    let mut paths = Vec::new();
    let ends = (0..links.len()).filter(|&i| links[i].len() < 2);
    for start in ends.chain(0..links.len()) {
        if seen[start] {
            continue;
        }
        let mut path = Vec::new();
        let mut at = Some(start);
        while let Some(i) = at {
            seen[i] = true;
            path.push(i);
            at = links[i].iter().copied().find(|&k| !seen[k]);
        }
        paths.push(path);
    }
    paths
}

/// An end of a piece, and whether it is the last of its points. A single point has two.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct End {
    piece: usize,
    last: bool,
}

/// Joins path ends across gaps, the cheapest first, while both ends point across. Single points join too.
///
/// Only ends among each other's nearest are looked at, so the cost is about linear in the number of pieces. A bridge's
/// cost can only rise by what was joined before (a single point gets a direction), so a bridge is weighed
/// again when its turn comes.
fn join_ends(points: &[SpinePoint], pieces: &mut Vec<Vec<usize>>, radius_mm: f64) {
    let mut bridges = possible_bridges(points, pieces, radius_mm);
    // Where each original end is now; None once it lies inside a piece.
    let mut home: Vec<[Option<End>; 2]> = (0..pieces.len())
        .map(|piece| [Some(End { piece, last: false }), Some(End { piece, last: true })])
        .collect();
    while let Some(std::cmp::Reverse((Cost(old), a, b))) = bridges.pop() {
        let now = |end: End| home[end.piece][usize::from(end.last)];
        let (Some(at_a), Some(at_b)) = (now(a), now(b)) else { continue };
        if at_a.piece == at_b.piece {
            continue;
        }
        let side = |end: End| (pieces[end.piece].as_slice(), end.last);
        let Some(cost) = gap_cost(points, side(at_a), side(at_b), radius_mm) else { continue };
        if cost > old {
            bridges.push(std::cmp::Reverse((Cost(cost), a, b)));
            continue;
        }
        let mut tail = std::mem::take(&mut pieces[at_b.piece]);
        if at_b.last {
            tail.reverse();
        }
        if !at_a.last {
            pieces[at_a.piece].reverse();
        }
        pieces[at_a.piece].append(&mut tail);
        settle(&mut home, at_a, at_b);
    }
    pieces.retain(|p| !p.is_empty());
}

/// Says where the ends are after the piece of `b` was put behind that of `a`, at these ends.
fn settle(home: &mut [[Option<End>; 2]], a: End, b: End) {
    for end in home.iter_mut().flatten() {
        let Some(at) = *end else { continue };
        if at == a || at == b {
            *end = None;
        } else if at.piece == a.piece {
            *end = Some(End { piece: a.piece, last: false });
        } else if at.piece == b.piece {
            *end = Some(End { piece: a.piece, last: true });
        }
    }
}

/// A cost with an order.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Cost(f64);

impl Eq for Cost {}

impl PartialOrd for Cost {
    fn partial_cmp(&self, other: &Cost) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Cost {
    fn cmp(&self, other: &Cost) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

/// Bridges between ends, the cheapest on top.
type Bridges = BinaryHeap<std::cmp::Reverse<(Cost, End, End)>>;

fn possible_bridges(points: &[SpinePoint], pieces: &[Vec<usize>], radius_mm: f64) -> Bridges {
    let ends: Vec<(End, usize)> = pieces
        .iter()
        .enumerate()
        .flat_map(|(piece, p)| {
            [(End { piece, last: false }, p[0]), (End { piece, last: true }, p[p.len() - 1])]
        })
        .collect();
    let positions: Vec<Point3<f64>> = ends.iter().map(|e| points[e.1].point).collect();
    let index = Neighbours::new(&PointCloud::from_points(&positions));
    let mut bridges = Bridges::new();
    for (i, &(a, _)) in ends.iter().enumerate() {
        for (k, distance) in index.nearest(&positions[i], ENDS_LOOKED_AT) {
            let (b, _) = ends[k as usize];
            if distance > GAP_RADII * radius_mm || a.piece == b.piece {
                continue;
            }
            let (a, b) = (a.min(b), a.max(b));
            let side = |end: End| (pieces[end.piece].as_slice(), end.last);
            if let Some(cost) = gap_cost(points, side(a), side(b), radius_mm) {
                bridges.push(std::cmp::Reverse((Cost(cost), a, b)));
            }
        }
    }
    bridges
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
            rms_mm: 0.0,
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
            prop_assert_eq!(chains.len(), 1);
            prop_assert!(!is_closed(&chains[0], 3.0, 10.0));
            let expected: Vec<Point3<f64>> = ordered.iter().map(|s| s.point).collect();
            let mut found = chains[0].clone();
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
        assert_eq!(chains.len(), 1);
        let mut two = on_circle((0..50).map(|i| i as f64 * 0.03));
        let moved = two.clone().into_iter().map(|s| SpinePoint { point: s.point + Vector3::z() * 50.0, ..s });
        two.extend(moved);
        assert_eq!(connect(&two, 3.0, 10.0).len(), 2);
    }

    #[test]
    fn pieces_joined_at_the_wrong_gap_are_opened_there() {
        // A hook in two pieces.
        let on = |from: Point3<f64>, way: Vector3<f64>, count: i32| {
            (0..count).map(move |i| from + way * f64::from(i))
        };
        let (x, y) = (2.0 * Vector3::x(), 2.0 * Vector3::y());
        let hook: Vec<_> = on(Point3::new(30.0, 0.0, 0.0), x, 40)
            .chain(on(Point3::new(110.0, 0.0, 0.0), y, 20))
            .chain(on(Point3::new(110.0, 40.0, 0.0), -x, 60))
            .collect();
        // Its ends are 50 mm apart; the piece before them begins behind a gap of 20 mm.
        let before = on(Point3::new(-60.0, 0.0, 0.0), x, 35);
        let right: Vec<_> = before.clone().chain(hook.clone()).collect();
        let wrong: Vec<_> = hook.into_iter().chain(before).collect();
        assert_eq!(opened(wrong, 2.0, 10.0), right);
        assert_eq!(opened(right.clone(), 2.0, 10.0), right, "as it should be");
    }

    #[test]
    fn a_scrap_beside_a_gap_is_left_out() {
        let line = |from: i32, to: i32| (from..to).map(|i| Point3::new(2.0 * f64::from(i), 0.0, 0.0));
        let scrap = [Point3::new(88.0, 12.0, 0.0), Point3::new(90.0, 12.0, 0.0)];
        let with: Vec<_> = line(0, 40).chain(scrap).chain(line(50, 90)).collect();
        let without: Vec<_> = line(0, 40).chain(line(50, 90)).collect();
        assert_eq!(without_scraps(with, 2.0, 10.0), without);
        let whole: Vec<_> = line(0, 90).collect();
        assert_eq!(without_scraps(whole.clone(), 2.0, 10.0), whole);
    }

    #[test]
    fn a_ring_is_reported_as_closed() {
        let ring = on_circle((0..200).map(|i| i as f64 * std::f64::consts::TAU / 200.0));
        let flat: Vec<SpinePoint> = ring
            .into_iter()
            .map(|s| SpinePoint { point: Point3::new(s.point.x, s.point.y, 0.0), ..s })
            .collect();
        assert!(is_closed(&connect(&flat, 3.2, 10.0)[0], 3.2, 10.0));
    }

    /// A straight along x that ends at 0, every 3 mm, and what lies behind a gap there.
    fn with_end(end: impl Iterator<Item = Point3<f64>>) -> Vec<Point3<f64>> {
        (-60..=0).map(|i| Point3::new(3.0 * f64::from(i), 0.0, 0.0)).chain(end).collect()
    }

    #[test]
    fn an_end_to_where_no_bend_leads_is_a_scrap() {
        // 18 mm behind gaps of 30 mm and more, of a tube of radius 10.
        let piece = |from: [f64; 3], to: [f64; 3]| {
            let (from, way) = (Point3::from(from), Vector3::from(to));
            with_end((0..=6).map(move |i| from + way * (3.0 * f64::from(i))))
        };
        let sound = [
            ("straight on", piece([30.0, 0.5, 0.0], [1.0, 0.0, 0.0])),
            ("around a corner", piece([25.0, 25.0, 0.0], [0.0, 1.0, 0.0])),
            ("around and back", piece([0.0, 40.0, 0.0], [-1.0, 0.0, 0.0])),
        ];
        let scraps = [
            ("back beside itself", piece([-24.0, 20.0, 0.0], [-1.0, 0.0, 0.0])),
            ("past another plane", piece([25.0, 20.0, 0.0], [0.0, 0.0, 1.0])),
            ("a sharp corner", piece([25.0, 20.0, 0.0], [-0.9, 0.436, 0.0])),
        ];
        for (what, chain) in sound {
            assert_eq!(trimmed(chain.clone(), 3.0, 10.0), chain, "{what}");
        }
        for (what, mut chain) in scraps {
            assert_eq!(trimmed(chain.clone(), 3.0, 10.0).len(), 61, "{what}");
            chain.reverse();
            assert_eq!(trimmed(chain, 3.0, 10.0).len(), 61, "{what}, at the beginning");
        }
    }
}
