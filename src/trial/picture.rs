//! A trial as one SVG: the tube with its deviations drawn larger, angle deviation per bend and envelope, part by
//! part, out of `report`'s lines and text.

use std::fmt::Write;

use nalgebra::{Point3, Vector3};

use super::record::PartRecord;
use crate::inspect::Verdict;
use crate::report::svg::{line, polyline, round_step, text};
use crate::tube::align::{Pair, register};
use crate::tube::{Frame, Lra, Nominal, Spine};

/// Deviations in the tube's panel are drawn this many times larger: a millimetre is not seen on half a metre.
const EXAGGERATION: f64 = 20.0;

/// One colour per bend, told apart also without colour vision (after Okabe and Ito).
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#4d4d4d"];

const WIDTH: f64 = 1120.0;
const HEIGHT: f64 = 430.0;
const TOP: f64 = 108.0;
const BOTTOM: f64 = 372.0;

/// A horizontal and vertical scale over one panel.
struct Panel {
    left: f64,
    right: f64,
    low: f64,
    high: f64,
    parts: usize,
}

impl Panel {
    /// Where a part's column is.
    fn x(&self, index: usize) -> f64 {
        let step = (self.right - self.left) / self.parts as f64;
        self.left + step * (index as f64 + 0.5)
    }

    fn y(&self, value: f64) -> f64 {
        BOTTOM - (value - self.low) / (self.high - self.low) * (BOTTOM - TOP)
    }
}

/// The SVG text. `title` is the line over everything.
pub fn draw(title: &str, subtitle: &str, nominal: &Nominal, parts: &[PartRecord]) -> String {
    let mut svg = String::new();
    // Writing to a String cannot fail.
    let _ = draw_into(&mut svg, title, subtitle, nominal, parts);
    svg
}

fn draw_into(
    svg: &mut String,
    title: &str,
    subtitle: &str,
    nominal: &Nominal,
    parts: &[PartRecord],
) -> std::fmt::Result {
    writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" \
         font-family=\"'DejaVu Sans', 'Segoe UI', Helvetica, Arial, sans-serif\" font-size=\"13\" fill=\"#24292f\">"
    )?;
    writeln!(svg, "<rect width=\"{WIDTH}\" height=\"{HEIGHT}\" rx=\"10\" fill=\"#ffffff\"/>")?;
    text(svg, 28.0, 38.0, "font-size=\"19\" font-weight=\"600\"", title)?;
    text(svg, 28.0, 60.0, "fill=\"#57606a\"", subtitle)?;
    tube(svg, nominal, parts)?;
    angles(svg, nominal, parts)?;
    envelope(svg, nominal, parts)?;
    writeln!(svg, "</svg>")
}

fn heading(svg: &mut String, x: f64, words: &str) -> std::fmt::Result {
    text(svg, x, TOP - 16.0, "font-weight=\"600\"", words)
}

fn columns(svg: &mut String, panel: &Panel) -> std::fmt::Result {
    for i in 0..panel.parts {
        let words = format!("part {}", i + 1);
        text(svg, panel.x(i), BOTTOM + 22.0, "text-anchor=\"middle\" fill=\"#57606a\"", &words)?;
    }
    Ok(())
}

/// Grid lines at round values with their labels.
fn grid(svg: &mut String, panel: &Panel, unit: &str, signed: bool) -> std::fmt::Result {
    let step = round_step(panel.high - panel.low, 7.0).max(0.1);
    let first = (panel.low / step).ceil() as i64;
    let last = (panel.high / step).floor() as i64;
    for k in first..=last {
        let value = k as f64 * step;
        let y = panel.y(value);
        let stroke = if k == 0 { "#8c959f" } else { "#e6e9ec" };
        line(svg, (panel.left, y), (panel.right, y), &format!("stroke=\"{stroke}\""))?;
        let digits = usize::from(step < 1.0);
        let words = match k {
            0 => format!("0{unit}"),
            _ if signed => format!("{value:+.digits$}{unit}"),
            _ => format!("{value:.digits$}{unit}"),
        };
        text(
            svg,
            panel.left - 8.0,
            y + 4.5,
            "text-anchor=\"end\" fill=\"#57606a\" font-size=\"12\"",
            &words,
        )?;
    }
    Ok(())
}

fn band(svg: &mut String, panel: &Panel, low: f64, high: f64, words: &str) -> std::fmt::Result {
    let (y, height) = (panel.y(high), panel.y(low) - panel.y(high));
    let (x, width) = (panel.left, panel.right - panel.left);
    writeln!(
        svg,
        "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill=\"#dafbe1\"/>"
    )?;
    let style = "text-anchor=\"end\" fill=\"#1a7f37\" font-size=\"12\"";
    text(svg, panel.right - 6.0, y + 15.0, style, words)
}

fn angles(svg: &mut String, nominal: &Nominal, parts: &[PartRecord]) -> std::fmt::Result {
    let tolerance = nominal.tolerance.angle_rad.to_degrees();
    let all = parts.iter().flat_map(|p| p.inspection.bends.iter().filter_map(|b| b.angle_deg.deviation));
    let (low, high) = all.fold((-tolerance, tolerance), |(l, h), d| (l.min(d), h.max(d)));
    let margin = 0.08 * (high - low);
    let panel =
        Panel { left: 500.0, right: 790.0, low: low - margin, high: high + margin, parts: parts.len() };
    heading(svg, 452.0, "Angle deviation per bend")?;
    band(svg, &panel, -tolerance, tolerance, &format!("tolerance ±{tolerance:.2}°"))?;
    grid(svg, &panel, "°", true)?;
    columns(svg, &panel)?;
    for bend in 0..nominal.lra.bends.len() {
        let colour = COLOURS[bend % COLOURS.len()];
        let deviation = |p: &PartRecord| p.inspection.bends.get(bend).and_then(|b| b.angle_deg.deviation);
        // Bends stand side by side, so that equal deviations do not hide each other.
        let shift = 9.0 * (bend as f64 - (nominal.lra.bends.len() as f64 - 1.0) / 2.0);
        let points: Vec<(f64, f64)> = (parts.iter().enumerate())
            .filter_map(|(i, p)| Some((panel.x(i) + shift, panel.y(deviation(p)?))))
            .collect();
        polyline(svg, &points, &format!("stroke=\"{colour}\" stroke-width=\"2\" stroke-opacity=\"0.75\""))?;
        for (x, y) in &points {
            writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4.5\" fill=\"{colour}\"/>")?;
        }
    }
    legend(svg, nominal)
}

fn legend(svg: &mut String, nominal: &Nominal) -> std::fmt::Result {
    let mut x = 452.0;
    for (i, bend) in nominal.lra.bends.iter().enumerate().take(COLOURS.len()) {
        let words = format!("{}: {:.0}°", i + 1, bend.angle_rad.to_degrees());
        let y = BOTTOM + 44.0;
        writeln!(
            svg,
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"4.5\" fill=\"{}\"/>",
            x + 5.0,
            y - 4.5,
            COLOURS[i]
        )?;
        text(svg, x + 15.0, y, "fill=\"#57606a\" font-size=\"12\"", &words)?;
        x += 27.0 + 7.5 * words.chars().count() as f64;
    }
    Ok(())
}

fn envelope(svg: &mut String, nominal: &Nominal, parts: &[PartRecord]) -> std::fmt::Result {
    let limit = nominal.tolerance.envelope_mm;
    let worst = |p: &PartRecord| p.worst().map(|w| w.deviation_mm);
    let high = parts.iter().filter_map(worst).fold(1.25 * limit, f64::max);
    let panel = Panel { left: 890.0, right: 1088.0, low: 0.0, high: 1.1 * high, parts: parts.len() };
    heading(svg, 842.0, "Worst check point")?;
    band(svg, &panel, 0.0, limit, &format!("envelope {limit:.1} mm"))?;
    grid(svg, &panel, " mm", false)?;
    columns(svg, &panel)?;
    let width = (0.5 * (panel.right - panel.left) / parts.len().max(1) as f64).min(56.0);
    for (i, mm) in parts.iter().enumerate().filter_map(|(i, p)| Some((i, worst(p)?))) {
        let colour = if mm <= limit { "#2da44e" } else { "#cf222e" };
        let (x, y) = (panel.x(i) - width / 2.0, panel.y(mm));
        writeln!(
            svg,
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{:.1}\" rx=\"3\" fill=\"{colour}\"/>",
            BOTTOM - y
        )?;
        text(svg, panel.x(i), y - 7.0, "text-anchor=\"middle\" font-weight=\"600\"", &format!("{mm:.2}"))?;
    }
    Ok(())
}

/// The nominal tube, and the first and last part over it with their deviations exaggerated.
fn tube(svg: &mut String, nominal: &Nominal, parts: &[PartRecord]) -> std::fmt::Result {
    heading(svg, 28.0, &format!("The tube (deviations drawn {EXAGGERATION:.0} times larger)"))?;
    let wanted = samples(&Spine::from_lra(&nominal.lra, Frame::identity()));
    let shown: Vec<(&PartRecord, &str)> = match parts {
        [] => Vec::new(),
        [only] => vec![(only, verdict_colour(only))],
        [first, .., last] => vec![(first, "#cf222e"), (last, verdict_colour(last))],
    };
    let mut lines = vec![wanted.clone()];
    lines.extend(shown.iter().map(|(part, _)| exaggerated(&nominal.lra, &wanted, part)));
    let view = View::fit(&lines, (28.0, TOP + 6.0, 410.0, BOTTOM + 20.0));
    let width = (nominal.od_mm * view.scale).max(3.0);
    let round = "stroke-linejoin=\"round\" stroke-linecap=\"round\"";
    let nominal_line = view.line(&wanted);
    polyline(svg, &nominal_line, &format!("stroke=\"#d0d7de\" stroke-width=\"{width:.1}\" {round}"))?;
    polyline(
        svg,
        &nominal_line,
        &format!("stroke=\"#f0f3f6\" stroke-width=\"{:.1}\" {round}", 0.45 * width),
    )?;
    for (points, (_, colour)) in lines.iter().skip(1).zip(&shown) {
        polyline(svg, &view.line(points), &format!("stroke=\"{colour}\" stroke-width=\"2.5\" {round}"))?;
    }
    let mut x = 28.0;
    let named = shown.iter().map(|(part, colour)| (*colour, format!("part {}", part.number)));
    for (colour, words) in [("#b6bec7", "nominal".to_owned())].into_iter().chain(named) {
        let y = BOTTOM + 44.0;
        line(svg, (x, y - 4.5), (x + 18.0, y - 4.5), &format!("stroke=\"{colour}\" stroke-width=\"3\""))?;
        text(svg, x + 24.0, y, "fill=\"#57606a\" font-size=\"12\"", &words)?;
        x += 44.0 + 7.5 * words.len() as f64;
    }
    Ok(())
}

/// Green for a good part; a first part among several is red whatever it is, to be told from the last.
fn verdict_colour(part: &PartRecord) -> &'static str {
    if part.inspection.verdict == Verdict::InTolerance { "#2da44e" } else { "#bf8700" }
}

/// The same number of points on every spine, at equal shares of each segment: they belong together pair by pair.
fn samples(spine: &Spine) -> Vec<Point3<f64>> {
    const PER_SEGMENT: usize = 24;
    let mut points = Vec::new();
    for segment in spine.segments() {
        points.extend((0..=PER_SEGMENT).map(|k| {
            let along = segment.length_mm * k as f64 / PER_SEGMENT as f64;
            Point3::from(segment.frame_at(along).translation.vector)
        }));
    }
    points
}

/// The part's centre line laid over the nominal, its distance from it exaggerated.
fn exaggerated(nominal: &Lra, wanted: &[Point3<f64>], part: &PartRecord) -> Vec<Point3<f64>> {
    let turned = part.inspection.turned_round;
    let measured = if turned { part.measured.reversed() } else { part.measured.clone() };
    let found = samples(&Spine::from_lra(&measured.lra_or(Some(nominal)), Frame::identity()));
    let pairs: Vec<Pair> =
        found.iter().zip(wanted).map(|(&from, &to)| Pair { from, to, weight: 1.0 }).collect();
    let motion = register(&pairs).map(|r| r.motion).unwrap_or_default();
    found.iter().zip(wanted).map(|(f, w)| w + (motion * f - w) * EXAGGERATION).collect()
}

/// An oblique parallel view, scaled into a box.
struct View {
    right: Vector3<f64>,
    up: Vector3<f64>,
    scale: f64,
    /// What is added after scaling.
    origin: (f64, f64),
}

impl View {
    /// The view among some turns about the line of sight in which all lines fill the box (left, top, right, bottom)
    /// best.
    fn fit(lines: &[Vec<Point3<f64>>], frame: (f64, f64, f64, f64)) -> View {
        let towards = Vector3::new(0.55, -0.75, 0.55).normalize();
        let side = Vector3::z().cross(&towards).normalize();
        let up = towards.cross(&side);
        let turns = (0..36).map(|k| {
            let (sin, cos) = (f64::from(k) * 10f64.to_radians()).sin_cos();
            View::turned(side * cos + up * sin, up * cos - side * sin, lines, frame)
        });
        let larger = |best: View, next: View| if next.scale > best.scale { next } else { best };
        turns.fold(View::turned(side, up, lines, frame), larger)
    }

    fn turned(
        side: Vector3<f64>,
        up: Vector3<f64>,
        lines: &[Vec<Point3<f64>>],
        (left, top, right, bottom): (f64, f64, f64, f64),
    ) -> View {
        let mut view = View { right: side, up, scale: 1.0, origin: (0.0, 0.0) };
        let flat: Vec<(f64, f64)> = lines.iter().flat_map(|l| view.line(l)).collect();
        let span = |pick: fn(&(f64, f64)) -> f64| {
            let values = flat.iter().map(pick);
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
        };
        let ((x0, x1), (y0, y1)) = (span(|p| p.0), span(|p| p.1));
        let margin = 14.0;
        let (width, height) = (right - left - 2.0 * margin, bottom - top - 2.0 * margin);
        view.scale = (width / (x1 - x0).max(1.0)).min(height / (y1 - y0).max(1.0));
        view.origin = (
            (left + right) / 2.0 - view.scale * (x0 + x1) / 2.0,
            (top + bottom) / 2.0 - view.scale * (y0 + y1) / 2.0,
        );
        view
    }

    fn line(&self, points: &[Point3<f64>]) -> Vec<(f64, f64)> {
        let flat = |p: &Point3<f64>| (self.right.dot(&p.coords), -self.up.dot(&p.coords));
        let place = |(x, y): (f64, f64)| (self.origin.0 + self.scale * x, self.origin.1 + self.scale * y);
        points.iter().map(flat).map(place).collect()
    }
}
