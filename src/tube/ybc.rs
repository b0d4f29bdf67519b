//! YBC: the bender's own three axes, Y (feed), B (plane), C (angle), as Eaton Leonard style controls name them.
//!
//! Here in the neutral form: Y incremental from tangent to tangent, B incremental and right-handed like LRA's
//! rotation. What a real machine turns round (cumulative feed, other sign) belongs in its profile.

use super::{Bend, Lra};

/// One row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct YbcRow {
    /// Feed before the bend.
    pub y_mm: f64,
    /// Turn of the plane of bend (POB).
    pub b_rad: f64,
    /// Degree of bend (DOB).
    pub c_rad: f64,
    /// CLR.
    pub radius_mm: f64,
}

/// A table in machine axes; the last row has angle 0 and feeds the tail.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Ybc {
    /// Rows in feed order, the tail last.
    pub rows: Vec<YbcRow>,
}

impl From<&Lra> for Ybc {
    fn from(lra: &Lra) -> Ybc {
        let row = |b: &Bend| YbcRow {
            y_mm: b.length_mm,
            b_rad: b.rotation_rad,
            c_rad: b.angle_rad,
            radius_mm: b.radius_mm,
        };
        let tail = YbcRow { y_mm: lra.last_length_mm, b_rad: 0.0, c_rad: 0.0, radius_mm: 0.0 };
        Ybc { rows: lra.bends.iter().map(row).chain([tail]).collect() }
    }
}

impl From<&Ybc> for Lra {
    /// A last row of angle 0 is the tail; without one the tail is 0.
    fn from(ybc: &Ybc) -> Lra {
        let bend = |r: &YbcRow| Bend {
            length_mm: r.y_mm,
            rotation_rad: r.b_rad,
            angle_rad: r.c_rad,
            radius_mm: r.radius_mm,
        };
        match ybc.rows.split_last() {
            Some((tail, rows)) if tail.c_rad == 0.0 => {
                Lra { bends: rows.iter().map(bend).collect(), last_length_mm: tail.y_mm }
            }
            _ => Lra { bends: ybc.rows.iter().map(bend).collect(), last_length_mm: 0.0 },
        }
    }
}
