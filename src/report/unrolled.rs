//! The tube's surface unrolled: arc length against the angle around the tube, each cell coloured by the mean
//! deviation of its points from a round tube. Ovality shows as bands of both colours, drift between passes as stripes
//! along the tube.

use std::f64::consts::{PI, TAU};
use std::fmt::{Result, Write};

use super::Scale;
use super::colour::{CLASSES, class_colour};
use super::surface::{Surface, wrapped};
use super::svg::{line, text, ticks};
use crate::tube::{SegmentKind, Spine};

const LEFT: f64 = 60.0;
const RIGHT: f64 = 1080.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 340.0;
pub const HEIGHT: f64 = 430.0;

/// Cells in the picture at most, points that a cell should have, and without which it says nothing.
const MOST_CELLS: f64 = 36_000.0;
const POINTS_PER_CELL: f64 = 6.0;
const LEAST_POINTS: usize = 2;

/// Draws the map with its colour bar: width 1100, height [`HEIGHT`].
pub fn draw(svg: &mut String, spine: &Spine, surface: &Surface, scale: &Scale, radius_mm: f64) -> Result {
    let length = spine.length_mm().max(1e-6);
    let x = |mm: f64| LEFT + mm / length * (RIGHT - LEFT);
    let y = |rad: f64| BOTTOM - (rad + PI) / TAU * (BOTTOM - TOP);
    let cells = Cells::of(surface, scale, length, radius_mm);
    let scale = scale.of_means(&cells.means(), POINTS_PER_CELL);
    cells.draw(svg, &scale)?;
    scale.bar(svg, 350.0, BOTTOM + 54.0, 400.0)?;
    let box_ = format!("width=\"{:.1}\" height=\"{:.1}\"", RIGHT - LEFT, BOTTOM - TOP);
    writeln!(svg, "<rect x=\"{LEFT}\" y=\"{TOP}\" {box_} fill=\"none\" stroke=\"#8c959f\"/>")?;
    let small = "font-size=\"12\" fill=\"#57606a\" text-anchor";
    for degrees in [-180, -90, 0, 90, 180] {
        let at = y(f64::from(degrees).to_radians());
        line(svg, (LEFT - 5.0, at), (LEFT, at), "stroke=\"#8c959f\"")?;
        text(svg, LEFT - 9.0, at + 4.0, &format!("{small}=\"end\""), &format!("{degrees}°"))?;
    }
    let (values, digits) = ticks(0.0, length, 12.0);
    for mm in values {
        line(svg, (x(mm), BOTTOM), (x(mm), BOTTOM + 5.0), "stroke=\"#8c959f\"")?;
        text(svg, x(mm), BOTTOM + 18.0, &format!("{small}=\"middle\""), &format!("{mm:.digits$}"))?;
    }
    text(
        svg,
        (LEFT + RIGHT) / 2.0,
        BOTTOM + 38.0,
        &format!("{small}=\"middle\""),
        "arc length along the tube, mm",
    )?;
    bends(svg, spine, surface, x, y)
}

/// Tangent points, number, and inner and outer side of every bend.
fn bends(
    svg: &mut String,
    spine: &Spine,
    surface: &Surface,
    x: impl Fn(f64) -> f64,
    y: impl Fn(f64) -> f64,
) -> Result {
    let arcs = (spine.segments().iter().zip(&surface.turns_rad)).filter(|(s, _)| s.kind != SegmentKind::Line);
    for (number, (arc, turn)) in (1..).zip(arcs) {
        let (from, to) = (x(arc.start_mm), x(arc.start_mm + arc.length_mm));
        for at in [from, to] {
            line(svg, (at, TOP - 10.0), (at, BOTTOM), "stroke=\"#24292f\" stroke-width=\"0.8\"")?;
        }
        line(svg, (from, TOP - 10.0), (to, TOP - 10.0), "stroke=\"#24292f\" stroke-width=\"0.8\"")?;
        let middle = (from + to) / 2.0;
        let bold = "text-anchor=\"middle\" font-weight=\"600\"";
        text(svg, middle, TOP - 16.0, bold, &number.to_string())?;
        let sides = [(0.0, "stroke-width=\"1.6\""), (PI, "stroke-width=\"1.6\" stroke-dasharray=\"4 3\"")];
        for (side, style) in sides {
            let at = y(wrapped(turn + side));
            line(svg, (from, at), (to, at), &format!("stroke=\"#24292f\" {style}"))?;
        }
    }
    Ok(())
}

/// Sums of deviations over the surface.
struct Cells {
    rows: usize,
    columns: usize,
    /// Row by row from the top: sum and number.
    sums: Vec<(f64, usize)>,
}

impl Cells {
    fn of(surface: &Surface, scale: &Scale, length_mm: f64, radius_mm: f64) -> Cells {
        let around_mm = TAU * radius_mm;
        let wanted = (surface.spots.len() as f64 / POINTS_PER_CELL).clamp(400.0, MOST_CELLS);
        let edge_mm = (around_mm * length_mm / wanted).sqrt();
        let rows = ((around_mm / edge_mm).round() as usize).clamp(12, 100);
        let columns = ((wanted / rows as f64) as usize).clamp(30, 1020);
        let mut sums = vec![(0.0, 0); rows * columns];
        for spot in &surface.spots {
            let row = (((PI - spot.around_rad) / TAU * rows as f64) as usize).min(rows - 1);
            let column = ((spot.along_mm / length_mm * columns as f64) as usize).min(columns - 1);
            let cell = &mut sums[row * columns + column];
            // One point far off the fitted surface must not paint its cell, ovality may.
            let most = 2.0 * scale.limit_mm;
            cell.0 += spot.from_round_mm - spot.deviation_mm + spot.deviation_mm.clamp(-most, most);
            cell.1 += 1;
        }
        Cells { rows, columns, sums }
    }

    fn mean(&(sum, count): &(f64, usize)) -> Option<f64> {
        (count >= LEAST_POINTS).then(|| sum / count as f64)
    }

    fn means(&self) -> Vec<f64> {
        self.sums.iter().filter_map(Cells::mean).collect()
    }

    /// Runs of cells of one colour, one path per colour.
    fn draw(&self, svg: &mut String, scale: &Scale) -> Result {
        let class = |cell: &(f64, usize)| Cells::mean(cell).map(|mean| scale.class(mean));
        let wide = (RIGHT - LEFT) / self.columns as f64;
        let high = (BOTTOM - TOP) / self.rows as f64;
        let mut paths = vec![String::new(); CLASSES];
        for (row, line) in self.sums.chunks(self.columns).enumerate() {
            let y = TOP + (row as f64 + 0.5) * high;
            let mut column = 0;
            for run in line.chunk_by(|a, b| class(a) == class(b)) {
                if let Some(class) = class(&run[0]) {
                    let (x, width) = (LEFT + column as f64 * wide, run.len() as f64 * wide);
                    write!(paths[class], "M{x:.1} {y:.1}h{width:.1}")?;
                }
                column += run.len();
            }
        }
        for (class, path) in paths.iter().enumerate().filter(|(_, p)| !p.is_empty()) {
            let style = format!(
                "stroke=\"{}\" stroke-width=\"{:.2}\" fill=\"none\"",
                class_colour(class),
                high + 0.2
            );
            writeln!(svg, "<path d=\"{path}\" {style}/>")?;
        }
        Ok(())
    }
}
