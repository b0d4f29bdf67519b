//! How far a tube's ends reach: as far as points lie on the surface of the straight there. The centre line of the scene is
//! drawn on so far, that the points there are taken for the tube's; and a tube that is being searched is lengthened and
//! shortened so, since no fit moves its ends.
//!
//! Used by `scene` and `structure`; exact ends are found later, by [`ends`](super::ends).

use nalgebra::{Point3, UnitQuaternion, Vector3};

use super::model::TubeModel;
use crate::cloud::PointCloud;
use crate::tube::{Bend, Frame};

/// Points this near to the surface of an end straight are its own. It goes on while stretches of this length, in tube radii,
/// hold such a share of the points that the one before them does; one that holds less than such a share of what is usual
/// is not its own.
const OWN_SHARE: f64 = 0.1;
const STRETCH_RADII: f64 = 0.5;
const LEAST_DENSITY: f64 = 0.3;
const EMPTY_DENSITY: f64 = 0.1;

/// So many stretches in a row may be hidden at a tube's end.
const HIDDEN_STRETCHES: usize = 4;

/// The end of a centre line in tube radii that tells its direction, how straight it must be, and how far it is drawn on.
const END_RADII: f64 = 3.0;
const STRAIGHT_SHARE: f64 = 0.03;
const MOST_RADII: f64 = 12.0;

/// It stops so far before the end: what lies so near is taken anyway, and burr and bore begin there.
const WITHIN_RADII: f64 = 0.5;

/// A centre line with vertices about `spacing_mm` apart, drawn on past its ends as far as the points go on. They are to be
/// without planar faces: a table that the tube lies on goes on as well. And those of its ends beyond which points go on behind
/// a stretch without: they may be the tube's, or something else's that was made to fit it.
pub fn drawn_on(
    mut polygon: Vec<Point3<f64>>,
    spacing_mm: f64,
    radius_mm: f64,
    points: &PointCloud,
) -> (Vec<Point3<f64>>, Vec<Point3<f64>>) {
    let mut hidden = Vec::new();
    for _ in 0..2 {
        polygon.reverse();
        if let Some(end) = straight_end(&polygon, radius_mm) {
            let counts = Counts::new(points.iter(), &end, radius_mm, END_RADII * radius_mm);
            let beyond_mm = counts.beyond_mm(0);
            if counts.beyond_mm(HIDDEN_STRETCHES) > beyond_mm {
                hidden.push(end * Point3::new(beyond_mm, 0.0, 0.0));
            }
            let more_mm = beyond_mm.min(MOST_RADII * radius_mm) - WITHIN_RADII * radius_mm;
            let vertices = (more_mm / spacing_mm).max(0.0) as usize;
            polygon.extend((1..=vertices).map(|k| end * Point3::new(k as f64 * spacing_mm, 0.0, 0.0)));
        }
    }
    (polygon, hidden)
}

/// The frame at a polygon's last vertex, its x axis outwards along the last few; None when they are not in line.
fn straight_end(polygon: &[Point3<f64>], radius_mm: f64) -> Option<Frame> {
    let last = polygon.last()?;
    let near = |p: &&Point3<f64>| (*p - last).norm() <= END_RADII * radius_mm;
    let end: Vec<Point3<f64>> = polygon.iter().rev().take_while(near).copied().collect();
    let n = end.len();
    if n < 4 {
        return None;
    }
    let middle =
        |part: &[Point3<f64>]| part.iter().map(|p| p.coords).sum::<Vector3<f64>>() / part.len() as f64;
    let (outer, inner) = (middle(&end[..n / 2]), middle(&end[n / 2..]));
    let along = (outer - inner).try_normalize(1e-12)?;
    let off = |p: &Point3<f64>| (p.coords - outer).cross(&along).norm();
    if end.iter().any(|p| off(p) > STRAIGHT_SHARE * radius_mm) {
        return None;
    }
    let turn = UnitQuaternion::rotation_between(&Vector3::x(), &along)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::PI));
    let foot = outer + along * (last.coords - outer).dot(&along);
    Some(Frame::from_parts(foot.into(), turn))
}

/// The tube with end straights that reach as far as its points do, and no farther.
pub fn reaching(model: &TubeModel, points: &[Point3<f64>]) -> TubeModel {
    let spine = model.spine();
    let radius = model.tube_radius_mm;
    let usual = points.len() as f64 * STRETCH_RADII * radius / spine.length_mm().max(radius);
    let change_mm = |end: &Frame, length_mm: f64| {
        let counts = Counts::new(points.iter().copied(), end, radius, length_mm);
        let short_mm = counts.empty_mm(usual).min(length_mm);
        if short_mm > 0.0 { -short_mm } else { counts.beyond_mm(0) }
    };
    let mut out = model.clone();
    out.lra.last_length_mm += change_mm(&spine.frame_at(spine.length_mm()), model.lra.last_length_mm);
    if let Some(first) = out.lra.bends.first_mut() {
        let outward = model.start * Frame::rotation(Vector3::new(0.0, std::f64::consts::PI, 0.0));
        let before_mm = change_mm(&outward, first.length_mm);
        first.length_mm += before_mm;
        out.start *= Frame::translation(-before_mm, 0.0, 0.0);
    }
    let none_left = |first: &Bend| first.length_mm <= 0.0 || out.lra.last_length_mm <= 0.0;
    if out.lra.bends.first().is_some_and(none_left) { trimmed(&out, points) } else { out }
}

/// The tube without those parts of its first and last arcs that lie beyond its points: nothing else holds them back.
fn trimmed(model: &TubeModel, points: &[Point3<f64>]) -> TubeModel {
    let spine = model.spine();
    let radius = model.tube_radius_mm;
    let stretch_mm = STRETCH_RADII * radius;
    let mut counts = vec![0usize; (spine.length_mm() / stretch_mm) as usize + 1];
    for p in points {
        let at = spine.closest(p);
        if (at.distance_mm - radius).abs() < OWN_SHARE * radius {
            counts[(at.arc_length_mm / stretch_mm) as usize] += 1;
        }
    }
    let usual = points.len() as f64 / counts.len() as f64;
    let holds = |c: &usize| *c as f64 > EMPTY_DENSITY * usual;
    let (Some(first), Some(last)) = (counts.iter().position(holds), counts.iter().rposition(holds)) else {
        return model.clone();
    };
    let (from_mm, to_mm) = (first as f64 * stretch_mm, (last + 1) as f64 * stretch_mm);
    let mut out = model.clone();
    let n = out.lra.bends.len();
    let share = |i: usize, from: f64, to: f64| {
        let arc = &spine.segments()[2 * i + 1];
        let share = (to.min(arc.start_mm + arc.length_mm) - from.max(arc.start_mm)) / arc.length_mm;
        if share > 0.0 && share < 1.0 { share } else { 1.0 }
    };
    if n > 0 && out.lra.last_length_mm <= 0.0 {
        out.lra.bends[n - 1].angle_rad *= share(n - 1, 0.0, to_mm);
    }
    if n > 0 && out.lra.bends[0].length_mm <= 0.0 {
        let share = share(0, from_mm, f64::INFINITY);
        out.start = spine.frame_at((1.0 - share) * spine.segments()[1].length_mm);
        out.lra.bends[0].angle_rad *= share;
    }
    out
}

/// How many points the stretches about an end hold, outwards.
struct Counts {
    stretch_mm: f64,
    inside: usize,
    counts: Vec<usize>,
}

impl Counts {
    /// About the origin of a frame whose x axis points outwards, from `length_mm` before it.
    fn new(points: impl Iterator<Item = Point3<f64>>, end: &Frame, radius_mm: f64, length_mm: f64) -> Counts {
        let stretch_mm = STRETCH_RADII * radius_mm;
        let inside = ((length_mm / stretch_mm).ceil() as usize).max(1);
        let mut counts = vec![0; inside];
        let inverse = end.inverse();
        for p in points.map(|p| inverse * p) {
            let stretch = (p.x / stretch_mm).floor() + inside as f64;
            if stretch >= 0.0 && (p.y.hypot(p.z) - radius_mm).abs() < OWN_SHARE * radius_mm {
                let stretch = stretch as usize;
                counts.resize(counts.len().max(stretch + 1), 0);
                counts[stretch] += 1;
            }
        }
        Counts { stretch_mm, inside, counts }
    }

    /// How far the points go on beyond the end, over at most so many stretches in a row without.
    fn beyond_mm(&self, hidden: usize) -> f64 {
        let last = self.counts[self.inside - 1] as f64;
        let mut reached = 0;
        for (i, count) in self.counts[self.inside..].iter().enumerate() {
            if *count as f64 > LEAST_DENSITY * last {
                reached = i + 1;
            } else if i + 1 - reached > hidden {
                break;
            }
        }
        reached as f64 * self.stretch_mm
    }

    /// How far the end is beyond the last stretch that is not empty.
    fn empty_mm(&self, usual: f64) -> f64 {
        let holds = |c: &usize| *c as f64 > EMPTY_DENSITY * usual;
        let last = self.counts[..self.inside].iter().rposition(holds);
        (self.inside - last.map_or(0, |i| i + 1)) as f64 * self.stretch_mm
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::Lra;

    const RADIUS: f64 = 10.0;

    fn tube(first_mm: f64, last_mm: f64) -> TubeModel {
        let bend = Bend { length_mm: first_mm, rotation_rad: 0.0, angle_rad: 1.0, radius_mm: 40.0 };
        let lra = Lra { bends: vec![bend], last_length_mm: last_mm };
        TubeModel::round(Frame::translation(-first_mm, 0.0, 0.0), lra, RADIUS)
    }

    /// Points of half the surface between two places along it.
    fn points(model: &TubeModel, from_mm: f64, to_mm: f64) -> Vec<Point3<f64>> {
        let spine = model.spine();
        let place = |i: usize| {
            let at = from_mm + (to_mm - from_mm) * (0.618_034 * i as f64).fract();
            let turn = 3.0 * (0.414_214 * i as f64).fract();
            spine.frame_at(at) * Point3::new(0.0, RADIUS * turn.cos(), RADIUS * turn.sin())
        };
        (0..4000).map(place).collect()
    }

    #[test]
    fn straights_that_are_too_long_are_cut_to_where_the_points_stop() {
        let whole = tube(100.0, 80.0);
        let long = tube(160.0, 145.0);
        let cut = reaching(&long, &points(&whole, 0.0, whole.spine().length_mm()));
        let lengths = [(cut.lra.bends[0].length_mm, 100.0), (cut.lra.last_length_mm, 80.0)];
        assert!(lengths.iter().all(|(found, right)| (found - right).abs() <= 5.0), "{lengths:?}");
        let corner = |m: &TubeModel| m.spine().segments()[1].start * Point3::origin();
        assert!((corner(&cut) - corner(&whole)).norm() < 1e-9, "the bend stays where it is");
    }

    #[test]
    fn arcs_without_points_are_cut_off() {
        let mut model = tube(100.0, 0.0);
        let seen = points(&model, 0.0, model.spine().length_mm());
        model.lra.bends[0].angle_rad = 4.0;
        let cut = reaching(&model, &seen).lra.bends[0].angle_rad;
        assert!((1.0..1.2).contains(&cut), "{cut}");
        // The same from the other side.
        let mut turned = tube(0.0, 100.0);
        let (spine, length_mm) = (turned.spine(), turned.spine().length_mm());
        let seen = points(&turned, 0.0, length_mm);
        turned.lra.bends[0].angle_rad = 4.0;
        turned.start = Frame::identity();
        let off = spine.frame_at(length_mm);
        let end = turned.spine().frame_at(160.0);
        turned.start = off * Frame::translation(-100.0, 0.0, 0.0) * end.inverse();
        let cut = reaching(&turned, &seen);
        assert!((1.0..1.2).contains(&cut.lra.bends[0].angle_rad), "{cut:?}");
        let last = cut.spine().frame_at(cut.spine().length_mm());
        assert!((last.translation.vector - off.translation.vector).norm() < 1e-6);
    }

    #[test]
    fn a_centre_line_is_drawn_on_along_its_points_and_no_farther() {
        let straight: Vec<Point3<f64>> = (0..20).map(|i| Point3::new(3.0 * f64::from(i), 0.0, 0.0)).collect();
        // The straight's points from -60 to 100; the polygon goes from 0 to 57.
        let mut seen = points(&tube(500.0, 80.0), 240.0, 400.0);
        seen.iter_mut().for_each(|p| p.x += 200.0);
        let (on, hidden) = drawn_on(straight, 3.0, RADIUS, &PointCloud::from_points(&seen));
        assert!(hidden.is_empty());
        let (low, high) = on.iter().fold((0.0_f64, 0.0_f64), |(a, b), p| (a.min(p.x), b.max(p.x)));
        assert!((-60.0..-45.0).contains(&low), "{low}");
        assert!((85.0..100.0).contains(&high), "{high}");
        assert!(on.iter().all(|p| p.y.hypot(p.z) < 0.1));
    }

    #[test]
    fn an_end_behind_which_more_was_scanned_is_told() {
        let straight: Vec<Point3<f64>> = (0..20).map(|i| Point3::new(3.0 * f64::from(i), 0.0, 0.0)).collect();
        let ends_after = |gap_mm: f64| {
            let mut seen = points(&tube(500.0, 80.0), 200.0, 260.0);
            seen.extend(points(&tube(500.0, 80.0), 260.0 + gap_mm, 270.0 + gap_mm));
            seen.iter_mut().for_each(|p| p.x += 300.0);
            drawn_on(straight.clone(), 3.0, RADIUS, &PointCloud::from_points(&seen)).1
        };
        let hidden = ends_after(15.0);
        assert!(hidden.len() == 1 && (50.0..65.0).contains(&hidden[0].x), "{hidden:?}");
        assert!(ends_after(40.0).is_empty(), "so far away it is something else");
    }
}
