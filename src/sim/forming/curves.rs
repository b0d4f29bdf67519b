//! Spring-back curves from a file: what a finite-element study, or a shop's own series, says of tubes of some size.
//!
//! CSV with the columns `sample`, `od_mm`, `wall_mm`, `clr_mm`, `commanded_deg`, `springback_deg`; lines that begin with # are
//! remarks. The rows of a sample are one curve.

use std::path::{Path, PathBuf};

use thiserror::Error;

const HEADER: &str = "sample,od_mm,wall_mm,clr_mm,commanded_deg,springback_deg";

/// Why curves are of no use.
#[derive(Debug, Error)]
pub enum CurveError {
    /// The file cannot be read.
    #[error("{path}: cannot be read: {cause}")]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: std::io::Error,
    },
    /// A line is not as it has to be.
    #[error("{path}, line {line}: {found}, allowed is {allowed}")]
    Line {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What was found.
        found: String,
        /// What would be accepted.
        allowed: String,
    },
}

/// One curve.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// Its name in the file.
    pub sample: String,
    /// Outer diameter of the tubes.
    pub od_mm: f64,
    /// Their wall.
    pub wall_mm: f64,
    /// The die's centre-line radius.
    pub clr_mm: f64,
    /// Commanded angle and spring-back, the former growing.
    points_rad: Vec<(f64, f64)>,
}

impl Curve {
    /// Spring-back at a commanded angle: straight between the points, down to none at none, on as at the end beyond.
    pub fn at_rad(&self, commanded_rad: f64) -> f64 {
        let points = &self.points_rad;
        let next = points.partition_point(|(angle, _)| *angle < commanded_rad).min(points.len() - 1);
        let (from, to) = match next.checked_sub(1) {
            Some(before) => (points[before], points[next]),
            None => ((0.0, 0.0), points[0]),
        };
        from.1 + (commanded_rad - from.0) * (to.1 - from.1) / (to.0 - from.0)
    }
}

/// All curves of a file, in its order.
pub fn load(path: &Path) -> Result<Vec<Curve>, CurveError> {
    let text =
        std::fs::read_to_string(path).map_err(|cause| CurveError::Read { path: path.to_owned(), cause })?;
    parse(&text, path)
}

fn parse(text: &str, path: &Path) -> Result<Vec<Curve>, CurveError> {
    let error = |line: usize, found: String, allowed: String| CurveError::Line {
        path: path.to_owned(),
        line: line + 1,
        found,
        allowed,
    };
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#'));
    match lines.next() {
        Some((_, header)) if header.trim() == HEADER => {}
        Some((line, other)) => return Err(error(line, format!("{other:?}"), HEADER.into())),
        None => return Err(error(0, "nothing".into(), HEADER.into())),
    }
    let mut curves: Vec<Curve> = Vec::new();
    for (line, row) in lines {
        let (sample, values) = row.split_once(',').unwrap_or((row, ""));
        let values: Option<Vec<f64>> = values.split(',').map(|word| word.trim().parse().ok()).collect();
        let Some([od_mm, wall_mm, clr_mm, commanded, springback]) =
            values.and_then(|v| <[f64; 5]>::try_from(v).ok()).filter(|v| v.iter().all(|x| x.is_finite()))
        else {
            return Err(error(line, format!("{row:?}"), "a name and five numbers".into()));
        };
        if curves.last().is_none_or(|curve| curve.sample != sample) {
            let (sample, points_rad) = (sample.to_owned(), Vec::new());
            curves.push(Curve { sample, od_mm, wall_mm, clr_mm, points_rad });
        }
        let Some(curve) = curves.last_mut() else { continue };
        let least = curve.points_rad.last().map_or(0.0, |(angle, _)| angle.to_degrees());
        if commanded <= least || !(0.0..=commanded).contains(&springback) {
            let found = format!("{springback} degrees of spring-back at {commanded}");
            let allowed = format!("an angle above {least:.3} and a spring-back between 0 and it");
            return Err(error(line, found, allowed));
        }
        curve.points_rad.push((commanded.to_radians(), springback.to_radians()));
    }
    if curves.is_empty() {
        return Err(error(text.lines().count(), "no rows".into(), "at least one".into()));
    }
    Ok(curves)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: &str = "# by hand\nsample,od_mm,wall_mm,clr_mm,commanded_deg,springback_deg\na,20,1,40,10,2\na,20,1,40,20,3\nb,25,1,50,90,5\n";

    fn complaint(text: &str) -> String {
        parse(text, Path::new("c.csv")).unwrap_err().to_string()
    }

    #[test]
    fn curves_are_read_and_go_straight_between_their_points() {
        let curves = parse(TWO, Path::new("c.csv")).unwrap();
        assert_eq!(curves.iter().map(|c| c.sample.as_str()).collect::<Vec<_>>(), ["a", "b"]);
        let at = |deg: f64| curves[0].at_rad(deg.to_radians()).to_degrees();
        for (deg, wanted) in [(0.0, 0.0), (5.0, 1.0), (10.0, 2.0), (15.0, 2.5), (20.0, 3.0), (40.0, 5.0)] {
            assert!((at(deg) - wanted).abs() < 1e-9, "{deg}: {}", at(deg));
        }
        assert!((curves[1].at_rad(0.5) - 0.5 / 18.0).abs() < 1e-9, "one point: in proportion");
    }

    #[test]
    fn what_is_no_curve_is_refused_with_its_line() {
        assert!(complaint("a,b\n").contains("line 1: \"a,b\", allowed is sample,od_mm"));
        assert!(complaint("").contains("nothing"));
        assert!(
            complaint(&TWO.replace("20,3", "20")).contains("line 4: \"a,20,1,40,20\", allowed is a name")
        );
        assert!(complaint(&TWO.replace("20,3", "9,3")).contains("above 10.000"));
        assert!(complaint(&TWO.replace("90,5", "90,95")).contains("line 5: 95 degrees"));
        assert!(complaint(&format!("{HEADER}\n")).contains("no rows"));
    }
}
