//! The pieces of a picture: text, lines and round steps, as SVG. Own writer: what is drawn here needs no library.

use std::fmt::{Result, Write};

/// Text with the characters that mean something to XML and HTML written out.
pub fn escape(words: &str) -> String {
    words.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Words at a place, escaped.
pub fn text(svg: &mut String, x: f64, y: f64, attributes: &str, words: &str) -> Result {
    writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" {attributes}>{}</text>", escape(words))
}

/// A line between two places.
pub fn line(svg: &mut String, from: (f64, f64), to: (f64, f64), attributes: &str) -> Result {
    let ((x1, y1), (x2, y2)) = (from, to);
    writeln!(svg, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" {attributes}/>")
}

/// A line through all places.
pub fn polyline(svg: &mut String, points: &[(f64, f64)], attributes: &str) -> Result {
    let list: Vec<String> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
    writeln!(svg, "<polyline points=\"{}\" fill=\"none\" {attributes}/>", list.join(" "))
}

/// The smallest of the steps 1, 2, 5, 10, ... (and their tenths and so on) that divides a span into `most` parts
/// or fewer.
pub fn round_step(span: f64, most: f64) -> f64 {
    let least = (span / most).max(1e-12);
    let decade = 10f64.powf(least.log10().floor());
    let step = [1.0, 2.0, 5.0].into_iter().map(|s| s * decade).find(|s| *s >= least * (1.0 - 1e-9));
    step.unwrap_or(10.0 * decade)
}

/// The multiples of the round step between two values, and the digits that their numbers need.
pub fn ticks(low: f64, high: f64, most: f64) -> (Vec<f64>, usize) {
    let step = round_step(high - low, most);
    let (first, last) = ((low / step).ceil() as i64, (high / step + 1e-9).floor() as i64);
    let digits = (-step.log10().floor()).max(0.0) as usize;
    ((first..=last).map(|k| k as f64 * step).collect(), digits)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_round_and_not_too_many() {
        for (span, most, step) in [(7.0, 7.0, 1.0), (7.1, 7.0, 2.0), (0.35, 5.0, 0.1), (990.0, 10.0, 100.0)] {
            assert!((round_step(span, most) - step).abs() < 1e-9 * step, "{span} in {most}");
        }
        assert_eq!(ticks(-0.25, 0.25, 5.0), (vec![-0.2, -0.1, 0.0, 0.1, 0.2], 1));
    }

    #[test]
    fn words_cannot_break_out() {
        let mut svg = String::new();
        text(&mut svg, 1.0, 2.0, "", "<script>\"&").unwrap();
        assert_eq!(svg, "<text x=\"1.0\" y=\"2.0\" >&lt;script&gt;&quot;&amp;</text>\n");
    }
}
