//! A tube as measured: every value with one standard deviation, unknown where the data does not carry it.
//!
//! Its serialised form is the contract of `benderd reconstruct --json`, which `inspect` and `correct` read
//! back (also from other programs: fields that only this program adds may be absent there).

use serde::{Deserialize, Serialize};

use super::{Bend, Lra, deg};

/// One measured row. Radians inside, degrees in JSON. `None` is "not known", never a guess.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MeasuredBend {
    /// Straight before the bend.
    pub length_mm: Option<f64>,
    /// Its sigma.
    #[serde(default)]
    pub length_sigma_mm: Option<f64>,
    /// Turn against the bend before; 0 in the first row.
    #[serde(rename = "rotation_deg", with = "deg::option")]
    pub rotation_rad: Option<f64>,
    /// Its sigma.
    #[serde(rename = "rotation_sigma_deg", with = "deg::option", default)]
    pub rotation_sigma_rad: Option<f64>,
    /// Bend angle, always known.
    #[serde(rename = "angle_deg", with = "deg")]
    pub angle_rad: f64,
    /// Its sigma.
    #[serde(rename = "angle_sigma_deg", with = "deg")]
    pub angle_sigma_rad: f64,
    /// CLR as formed.
    #[serde(default)]
    pub radius_mm: Option<f64>,
    /// Its sigma.
    #[serde(default)]
    pub radius_sigma_mm: Option<f64>,
    /// Ovality of the section half way through the bend: largest less smallest diameter over the nominal one, positive
    /// where the tube is flattened in the bend's plane (as a bend does), negative across it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ovality: Option<f64>,
    /// Its sigma.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ovality_sigma: Option<f64>,
    /// How far the outer wall of the section half way through the bend lies within the ellipse, over the nominal diameter:
    /// positive where it is flattened (as it is without a mandrel). Not there where no bend of the tube shows any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flattening: Option<f64>,
    /// Its sigma.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flattening_sigma: Option<f64>,
}

/// A choice about the tube's structure (a bend more or fewer, one CLR for all) and what spoke for it, so that a
/// wrong number of bends can be understood.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// What was tried, in words: "two bends instead of one".
    pub what: String,
    /// The bend in the table that it is about, from 1; none where it is about the whole tube or a bend that is not there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bend: Option<usize>,
    /// Evidence for what was tried over what was there before: fall of the squared residuals over the noise's
    /// variance, less the price of the values added. Above 0 the data asks for it.
    pub gain: f64,
    /// Whether the table given has it.
    pub kept: bool,
}

/// What one scan says of one tube.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MeasuredTube {
    /// Outer radius of the tube.
    pub tube_radius_mm: f64,
    /// Its sigma.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tube_radius_sigma_mm: Option<f64>,
    /// Points in the scan after the door.
    #[serde(default)]
    pub points_total: usize,
    /// Points that the last fit used (the others are outliers).
    #[serde(default)]
    pub points_used: usize,
    /// Median distance of the used points from the fitted surface.
    #[serde(default)]
    pub residual_median_mm: f64,
    /// Wall-clock time from open file to result; the only field that differs between equal runs.
    #[serde(default)]
    pub elapsed_ms: f64,
    /// SHA-256 of the scan file, hex.
    #[serde(default)]
    pub scan_sha256: String,
    /// Straight after the last bend.
    pub last_length_mm: Option<f64>,
    /// Its sigma.
    #[serde(default)]
    pub last_length_sigma_mm: Option<f64>,
    /// Rows in order of travel.
    pub bends: Vec<MeasuredBend>,
    /// End - corner, corner - corner, ..., corner - end; unknown beside bends of 150 degrees or more.
    #[serde(default)]
    pub intersection_mm: Vec<Option<f64>>,
    /// Their sigmas.
    #[serde(default)]
    pub intersection_sigma_mm: Vec<Option<f64>>,
    /// Root mean square distance of each straight's points from its surface; one per straight, or none at all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub straight_rms_mm: Vec<Option<f64>>,
    /// How far the axes beside each bend pass each other; only from programs that measure each straight by itself.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nearest_pass_mm: Vec<Option<f64>>,
    /// Angle of the first end's face from square, where the scan shows it. An obliquely cut tube's length is measured
    /// on its axis.
    #[serde(
        rename = "first_cut_deg",
        with = "deg::option",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub first_cut_rad: Option<f64>,
    /// Its sigma.
    #[serde(
        rename = "first_cut_sigma_deg",
        with = "deg::option",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub first_cut_sigma_rad: Option<f64>,
    /// The same of the last end.
    #[serde(rename = "last_cut_deg", with = "deg::option", default, skip_serializing_if = "Option::is_none")]
    pub last_cut_rad: Option<f64>,
    /// Its sigma.
    #[serde(
        rename = "last_cut_sigma_deg",
        with = "deg::option",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub last_cut_sigma_rad: Option<f64>,
    /// With a nominal: whether the scan was turned round to its direction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reversed: Option<bool>,
    /// What was decided about the structure, in the order of the decisions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub decisions: Vec<Decision>,
    /// What a reader should know before trusting the numbers.
    #[serde(default)]
    pub warnings: Vec<String>,
}

impl MeasuredTube {
    /// From this bend angle on a corner runs away and intersection distances are not given.
    pub const INTERSECTION_LIMIT_RAD: f64 = 150.0 * std::f64::consts::PI / 180.0;

    /// A measurement without any error or uncertainty: for tests and for what simulators know.
    pub fn exact(lra: &Lra, tube_radius_mm: f64) -> MeasuredTube {
        let bend = |b: &Bend| MeasuredBend {
            length_mm: Some(b.length_mm),
            length_sigma_mm: Some(0.0),
            rotation_rad: Some(b.rotation_rad),
            rotation_sigma_rad: Some(0.0),
            angle_rad: b.angle_rad,
            angle_sigma_rad: 0.0,
            radius_mm: Some(b.radius_mm),
            radius_sigma_mm: Some(0.0),
            ovality: None,
            ovality_sigma: None,
            flattening: None,
            flattening_sigma: None,
        };
        let corners = lra.intersection_distances_mm(MeasuredTube::INTERSECTION_LIMIT_RAD);
        MeasuredTube {
            tube_radius_mm,
            tube_radius_sigma_mm: None,
            points_total: 0,
            points_used: 0,
            residual_median_mm: 0.0,
            elapsed_ms: 0.0,
            scan_sha256: String::new(),
            last_length_mm: Some(lra.last_length_mm),
            last_length_sigma_mm: Some(0.0),
            bends: lra.bends.iter().map(bend).collect(),
            intersection_sigma_mm: corners.iter().map(|c| c.map(|_| 0.0)).collect(),
            intersection_mm: corners,
            straight_rms_mm: Vec::new(),
            nearest_pass_mm: Vec::new(),
            first_cut_rad: None,
            first_cut_sigma_rad: None,
            last_cut_rad: None,
            last_cut_sigma_rad: None,
            reversed: None,
            decisions: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// The measured values as a plain table; unknown lengths, rotations and radii are filled from `fallback`
    /// (row by row, when it has as many bends) or with 0. For laying the tube out, not for correcting by.
    pub fn lra_or(&self, fallback: Option<&Lra>) -> Lra {
        let same = fallback.filter(|f| f.bends.len() == self.bends.len());
        let bends = self.bends.iter().enumerate().map(|(i, b)| {
            let f = same.map(|f| f.bends[i]);
            Bend {
                length_mm: b.length_mm.or(f.map(|f| f.length_mm)).unwrap_or(0.0),
                rotation_rad: b.rotation_rad.or(f.map(|f| f.rotation_rad)).unwrap_or(0.0),
                angle_rad: b.angle_rad,
                radius_mm: b.radius_mm.or(f.map(|f| f.radius_mm)).unwrap_or(0.0),
            }
        });
        let bends = bends.collect();
        let last = self.last_length_mm.or(same.map(|f| f.last_length_mm)).unwrap_or(0.0);
        Lra { bends, last_length_mm: last }
    }

    /// The same measurement read from the other end.
    pub fn reversed(&self) -> MeasuredTube {
        let n = self.bends.len();
        let mut out = self.clone();
        for i in 0..n {
            let old = self.bends[n - 1 - i];
            // The straight and the rotation before a bend, seen from the other end, are those after it.
            let (length, sigma) = match i {
                0 => (self.last_length_mm, self.last_length_sigma_mm),
                _ => (self.bends[n - i].length_mm, self.bends[n - i].length_sigma_mm),
            };
            let (rotation, rotation_sigma) = match i {
                0 => (Some(0.0), Some(0.0)),
                _ => (self.bends[n - i].rotation_rad, self.bends[n - i].rotation_sigma_rad),
            };
            out.bends[i] = MeasuredBend {
                length_mm: length,
                length_sigma_mm: sigma,
                rotation_rad: rotation,
                rotation_sigma_rad: rotation_sigma,
                ..old
            };
        }
        if let Some(first) = self.bends.first() {
            out.last_length_mm = first.length_mm;
            out.last_length_sigma_mm = first.length_sigma_mm;
        }
        out.intersection_mm.reverse();
        out.intersection_sigma_mm.reverse();
        out.straight_rms_mm.reverse();
        out.nearest_pass_mm.reverse();
        for bend in out.decisions.iter_mut().filter_map(|d| d.bend.as_mut()) {
            *bend = (n + 1).saturating_sub(*bend);
        }
        (out.first_cut_rad, out.first_cut_sigma_rad) = (self.last_cut_rad, self.last_cut_sigma_rad);
        (out.last_cut_rad, out.last_cut_sigma_rad) = (self.first_cut_rad, self.first_cut_sigma_rad);
        out
    }
}
