//! The gate's figures: what the machine cannot do is refused before anything is sent.
//!
//! Checked on the whole steps that the machine would get, so that a value exactly at a limit passes and the
//! next step does not, whatever floating point makes of it.

use serde::Serialize;

use super::profile::Profile;
use super::rows::{Steps, steps_of};
use crate::tube::CommandTable;

/// One reason for a refusal, in the form of `benderd correct`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Reason {
    /// Short name for programs.
    pub code: &'static str,
    /// With figures, for people.
    pub text: String,
    /// Bend counted from 1, where one is to blame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bend: Option<usize>,
}

impl Reason {
    /// A reason.
    pub fn new(code: &'static str, bend: Option<usize>, text: impl Into<String>) -> Reason {
        Reason { code, bend, text: text.into() }
    }
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.bend {
            Some(bend) => write!(f, "bend {bend}: {}", self.text),
            None => write!(f, "{}", self.text),
        }
    }
}

/// Everything in which the table exceeds the machine; empty when it can be bent.
pub fn check_limits(profile: &Profile, table: &CommandTable) -> Vec<Reason> {
    let limits = &profile.limits;
    if let Err(error) = table.validate() {
        return vec![Reason::new("impossible", None, error.to_string())];
    }
    let mut reasons = Vec::new();
    let count = table.bends.len();
    if count == 0 || count > limits.max_bends {
        let text = format!("{count} bends, the machine takes 1 to {}", limits.max_bends);
        reasons.push(Reason::new("row_count", None, text));
    }
    let (mm, deg) = (profile.table.length_resolution_mm, profile.table.angle_resolution_deg);
    let mut check =
        |row: usize, code, unit: &str, (value, found): (f64, f64), range: (f64, f64), step: f64| {
            // Limits in whole steps, rounded inwards; the small term forgives the division.
            let (least, most) = ((range.0 / step - 1e-6).ceil(), (range.1 / step + 1e-6).floor());
            if !(least..=most).contains(&found) {
                let decimals = if step < 0.01 { 3 } else { 2 };
                let text = format!(
                    "{code} {value:.decimals$} {unit}, the machine takes {:.decimals$} to {:.decimals$}",
                    range.0, range.1
                );
                reasons.push(Reason::new(code, Some(row), text));
            }
        };
    let turn = limits.max_rotation_rad.to_degrees();
    let steps = steps_of(&profile.table, table);
    for (i, (row, Steps { moves, .. })) in table.bends.iter().zip(steps).enumerate() {
        let shortest = if i == 0 { limits.min_first_length_mm } else { limits.min_between_mm };
        check(i + 1, "length", "mm", (row.length_mm, moves[0]), (shortest, limits.max_length_mm), mm);
        check(i + 1, "rotation", "deg", (row.rotation_rad.to_degrees(), moves[1]), (-turn, turn), deg);
        let angle = (0.0, limits.max_angle_rad.to_degrees());
        check(i + 1, "angle", "deg", (row.angle_rad.to_degrees(), moves[2]), angle, deg);
    }
    reasons
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::CommandRow;

    fn table(rows: &[(f64, f64, f64)]) -> CommandTable {
        let row = |r: &(f64, f64, f64)| CommandRow {
            length_mm: r.0,
            rotation_rad: r.1.to_radians(),
            angle_rad: r.2.to_radians(),
        };
        CommandTable { bends: rows.iter().map(row).collect(), last_length_mm: 50.0 }
    }

    fn codes(rows: &[(f64, f64, f64)]) -> Vec<(&'static str, Option<usize>)> {
        let profile = Profile::load("reference-modbus").unwrap();
        check_limits(&profile, &table(rows)).into_iter().map(|r| (r.code, r.bend)).collect()
    }

    #[test]
    fn the_limit_passes_and_one_step_more_does_not() {
        let ok = (10.0, -360.0, 190.0);
        assert_eq!(codes(&[ok, (0.0, 360.0, 0.0), (6000.0, 0.0, 90.0)]), []);
        assert_eq!(codes(&[(9.99, 0.0, 90.0)]), [("length", Some(1))]);
        assert_eq!(codes(&[ok, (6000.01, 0.0, 90.0)]), [("length", Some(2))]);
        assert_eq!(codes(&[ok, (1.0, 360.001, 90.0)]), [("rotation", Some(2))]);
        assert_eq!(codes(&[ok, (1.0, -360.001, 90.0)]), [("rotation", Some(2))]);
        assert_eq!(codes(&[ok, (1.0, 0.0, 190.001)]), [("angle", Some(2))]);
        assert_eq!(codes(&[ok, (1.0, 0.0, 190.0004)]), [], "rounds to the limit");
    }

    #[test]
    fn row_count_and_impossible_values() {
        assert_eq!(codes(&[]), [("row_count", None)]);
        assert_eq!(codes(&[(10.0, 0.0, 90.0); 40]), []);
        assert_eq!(codes(&[(10.0, 0.0, 90.0); 41]), [("row_count", None)]);
        assert_eq!(codes(&[(f64::NAN, 0.0, 90.0)]), [("impossible", None)]);
        assert_eq!(codes(&[(10.0, 0.0, -1.0)]), [("impossible", None)]);
    }

    #[test]
    fn the_text_has_the_figures() {
        let profile = Profile::load("reference-modbus").unwrap();
        let reasons = check_limits(&profile, &table(&[(8.2, 0.0, 200.0)]));
        let texts: Vec<String> = reasons.iter().map(Reason::to_string).collect();
        assert_eq!(
            texts,
            [
                "bend 1: length 8.20 mm, the machine takes 10.00 to 6000.00",
                "bend 1: angle 200.000 deg, the machine takes 0.000 to 190.000"
            ]
        );
    }
}
