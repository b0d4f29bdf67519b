//! The scanned points on the tube from three sides, along the main axes of its spine, all to one scale as in a drawing.

use std::fmt::{Result, Write};

use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};

use super::Scale;
use super::colour::{CLASSES, class_colour};
use super::surface::{Spot, Surface, thin};
use super::svg::{line, polyline, text};
use crate::tube::{Segment, SegmentKind, Spine};

/// Points that are drawn at most, on the tube and of the surroundings.
const MOST_SPOTS: usize = 18_000;
const MOST_OTHERS: usize = 3_000;

/// Layers of dots, even.
const LAYERS: usize = 6;

const WIDTH: f64 = 1100.0;
const MOST_HIGH: f64 = 620.0;
/// Around every view, for numbers.
const MARGIN: f64 = 44.0;

/// Looking at the tube from one side.
struct View {
    title: &'static str,
    right: Vector3<f64>,
    up: Vector3<f64>,
    /// Towards the eye.
    eye: Vector3<f64>,
    /// What is in the middle, and where that is.
    centre: Point3<f64>,
    middle: (f64, f64),
    /// Half its width and height.
    half: (f64, f64),
    scale: f64,
    /// Width of a point's dot.
    dot: f64,
}

impl View {
    fn place(&self, p: &Point3<f64>) -> (f64, f64) {
        let d = p - self.centre;
        (self.middle.0 + self.scale * d.dot(&self.right), self.middle.1 - self.scale * d.dot(&self.up))
    }

    fn shows(&self, (x, y): (f64, f64)) -> bool {
        (x - self.middle.0).abs() <= self.half.0 && (y - self.middle.1).abs() <= self.half.1
    }
}

/// Draws the views one below and beside the other: width 1100; the height is returned.
pub fn draw(
    svg: &mut String,
    spine: &Spine,
    surface: &Surface,
    scale: &Scale,
    radius_mm: f64,
) -> std::result::Result<f64, std::fmt::Error> {
    let spots: Vec<Spot> = thin(surface.spots.len(), MOST_SPOTS).map(|i| surface.spots[i]).collect();
    let others: Vec<Point3<f64>> =
        thin(surface.others.len(), MOST_OTHERS).map(|i| surface.others[i]).collect();
    let (views, height) = lay_out(spine, &spots, radius_mm);
    for view in &views {
        let (x, y) = (view.middle.0 - view.half.0 + 6.0, view.middle.1 - view.half.1 + 13.0);
        dots(svg, view, others.iter(), "#b9bfc6")?;
        text(svg, x, y, "class=\"halo\" fill=\"#57606a\"", view.title)?;
        tube(svg, view, spine, &spots, scale, radius_mm)?;
        marks(svg, view, spine, radius_mm)?;
    }
    ruler(svg, views[0].scale, height)?;
    Ok(height)
}

/// Three views in first-angle order: from the front, from above below it, from the side at its right.
fn lay_out(spine: &Spine, spots: &[Spot], radius_mm: f64) -> ([View; 3], f64) {
    let line = spine.sampled((spine.length_mm() / 500.0).max(1e-3));
    let [long, wide, flat] = main_axes(&line);
    // From where more of the points are seen.
    let seen = |from: &Vector3<f64>| spots.iter().filter(|s| s.outward.dot(from) > 0.0).count();
    let facing = |axis: Vector3<f64>| if seen(&axis) >= seen(&-axis) { axis } else { -axis };
    let (front, above) = (facing(flat), facing(wide));
    let right = above.cross(&front);
    let side = facing(long);
    let extent = |axis: &Vector3<f64>| {
        let along = line.iter().map(|p| p.coords.dot(axis));
        let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        ((low + high) / 2.0, high - low + 2.0 * radius_mm)
    };
    let ((x, w), (y, h), (z, d)) = (extent(&right), extent(&above), extent(&front));
    let centre = Point3::from(right * x + above * y + front * z);
    let scale = ((WIDTH - 4.0 * MARGIN) / (w + d)).min((MOST_HIGH - 4.0 * MARGIN) / (h + d));
    // About half of the points face the eye: their dots are to cover the tube.
    let area = 2.0 * radius_mm * spine.length_mm() * scale * scale;
    let dot = (1.3 * (2.0 * area / spots.len().max(1) as f64).sqrt()).clamp(1.5, 4.0);
    let half = |a: f64, b: f64| (scale * a / 2.0 + MARGIN, scale * b / 2.0 + MARGIN);
    let (of_front, of_above, of_side) = (half(w, h), half(w, d), half(d, h));
    let slack = (WIDTH - 2.0 * (of_front.0 + of_side.0)) / 2.0;
    let middle_front = (slack + of_front.0, of_front.1);
    let view = |title, right, up, eye, middle, half| View {
        title,
        right,
        up,
        eye,
        centre,
        middle,
        half,
        scale,
        dot,
    };
    let views = [
        view("from the front", right, above, front, middle_front, of_front),
        view("from above", right, -front, above, (middle_front.0, 2.0 * of_front.1 + of_above.1), of_above),
        view(
            if side.dot(&right) < 0.0 { "from the left" } else { "from the right" },
            above.cross(&side),
            above,
            side,
            (slack + 2.0 * of_front.0 + of_side.0, of_front.1),
            of_side,
        ),
    ];
    (views, 2.0 * (of_front.1 + of_above.1))
}

/// Axes of the largest, middle and least extent.
fn main_axes(line: &[Point3<f64>]) -> [Vector3<f64>; 3] {
    let mean = line.iter().map(|p| p.coords).sum::<Vector3<f64>>() / line.len().max(1) as f64;
    let spread = |p: &Point3<f64>| (p.coords - mean) * (p.coords - mean).transpose();
    let eigen = SymmetricEigen::new(line.iter().map(spread).sum::<Matrix3<f64>>());
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    order.map(|k| eigen.eigenvectors.column(k).into_owned())
}

/// The tube segment by segment, the nearest last: its outline, and the points that face the eye.
fn tube(
    svg: &mut String,
    view: &View,
    spine: &Spine,
    spots: &[Spot],
    scale: &Scale,
    radius_mm: f64,
) -> Result {
    let middle = |s: &Segment| s.frame_at(s.length_mm / 2.0).translation.vector.dot(&view.eye);
    let mut order: Vec<usize> = (0..spine.segments().len()).collect();
    order.sort_by(|a, b| middle(&spine.segments()[*a]).total_cmp(&middle(&spine.segments()[*b])));
    let wide = 2.0 * radius_mm * view.scale;
    for k in order {
        let line = view_line(view, &spine.segments()[k]);
        let style = "stroke-linejoin=\"round\" stroke-width";
        polyline(svg, &line, &format!("stroke=\"#c5ccd3\" {style}=\"{:.1}\"", wide + 1.4))?;
        polyline(svg, &line, &format!("stroke=\"#f7f8fa\" {style}=\"{wide:.1}\""))?;
        let mine: Vec<&Spot> =
            spots.iter().filter(|s| s.segment == k && s.outward.dot(&view.eye) > 0.05).collect();
        layers(svg, view, &mine, scale)?;
    }
    Ok(())
}

/// Dots cover others: in layers that begin with either end of the scale in turn, so that no colour is on top of all.
fn layers(svg: &mut String, view: &View, spots: &[&Spot], scale: &Scale) -> Result {
    for layer in 0..LAYERS {
        for k in 0..CLASSES {
            let class = if layer % 2 == 0 { k } else { CLASSES - 1 - k };
            let mine = spots.iter().skip(layer).step_by(LAYERS);
            let mine = mine.filter(|s| scale.class(s.deviation_mm) == class);
            dots(svg, view, mine.map(|s| &s.point), &class_colour(class))?;
        }
    }
    Ok(())
}

fn view_line(view: &View, segment: &Segment) -> Vec<(f64, f64)> {
    let steps = if segment.kind == SegmentKind::Line { 1 } else { 40 };
    let at = |k: usize| segment.frame_at(segment.length_mm * k as f64 / steps as f64).translation.vector;
    (0..=steps).map(|k| view.place(&at(k).into())).collect()
}

fn dots<'a>(
    svg: &mut String,
    view: &View,
    points: impl Iterator<Item = &'a Point3<f64>>,
    colour: &str,
) -> Result {
    let mut path = String::new();
    for (x, y) in points.map(|p| view.place(p)).filter(|p| view.shows(*p)) {
        write!(path, "M{x:.1} {y:.1}h0")?;
    }
    if path.is_empty() {
        return Ok(());
    }
    let style = format!("stroke-width=\"{:.1}\" stroke-linecap=\"round\" fill=\"none\"", view.dot);
    writeln!(svg, "<path d=\"{path}\" stroke=\"{colour}\" {style}/>")
}

/// Spine, tangent points, numbers of the bends, and which end is the first.
fn marks(svg: &mut String, view: &View, spine: &Spine, radius_mm: f64) -> Result {
    for segment in spine.segments() {
        let style = "stroke=\"#24292f\" stroke-width=\"0.9\" stroke-dasharray=\"9 2.5 2 2.5\"";
        polyline(svg, &view_line(view, segment), style)?;
    }
    let arcs = spine.segments().iter().filter(|s| s.kind != SegmentKind::Line);
    for (number, arc) in (1..).zip(arcs) {
        for along in [0.0, arc.length_mm] {
            let (x, y) = view.place(&arc.frame_at(along).translation.vector.into());
            writeln!(
                svg,
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.8\" fill=\"#ffffff\" stroke=\"#24292f\" stroke-width=\"1.1\"/>"
            )?;
        }
        let outward = arc.frame_at(arc.length_mm / 2.0);
        badge(svg, view, &outward.translation.vector.into(), &-(outward * Vector3::y()), radius_mm, number)?;
    }
    let end = spine.frame_at(spine.length_mm());
    let start = spine.frame_at(0.0);
    let ends = [(start, -(start * Vector3::x()), "first end"), (end, end * Vector3::x(), "last end")];
    // Where an end points at the eye or away from it, its name would lie on the tube.
    for (frame, away, words) in ends.iter().filter(|e| e.1.dot(&view.eye).abs() < 0.9) {
        let (x, y) = beside(view, &frame.translation.vector.into(), away, 4.0);
        text(
            svg,
            x,
            y + 4.0,
            "text-anchor=\"middle\" font-size=\"12\" fill=\"#24292f\" class=\"halo\"",
            words,
        )?;
    }
    Ok(())
}

/// A place beside a point of the spine, in a direction as far as that is seen.
fn beside(view: &View, p: &Point3<f64>, away: &Vector3<f64>, by: f64) -> (f64, f64) {
    let (x, y) = view.place(p);
    let (dx, dy) = (away.dot(&view.right), -away.dot(&view.up));
    (x + (by + 14.0) * dx, y + (by + 14.0) * dy)
}

fn badge(
    svg: &mut String,
    view: &View,
    p: &Point3<f64>,
    away: &Vector3<f64>,
    radius_mm: f64,
    number: usize,
) -> Result {
    let (x, y) = beside(view, p, away, radius_mm * view.scale);
    writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"9\" fill=\"#24292f\"/>")?;
    let style = "text-anchor=\"middle\" font-size=\"12\" font-weight=\"600\" fill=\"#ffffff\"";
    text(svg, x, y + 4.3, style, &number.to_string())
}

/// A length to compare with.
fn ruler(svg: &mut String, scale: f64, height: f64) -> Result {
    let mm = super::svg::round_step(160.0 / scale, 1.0) / 2.0;
    let (left, y) = (WIDTH - 40.0 - mm * scale, height - 18.0);
    let style = "stroke=\"#24292f\" stroke-width=\"1.2\"";
    line(svg, (left, y), (WIDTH - 40.0, y), style)?;
    for x in [left, WIDTH - 40.0] {
        line(svg, (x, y - 4.0), (x, y + 4.0), style)?;
    }
    let words = format!("{mm} mm");
    text(svg, left + mm * scale / 2.0, y - 7.0, "text-anchor=\"middle\" font-size=\"12\"", &words)
}
