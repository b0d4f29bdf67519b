//! The page: one HTML file without anything outside it, for the screen and for paper.

use std::fmt::{Result, Write};

use super::surface::Surface;
use super::svg::escape;
use super::{Scale, histogram, unrolled, views};
use crate::cloud::PointCloud;
use crate::reconstruct::Reconstruction;
use crate::tube::MeasuredTube;

/// Points that are looked at for pictures; the histogram takes all.
const MOST_POINTS: usize = 200_000;

const STYLE: &str = "
body { font: 14px/1.45 'DejaVu Sans', 'Segoe UI', Helvetica, Arial, sans-serif; color: #24292f; background: #ffffff;
  max-width: 1100px; margin: 24px auto; padding: 0 16px; }
h1 { font-size: 21px; margin: 0 0 4px; } h2 { font-size: 16px; margin: 28px 0 6px; }
p { margin: 4px 0 10px; } .quiet { color: #57606a; } .hash { font-family: monospace; overflow-wrap: anywhere; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 14px 3px 0; text-align: right; border-bottom: 1px solid #d8dee4; }
th { font-weight: 600; } td.words, th.words { text-align: left; } .sigma { color: #57606a; }
.warnings { border-left: 4px solid #bf8700; padding: 2px 12px; background: #fff8e5; }
svg { display: block; width: 100%; height: auto; }
svg .halo { paint-order: stroke; stroke: #ffffff; stroke-width: 3px; }
@media print { body { margin: 0; max-width: none; -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  section { break-inside: avoid; } }
";

/// What the reconstruction does not know of itself.
#[derive(Debug, Clone, Copy)]
pub struct About<'a> {
    /// The scan's file, as given.
    pub file: &'a str,
    /// Name of the nominal, where one was given.
    pub nominal: Option<&'a str>,
}

/// The report of one scan. `cloud` is what `found` was reconstructed from.
pub fn html(about: &About, found: &Reconstruction, cloud: &PointCloud) -> String {
    let mut page = String::new();
    // Writing to a String cannot fail.
    let _ = page_into(&mut page, about, found, cloud);
    page
}

fn page_into(page: &mut String, about: &About, found: &Reconstruction, cloud: &PointCloud) -> Result {
    let tube = &found.measured;
    let residuals_mm = found.residuals_mm(cloud);
    let scale = Scale::of(found, &residuals_mm);
    let surface = Surface::of(found, cloud, &residuals_mm, &scale, MOST_POINTS);
    let file = escape(about.file);
    writeln!(page, "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>")?;
    writeln!(page, "<meta name=\"viewport\" content=\"width=device-width\"/>")?;
    writeln!(page, "<title>{file}: measured tube</title>\n<style>{STYLE}</style>\n</head>\n<body>")?;
    head(page, about, tube, &scale)?;
    table(page, tube)?;
    warnings(page, tube)?;
    pictures(page, found, &surface, &residuals_mm, &scale)?;
    decisions(page, tube)?;
    writeln!(page, "</body>\n</html>")
}

fn head(page: &mut String, about: &About, tube: &MeasuredTube, scale: &Scale) -> Result {
    let n = tube.bends.len();
    let bends = if n == 1 { "1 bend".to_owned() } else { format!("{n} bends") };
    writeln!(page, "<h1>{}: {bends}</h1>", escape(about.file))?;
    let diameter = 2.0 * tube.tube_radius_mm;
    let radius = sigma(Some(tube.tube_radius_mm), tube.tube_radius_sigma_mm, 3);
    writeln!(page, "<p>tube radius {radius} mm (diameter {diameter:.3} mm)<br/>")?;
    let (used, total) = (tube.points_used, tube.points_total);
    let share = 100.0 * used as f64 / total.max(1) as f64;
    writeln!(
        page,
        "{used} of {total} points used ({share:.1} %), median deviation {:.4} mm, sigma {:.4} mm<br/>",
        tube.residual_median_mm, scale.noise_mm
    )?;
    match (about.nominal, tube.reversed) {
        (Some(name), Some(true)) => {
            writeln!(page, "direction of travel: that of {}; the scan was turned round<br/>", escape(name))?;
        }
        (Some(name), _) => writeln!(page, "direction of travel: that of {}<br/>", escape(name))?,
        (None, _) => writeln!(page, "no nominal given: the direction of travel is arbitrary<br/>")?,
    }
    let hash = &tube.scan_sha256;
    writeln!(page, "<span class=\"quiet\">SHA-256 of the scan: <span class=\"hash\">{hash}</span></span></p>")
}

fn table(page: &mut String, tube: &MeasuredTube) -> Result {
    let oval = tube.bends.iter().any(|b| b.ovality.is_some());
    let flattened = tube.bends.iter().any(|b| b.flattening.is_some());
    writeln!(page, "<section>\n<h2>Bending table (LRA)</h2>\n<table>\n<tr><th class=\"words\">bend</th>")?;
    writeln!(page, "<th>length, mm</th><th>rotation, °</th><th>angle, °</th><th>CLR, mm</th>")?;
    page.push_str(if oval { "<th>ovality, %</th>" } else { "" });
    writeln!(page, "{}</tr>", if flattened { "<th>flattening, %</th>" } else { "" })?;
    for (i, b) in tube.bends.iter().enumerate() {
        let degrees = |rad: Option<f64>| rad.map(f64::to_degrees);
        let percent = |share: Option<f64>| share.map(|s| 100.0 * s);
        let mut cells = vec![
            sigma(b.length_mm, b.length_sigma_mm, 3),
            sigma(degrees(b.rotation_rad), degrees(b.rotation_sigma_rad), 3),
            sigma(degrees(Some(b.angle_rad)), degrees(Some(b.angle_sigma_rad)), 3),
            sigma(b.radius_mm, b.radius_sigma_mm, 3),
        ];
        cells.extend(oval.then(|| sigma(percent(b.ovality), percent(b.ovality_sigma), 2)));
        cells.extend(flattened.then(|| sigma(percent(b.flattening), percent(b.flattening_sigma), 2)));
        writeln!(page, "<tr><td class=\"words\">{}</td><td>{}</td></tr>", i + 1, cells.join("</td><td>"))?;
    }
    let last = sigma(tube.last_length_mm, tube.last_length_sigma_mm, 3);
    let empty = "<td></td>".repeat(3 + usize::from(oval) + usize::from(flattened));
    writeln!(page, "<tr><td class=\"words\">end</td><td>{last}</td>{empty}</tr>\n</table>")?;
    let cuts = [
        ("first", tube.first_cut_rad, tube.first_cut_sigma_rad),
        ("last", tube.last_cut_rad, tube.last_cut_sigma_rad),
    ];
    for (which, cut, cut_sigma) in cuts.iter().filter(|c| c.1.is_some()) {
        let cut = sigma(cut.map(f64::to_degrees), cut_sigma.map(f64::to_degrees), 2);
        writeln!(page, "<p>{which} end cut {cut}° from square</p>")?;
    }
    writeln!(
        page,
        "<p class=\"quiet\">± is one standard deviation. A length is the straight before its bend.</p>"
    )?;
    writeln!(page, "</section>")
}

/// A value with its sigma in grey, or that it is not known.
fn sigma(value: Option<f64>, sigma: Option<f64>, digits: usize) -> String {
    let Some(value) = value else { return "<span class=\"sigma\">not known</span>".to_owned() };
    let sigma = sigma.map(|s| format!(" <span class=\"sigma\">±{s:.digits$}</span>")).unwrap_or_default();
    format!("{value:.digits$}{sigma}")
}

fn warnings(page: &mut String, tube: &MeasuredTube) -> Result {
    if tube.warnings.is_empty() {
        return Ok(());
    }
    writeln!(page, "<section>\n<h2>Warnings</h2>\n<div class=\"warnings\">")?;
    tube.warnings.iter().try_for_each(|w| writeln!(page, "<p>{}</p>", escape(w)))?;
    writeln!(page, "</div>\n</section>")
}

fn pictures(
    page: &mut String,
    found: &Reconstruction,
    surface: &Surface,
    residuals_mm: &[f64],
    scale: &Scale,
) -> Result {
    let radius_mm = found.measured.tube_radius_mm;
    writeln!(page, "<section>\n<h2>Deviation of the points from the fitted tube</h2>")?;
    let mut svg = String::new();
    let height = views::draw(&mut svg, &found.spine, surface, scale, radius_mm)?;
    figure(page, height, &svg)?;
    let mut bar = String::new();
    scale.bar(&mut bar, 350.0, 4.0, 400.0)?;
    figure(page, 40.0, &bar)?;
    writeln!(
        page,
        "<p class=\"quiet\">Scanned points that face the eye; pale tube: not scanned there. Dash-dotted: centre line. \
         White circles: tangent points. Numbers: bends. Dark grey points: not the tube. The fitted bends may be oval.</p>\n</section>"
    )?;
    writeln!(page, "<section>\n<h2>The surface unrolled</h2>")?;
    svg.clear();
    unrolled::draw(&mut svg, &found.spine, surface, scale, radius_mm)?;
    figure(page, unrolled::HEIGHT, &svg)?;
    writeln!(
        page,
        "<p class=\"quiet\">Deviation from a round tube of the measured radius, mean of each cell, on a scale of its own; white: \
         not scanned, or nothing near the surface. Between the lines of a bend, solid: its inner side, dashed: its outer \
         side. 0° is the inner side of the first bend, carried along without twist; the angle grows clockwise in the direction of travel. An oval bend has one \
         colour at its inner and outer side and the other between them; a dent or flat is a blue patch; passes that disagree \
         make stripes along the tube.</p>\n</section>"
    )?;
    writeln!(page, "<section>\n<h2>How the deviations are spread</h2>")?;
    svg.clear();
    histogram::draw(&mut svg, residuals_mm, scale)?;
    figure(page, 270.0, &svg)?;
    writeln!(page, "</section>")
}

fn figure(page: &mut String, height: f64, svg: &str) -> Result {
    let style = "role=\"img\" font-size=\"13\" fill=\"#24292f\"";
    writeln!(page, "<svg viewBox=\"0 0 1100 {height:.0}\" {style}>\n{svg}</svg>")
}

fn decisions(page: &mut String, tube: &MeasuredTube) -> Result {
    if tube.decisions.is_empty() {
        return Ok(());
    }
    writeln!(page, "<section>\n<h2>Decisions about the structure</h2>\n<table>")?;
    writeln!(
        page,
        "<tr><th class=\"words\">tried</th><th>bend</th><th>gain</th><th class=\"words\">kept</th></tr>"
    )?;
    for d in &tube.decisions {
        let bend = d.bend.map(|b| b.to_string()).unwrap_or_default();
        let kept = if d.kept { "yes" } else { "no" };
        let what = escape(&d.what);
        writeln!(
            page,
            "<tr><td class=\"words\">{what}</td><td>{bend}</td><td>{:.1}</td><td class=\"words\">{kept}</td></tr>",
            d.gain
        )?;
    }
    writeln!(page, "</table>")?;
    writeln!(page, "<p class=\"quiet\">Gain: above 0 the data asks for what was tried.</p>\n</section>")
}
