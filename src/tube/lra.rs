//! LRA: length, rotation, angle (and bend radius) row by row, the language of bending machines.
//!
//! Source of the form: paper 000, section 5.3. It describes every arc-line spline up to a rigid motion,
//! bends of 180 degrees and more included, which a control polygon cannot.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::deg;

/// What a table of tube values may be refused for.
#[derive(Debug, Error, PartialEq)]
pub enum TubeError {
    /// A value outside its range. Rows count from 1, the tail is row `bends + 1`.
    #[error("row {row}: {field} is {found}, allowed is {allowed}")]
    Range {
        /// Row counted from 1.
        row: usize,
        /// Name of the value with its unit.
        field: &'static str,
        /// The value found.
        found: f64,
        /// What would be accepted.
        allowed: &'static str,
    },
    /// A bend of 180 degrees or more has no intersection point.
    #[error(
        "bend {bend} is {angle_deg:.3} degrees: from 180 degrees on the two straights have no corner, \
         so XYZ cannot hold it; use LRA or YBC"
    )]
    NoCorner {
        /// Bend counted from 1.
        bend: usize,
        /// Its angle in degrees.
        angle_deg: f64,
    },
    /// Two corners so close that the arcs between them overlap.
    #[error(
        "between corner {from} and {to}: the bends need {needed_mm:.3} mm of tangent length but the corners are \
         {distance_mm:.3} mm apart; make the radius smaller or move the corners"
    )]
    Overlap {
        /// Corner counted from 1 (1 is the first end).
        from: usize,
        /// The next corner.
        to: usize,
        /// Sum of the tangent lengths of the two bends.
        needed_mm: f64,
        /// Distance of the corners.
        distance_mm: f64,
    },
    /// Too few corners to make a tube.
    #[error("a tube needs at least two points (its ends), found {found}")]
    TooFewPoints {
        /// Number found.
        found: usize,
    },
    /// A fold straight back.
    #[error(
        "corner {corner}: the tube folds straight back (180 degrees), the plane of the bend is undefined"
    )]
    Fold {
        /// Corner counted from 1.
        corner: usize,
    },
}

/// One row: a straight, then a bend.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bend {
    /// Straight from tangent point to tangent point (or end face) before the bend, >= 0.
    pub length_mm: f64,
    /// Turn of this bend's plane against the one before about the feed direction, right-handed.
    #[serde(rename = "rotation_deg", with = "deg")]
    pub rotation_rad: f64,
    /// Bend angle, 0 up to (not including) 360 degrees.
    #[serde(rename = "angle_deg", with = "deg")]
    pub angle_rad: f64,
    /// Centre-line radius (CLR) of the bend, > 0.
    pub radius_mm: f64,
}

/// A tube's centre line up to a rigid motion: rows of straight and bend, then the last straight.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lra {
    /// The bends in feed order.
    pub bends: Vec<Bend>,
    /// The straight after the last bend, >= 0.
    pub last_length_mm: f64,
}

/// The angle in (-pi, pi] that differs by whole turns.
pub fn wrap_angle(rad: f64) -> f64 {
    let wrapped = rad.rem_euclid(2.0 * PI);
    if wrapped > PI { wrapped - 2.0 * PI } else { wrapped }
}

impl Lra {
    /// Refuses what no tube can have: negative or absurd lengths, angles outside [0, 360), radii <= 0.
    pub fn validate(&self) -> Result<(), TubeError> {
        let check = |ok: bool, row, field, found, allowed| {
            if ok { Ok(()) } else { Err(TubeError::Range { row, field, found, allowed }) }
        };
        for (i, bend) in self.bends.iter().enumerate() {
            let row = i + 1;
            let angle_deg = bend.angle_rad.to_degrees();
            let rotation_deg = bend.rotation_rad.to_degrees();
            check(length_ok(bend.length_mm), row, "length_mm", bend.length_mm, "0 to 100000")?;
            check(rotation_deg.abs() <= 3600.0, row, "rotation_deg", rotation_deg, "-3600 to 3600")?;
            check(
                (0.0..360.0).contains(&angle_deg),
                row,
                "angle_deg",
                angle_deg,
                "0 up to, not including, 360",
            )?;
            let radius_ok = bend.radius_mm > 0.0 && bend.radius_mm <= 100_000.0;
            let unused = bend.angle_rad == 0.0 && bend.radius_mm == 0.0;
            check(radius_ok || unused, row, "radius_mm", bend.radius_mm, "above 0 to 100000")?;
        }
        let last = self.last_length_mm;
        check(length_ok(last), self.bends.len() + 1, "length_mm", last, "0 to 100000")
    }

    /// Straights plus arcs: the length of the centre line.
    pub fn developed_length_mm(&self) -> f64 {
        self.bends.iter().map(|b| b.length_mm + b.radius_mm * b.angle_rad).sum::<f64>() + self.last_length_mm
    }

    /// The same tube without rows of angle 0: their length goes to the next straight, their rotation to
    /// the next bend.
    pub fn merged(&self) -> Lra {
        let mut out = Lra::default();
        let (mut length, mut rotation) = (0.0, 0.0);
        for bend in &self.bends {
            length += bend.length_mm;
            rotation += bend.rotation_rad;
            if bend.angle_rad > 0.0 {
                out.bends.push(Bend { length_mm: length, rotation_rad: rotation, ..*bend });
                (length, rotation) = (0.0, 0.0);
            }
        }
        out.last_length_mm = length + self.last_length_mm;
        out
    }

    /// The same tube travelled from its other end. Rotations change their order and keep their signs: a
    /// screw's handedness does not depend on who looks. The first row's rotation becomes 0.
    pub fn reversed(&self) -> Lra {
        let n = self.bends.len();
        let bends = (0..n)
            .map(|i| {
                let old = self.bends[n - 1 - i];
                let length_mm = if i == 0 { self.last_length_mm } else { self.bends[n - i].length_mm };
                let rotation_rad = if i == 0 { 0.0 } else { self.bends[n - i].rotation_rad };
                Bend { length_mm, rotation_rad, ..old }
            })
            .collect();
        Lra { bends, last_length_mm: self.bends.first().map_or(self.last_length_mm, |b| b.length_mm) }
    }

    /// The mirror image: the other hand.
    pub fn mirrored(&self) -> Lra {
        let mut out = self.clone();
        out.bends.iter_mut().for_each(|b| b.rotation_rad = -b.rotation_rad);
        out
    }

    /// Distances end - corner, corner - corner, ..., corner - end; None beside a bend of `limit_rad` or more,
    /// whose corner runs away (field: from 150 degrees on tangent points serve better).
    pub fn intersection_distances_mm(&self, limit_rad: f64) -> Vec<Option<f64>> {
        let tangent = |i: usize| -> Option<f64> {
            let b = &self.bends[i];
            (b.angle_rad < limit_rad).then(|| b.radius_mm * (b.angle_rad / 2.0).tan())
        };
        let n = self.bends.len();
        (0..=n)
            .map(|i| {
                let length = if i < n { self.bends[i].length_mm } else { self.last_length_mm };
                let before = if i > 0 { tangent(i - 1)? } else { 0.0 };
                let after = if i < n { tangent(i)? } else { 0.0 };
                Some(length + before + after)
            })
            .collect()
    }
}

fn length_ok(mm: f64) -> bool {
    (0.0..=100_000.0).contains(&mm)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bend(length_mm: f64, rotation_deg: f64, angle_deg: f64, radius_mm: f64) -> Bend {
        Bend {
            length_mm,
            rotation_rad: rotation_deg.to_radians(),
            angle_rad: angle_deg.to_radians(),
            radius_mm,
        }
    }

    #[test]
    fn rows_of_angle_zero_merge_into_the_next() {
        let lra = Lra {
            bends: vec![
                bend(10.0, 0.0, 90.0, 30.0),
                bend(20.0, 30.0, 0.0, 30.0),
                bend(5.0, 15.0, 45.0, 30.0),
            ],
            last_length_mm: 7.0,
        };
        let merged = lra.merged();
        assert_eq!(merged.bends.len(), 2);
        assert_eq!(merged.bends[1].length_mm, 25.0);
        assert!((merged.bends[1].rotation_rad.to_degrees() - 45.0).abs() < 1e-12);
        assert!((merged.developed_length_mm() - lra.developed_length_mm()).abs() < 1e-12);
    }

    #[test]
    fn developed_length_of_the_mixed_radius_part() {
        // field.md, worked case 3.
        let lra = Lra {
            bends: vec![bend(100.0, 0.0, 90.0, 30.0), bend(50.0, 90.0, 180.0, 50.0)],
            last_length_mm: 150.0,
        };
        assert!((lra.developed_length_mm() - 504.2035).abs() < 1e-4);
    }

    #[test]
    fn limits_and_limit_plus_one() {
        let one = |b: Bend| Lra { bends: vec![b], last_length_mm: 1.0 }.validate();
        assert!(one(bend(0.0, 0.0, 359.999, 1.0)).is_ok());
        assert!(matches!(one(bend(0.0, 0.0, 360.0, 1.0)), Err(TubeError::Range { field: "angle_deg", .. })));
        assert!(matches!(one(bend(0.0, 0.0, 400.0, 1.0)), Err(TubeError::Range { field: "angle_deg", .. })));
        assert!(matches!(one(bend(-1e-9, 0.0, 1.0, 1.0)), Err(TubeError::Range { field: "length_mm", .. })));
        assert!(matches!(
            one(bend(f64::NAN, 0.0, 1.0, 1.0)),
            Err(TubeError::Range { field: "length_mm", .. })
        ));
        assert!(matches!(one(bend(1.0, 0.0, 1.0, 0.0)), Err(TubeError::Range { field: "radius_mm", .. })));
        assert!(one(bend(1.0, 0.0, 0.0, 0.0)).is_ok(), "a zero-angle row needs no radius");
    }

    #[test]
    fn wrapping_keeps_plus_180() {
        assert_eq!(wrap_angle(PI), PI);
        assert!((wrap_angle(-PI) - PI).abs() < 1e-15);
        assert!((wrap_angle(2.0 * PI + 0.1) - 0.1).abs() < 1e-12);
    }
}
