//! The histogram of the deviations, beside what pure noise of the same sigma would give.

use std::f64::consts::TAU;
use std::fmt::{Result, Write};

use super::Scale;
use super::colour::class_colour;
use super::svg::{line, polyline, text, ticks};

const BINS: usize = 66;
const LEFT: f64 = 60.0;
const RIGHT: f64 = 700.0;
const TOP: f64 = 24.0;
const BOTTOM: f64 = 220.0;

/// Draws the histogram of the points near the tube: width 1100, height 270.
pub fn draw(svg: &mut String, residuals_mm: &[f64], scale: &Scale) -> Result {
    let span = 1.5 * scale.limit_mm;
    let mut counts = [0usize; BINS];
    let (mut total, mut beyond) = (0usize, 0usize);
    let mut within = [0usize; 3];
    for r in residuals_mm.iter().filter(|r| r.abs() <= scale.near_mm) {
        total += 1;
        within
            .iter_mut()
            .zip(1..)
            .for_each(|(n, k)| *n += usize::from(r.abs() <= f64::from(k) * scale.noise_mm));
        let bin = (r / span + 1.0) / 2.0 * BINS as f64;
        if (0.0..BINS as f64).contains(&bin) { counts[bin as usize] += 1 } else { beyond += 1 }
    }
    let x = |mm: f64| LEFT + (mm / span + 1.0) / 2.0 * (RIGHT - LEFT);
    let width_mm = 2.0 * span / BINS as f64;
    let normal = |mm: f64| {
        let z = mm / scale.noise_mm.max(1e-9);
        total as f64 * width_mm / scale.noise_mm.max(1e-9) / TAU.sqrt() * (-0.5 * z * z).exp()
    };
    let high = counts.iter().map(|c| *c as f64).fold(normal(0.0), f64::max).max(1.0);
    let y = |count: f64| BOTTOM - count / high * (BOTTOM - TOP);
    for (k, &count) in counts.iter().enumerate().filter(|(_, c)| **c > 0) {
        let from = -span + k as f64 * width_mm;
        let (left, top) = (x(from), y(count as f64));
        writeln!(
            svg,
            "<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"{}\" stroke=\"#8c959f\" stroke-width=\"0.4\"/>",
            x(from + width_mm) - left,
            BOTTOM - top,
            class_colour(scale.class(from + width_mm / 2.0))
        )?;
    }
    let curve = (0..=200).map(|k| -span + 2.0 * span * f64::from(k) / 200.0).map(|mm| (x(mm), y(normal(mm))));
    polyline(
        svg,
        &curve.collect::<Vec<_>>(),
        "stroke=\"#24292f\" stroke-width=\"1.4\" stroke-dasharray=\"5 3\"",
    )?;
    axis(svg, span, x)?;
    words(svg, total, beyond, within, span, scale)
}

fn axis(svg: &mut String, span: f64, x: impl Fn(f64) -> f64) -> Result {
    line(svg, (LEFT, BOTTOM), (RIGHT, BOTTOM), "stroke=\"#8c959f\"")?;
    let (values, digits) = ticks(-span, span, 9.0);
    for mm in values {
        line(svg, (x(mm), BOTTOM), (x(mm), BOTTOM + 5.0), "stroke=\"#8c959f\"")?;
        let words = if mm == 0.0 { "0".to_owned() } else { format!("{mm:+.digits$}") };
        text(svg, x(mm), BOTTOM + 19.0, "text-anchor=\"middle\" font-size=\"12\" fill=\"#57606a\"", &words)?;
    }
    let middle = (LEFT + RIGHT) / 2.0;
    let words = "deviation from the fitted surface, mm (positive: outside)";
    text(svg, middle, BOTTOM + 40.0, "text-anchor=\"middle\" fill=\"#57606a\"", words)
}

/// Shares beside the figures of a normal distribution.
fn words(
    svg: &mut String,
    total: usize,
    beyond: usize,
    within: [usize; 3],
    span: f64,
    scale: &Scale,
) -> Result {
    let share = |n: usize| 100.0 * n as f64 / total.max(1) as f64;
    let mut lines = vec![format!("{total} points, sigma {:.4} mm (by the median)", scale.noise_mm)];
    for ((n, k), normal) in within.into_iter().zip(1..).zip([68.3, 95.4, 99.7]) {
        lines.push(format!("within {k} sigma: {:.1} %  (pure noise: {normal} %)", share(n)));
    }
    lines.push(format!("beyond the picture (±{span:.3} mm): {beyond}"));
    lines.push("dashed: pure noise of that sigma".to_owned());
    for (k, words) in lines.iter().enumerate() {
        text(svg, RIGHT + 30.0, TOP + 30.0 + 24.0 * k as f64, "", words)?;
    }
    Ok(())
}
