//! Measured tube against nominal: alignment, deviations, verdict.
//!
//! Between `reconstruct` and `correct`. The decision, after the trade's rule "accept on tangent points, not on
//! LRA" (field notes of the design):
//!
//! - every check point (start, middle, end of each straight, so the tube's ends too) within the envelope after
//!   the part's named alignment, and every bend angle within its tolerance, both with a guard band of 2 sigma;
//! - a length or rotation (they scatter on shallow bends and short straights though the shape is right) refuses a
//!   tube only when it is out for certain; where the scan doubts it, the check points speak for it;
//! - what the scan does not know (null) is left out and said; a tube with unseen check points is not accepted.

mod deviation;
mod fit;
mod laid;
mod overlay;

use serde::Serialize;
use thiserror::Error;

pub use deviation::{BendDeviation, Comparison, Place, PointDeviation, State, judge};
pub use fit::{Misfit, Reading, misfit, reading};
pub use laid::{Known, corners, distances, rotation, table_distances};
pub use overlay::{Overlay, check_point};

use crate::tube::{Alignment, Lra, MeasuredTube, Nominal, wrap_angle};
use deviation::{Compared, compare};
use laid::Layout;

/// Why a measurement cannot be inspected at all.
#[derive(Debug, Error, PartialEq)]
pub enum InspectError {
    /// A measured value that no tube can have.
    #[error("measured tube, row {row}: {field} is {found}, allowed is {allowed}")]
    Range {
        /// Row counted from 1, the tail after the last bend.
        row: usize,
        /// Name of the value with its unit.
        field: &'static str,
        /// What was found.
        found: f64,
        /// What would be accepted.
        allowed: &'static str,
    },
    /// A list whose length does not fit the bends.
    #[error("measured tube: {field} has {found} values, expected none or {expected} (bends + 1)")]
    Count {
        /// Name of the list.
        field: &'static str,
        /// Values found.
        found: usize,
        /// Values wanted.
        expected: usize,
    },
}

/// The decision on one tube.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// All that counts is within tolerance, guard band included.
    InTolerance,
    /// Something that counts is out of tolerance for certain.
    OutOfTolerance,
    /// Neither: scan again.
    Uncertain,
    /// The mirror image of the part.
    WrongHand,
    /// Another number of bends, or too far off to be this part.
    WrongPart,
}

/// What one scan says about one part.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Inspection {
    /// The decision.
    pub verdict: Verdict,
    /// The same with what to do, in one line.
    pub advice: String,
    /// Name of the part.
    pub part: String,
    /// Whether the scan was turned round to the nominal's direction here.
    pub turned_round: bool,
    /// False where the other direction fits nearly as well.
    pub direction_clear: bool,
    /// How the tubes were laid over each other.
    pub alignment: Alignment,
    /// Radius of the sphere around each check point.
    pub envelope_mm: f64,
    /// Root mean square distance of the check points in that alignment.
    pub rms_mm: Option<f64>,
    /// Check points; empty where a comparison would be an invention (wrong hand, other bend count).
    pub points: Vec<PointDeviation>,
    /// Rows; empty with another bend count.
    pub bends: Vec<BendDeviation>,
    /// The straight after the last bend.
    pub last_length_mm: Option<Comparison>,
    /// Outer diameter: information.
    pub tube_diameter_mm: Comparison,
    /// What a reader should know: values left out, odd findings, the scan's own warnings.
    pub notes: Vec<String>,
}

impl Inspection {
    /// Whether every check point was measured.
    pub fn is_whole(&self) -> bool {
        self.points.len() == 3 * (self.bends.len() + 1)
    }
}

/// Says so when the tube measured is not of the part's diameter.
pub fn other_diameter(measured: &MeasuredTube, nominal: &Nominal) -> Option<String> {
    let (found, wanted) = (2.0 * measured.tube_radius_mm, nominal.od_mm);
    nominal
        .is_other_tube(measured.tube_radius_mm)
        .then(|| format!("the tube's diameter is {found:.2} mm, the part's is {wanted} mm"))
}

/// Inspects one measured tube. Rows of angle 0 in the nominal are merged first: no scan shows them.
pub fn inspect(measured: &MeasuredTube, nominal: &Nominal) -> Result<Inspection, InspectError> {
    check(measured)?;
    let wanted = nominal.lra.merged();
    let mut out = empty(measured, nominal);
    let settled = measured.reversed.is_some();
    if let Some(note) = other_diameter(measured, nominal) {
        out.notes.push(note);
        return Ok(decided(out, Verdict::WrongPart));
    }
    if measured.bends.len() != wanted.bends.len() {
        out.notes.push(count_note(measured, &wanted, settled));
        return Ok(decided(out, Verdict::WrongPart));
    }
    let reading = reading(measured, &wanted, settled);
    out.turned_round = reading.reversed;
    out.direction_clear = reading.clear;
    let turned = if reading.reversed { measured.reversed() } else { measured.clone() };
    let layout = Layout::new(&turned, &wanted);
    rows(&mut out, &layout, &turned, &wanted, nominal);
    if reading.wrong_hand {
        return Ok(decided(out, Verdict::WrongHand));
    }
    points(&mut out, &layout, &wanted, nominal);
    if !reading.misfit.far.is_empty() {
        out.notes.extend(reading.misfit.far);
        return Ok(decided(out, Verdict::WrongPart));
    }
    if !reading.clear {
        let note = "the tube fits nearly as well from its other end: mark the first end when scanning";
        out.notes.push(note.to_owned());
    }
    let verdict = verdict(&out);
    Ok(decided(out, verdict))
}

/// The last straight of a tube measured in the nominal's direction, as [`inspect`] has it; None with another number of bends.
pub fn last_length(measured: &MeasuredTube, nominal: &Nominal) -> Option<Comparison> {
    let wanted = nominal.lra.merged();
    let same = measured.bends.len() == wanted.bends.len();
    same.then(|| last_straight(&Layout::new(measured, &wanted), &wanted, nominal))
}

fn last_straight(layout: &Layout, wanted: &Lra, nominal: &Nominal) -> Comparison {
    let known = layout.distance[wanted.bends.len()];
    let measured = known.map(|_| layout.lra().last_length_mm);
    let tolerance = Some(nominal.tolerance.length_mm);
    comparison(wanted.last_length_mm, measured, known.map(|k| k.sigma), tolerance)
}

/// Refuses values that no tube can have.
pub fn check(measured: &MeasuredTube) -> Result<(), InspectError> {
    let range = |row, field, value: Option<f64>, min: f64, max: f64, allowed| match value {
        Some(found) if !(min..=max).contains(&found) => {
            Err(InspectError::Range { row, field, found, allowed })
        }
        _ => Ok(()),
    };
    const LENGTH: &str = "-10 to 100000 or null";
    const SIGMA: &str = "0 to 1000 or null";
    for (i, b) in measured.bends.iter().enumerate() {
        let row = i + 1;
        let deg = |rad: Option<f64>| rad.map(f64::to_degrees);
        range(row, "length_mm", b.length_mm, -10.0, 1e5, LENGTH)?;
        range(row, "length_sigma_mm", b.length_sigma_mm, 0.0, 1e3, SIGMA)?;
        range(row, "rotation_deg", deg(b.rotation_rad), -3600.0, 3600.0, "-3600 to 3600 or null")?;
        range(row, "rotation_sigma_deg", deg(b.rotation_sigma_rad), 0.0, 1e3, SIGMA)?;
        range(row, "angle_deg", deg(Some(b.angle_rad)), 0.0, 360.0, "0 to 360")?;
        range(row, "angle_sigma_deg", deg(Some(b.angle_sigma_rad)), 0.0, 360.0, "0 to 360")?;
        range(row, "radius_mm", b.radius_mm, 1e-3, 1e5, "0.001 to 100000 or null")?;
        range(row, "radius_sigma_mm", b.radius_sigma_mm, 0.0, 1e5, "0 to 100000 or null")?;
    }
    let tail = measured.bends.len() + 1;
    range(tail, "last_length_mm", measured.last_length_mm, -10.0, 1e5, LENGTH)?;
    range(tail, "last_length_sigma_mm", measured.last_length_sigma_mm, 0.0, 1e3, SIGMA)?;
    range(tail, "tube_radius_mm", Some(measured.tube_radius_mm), 0.0, 1e4, "0 to 10000")?;
    let lists = [
        ("intersection_mm", &measured.intersection_mm, -10.0, LENGTH),
        ("intersection_sigma_mm", &measured.intersection_sigma_mm, 0.0, SIGMA),
    ];
    for (field, list, min, allowed) in lists {
        if !list.is_empty() && list.len() != tail {
            return Err(InspectError::Count { field, found: list.len(), expected: tail });
        }
        for (j, value) in list.iter().enumerate() {
            range(j + 1, field, *value, min, 1e6, allowed)?;
        }
    }
    Ok(())
}

fn empty(measured: &MeasuredTube, nominal: &Nominal) -> Inspection {
    let diameter = 2.0 * measured.tube_radius_mm;
    let mut notes = measured.warnings.clone();
    if diameter > 0.0 && (diameter - nominal.od_mm).abs() > 0.05 * nominal.od_mm {
        let od = nominal.od_mm;
        notes.push(format!("tube diameter {diameter:.2} mm instead of {od:.2}: other tube or scale?"));
    }
    Inspection {
        verdict: Verdict::Uncertain,
        advice: String::new(),
        part: nominal.name.clone(),
        turned_round: false,
        direction_clear: true,
        alignment: nominal.tolerance.alignment,
        envelope_mm: nominal.tolerance.envelope_mm,
        rms_mm: None,
        points: Vec::new(),
        bends: Vec::new(),
        last_length_mm: None,
        tube_diameter_mm: comparison(nominal.od_mm, Some(diameter), None, None),
        notes,
    }
}

fn count_note(measured: &MeasuredTube, wanted: &Lra, settled: bool) -> String {
    let (found, expected) = (measured.bends.len(), wanted.bends.len());
    let kind = if found < expected { "missing" } else { "too many" };
    match fit::odd_bend(measured, wanted, settled) {
        Some(bend) => format!("{found} bends instead of {expected}: bend {bend} is {kind}"),
        None => format!("{found} bends instead of {expected}"),
    }
}

fn comparison(nominal: f64, measured: Option<f64>, sigma: Option<f64>, tolerance: Option<f64>) -> Comparison {
    let deviation = measured.map(|m| m - nominal);
    let tolerance = tolerance.filter(|_| deviation.is_some());
    let state = deviation.zip(tolerance).map(|(d, t)| judge(d, t, sigma.unwrap_or(0.0)));
    Comparison { nominal, measured, sigma, deviation, tolerance, state }
}

fn rows(out: &mut Inspection, layout: &Layout, turned: &MeasuredTube, wanted: &Lra, nominal: &Nominal) {
    let tolerance = &nominal.tolerance;
    let deg = f64::to_degrees;
    let laid = layout.lra();
    let length = |j: usize, nominal: f64, measured: f64| {
        let known = layout.distance[j];
        comparison(nominal, known.map(|_| measured), known.map(|k| k.sigma), Some(tolerance.length_mm))
    };
    for (i, w) in wanted.bends.iter().enumerate() {
        let turn = layout.rotation[i];
        let near = |k: Known| deg(w.rotation_rad + wrap_angle(k.value - w.rotation_rad));
        let (angle, own) = (layout.angle[i], &turned.bends[i]);
        let rotation_tolerance = Some(deg(tolerance.rotation_rad));
        out.bends.push(BendDeviation {
            bend: i + 1,
            length_mm: length(i, w.length_mm, laid.bends[i].length_mm),
            rotation_deg: comparison(
                deg(w.rotation_rad),
                turn.map(near),
                turn.map(|k| deg(k.sigma)),
                rotation_tolerance,
            ),
            angle_deg: comparison(
                deg(w.angle_rad),
                Some(deg(angle.value)),
                Some(deg(angle.sigma)),
                Some(deg(tolerance.angle_rad)),
            ),
            radius_mm: comparison(w.radius_mm, own.radius_mm, own.radius_sigma_mm, None),
        });
        if i > 0 && turn.is_none() {
            out.notes.push(format!("rotation {} is not known: points beyond it are left out", i + 1));
        }
    }
    out.last_length_mm = Some(last_straight(layout, wanted, nominal));
    for (j, _) in layout.distance.iter().enumerate().filter(|(_, d)| d.is_none()) {
        out.notes.push(format!(
            "length of straight {} is not known: points that depend on it are left out",
            j + 1
        ));
    }
}

fn points(out: &mut Inspection, layout: &Layout, wanted: &Lra, nominal: &Nominal) {
    let tolerance = &nominal.tolerance;
    match compare(layout, wanted, tolerance.alignment, tolerance.envelope_mm) {
        Some(Compared { rms_mm, points }) => {
            out.rms_mm = Some(rms_mm);
            out.points = points;
        }
        None => out.notes.push("the straight that the alignment rests on was not measured".to_owned()),
    }
}

fn verdict(inspection: &Inspection) -> Verdict {
    let points = inspection.points.iter().map(|p| p.state);
    let angles = inspection.bends.iter().filter_map(|b| b.angle_deg.state);
    let others = lengths_and_turns(inspection).filter_map(|(_, c)| c.state).filter(|s| *s == State::Out);
    let states: Vec<State> = points.chain(angles).chain(others).collect();
    if states.contains(&State::Out) {
        Verdict::OutOfTolerance
    } else if states.contains(&State::Uncertain) || !inspection.is_whole() {
        Verdict::Uncertain
    } else {
        Verdict::InTolerance
    }
}

/// Lengths and rotations with their names.
fn lengths_and_turns(inspection: &Inspection) -> impl Iterator<Item = (String, &Comparison)> {
    let tail = inspection.bends.len() + 1;
    let rows = inspection.bends.iter().flat_map(|b| {
        [
            (format!("length of straight {}", b.bend), &b.length_mm),
            (format!("rotation {}", b.bend), &b.rotation_deg),
        ]
    });
    let last = inspection.last_length_mm.iter().map(move |c| (format!("length of straight {tail}"), c));
    rows.chain(last)
}

/// What is off by most of its tolerance among those in the wanted state, in words.
fn worst(inspection: &Inspection, state: State) -> Option<String> {
    let mut found: Vec<(f64, String)> = Vec::new();
    for p in inspection.points.iter().filter(|p| p.state == state) {
        let text = format!("{} of straight {} is {:.2} mm off", p.place, p.straight, p.deviation_mm);
        found.push((p.deviation_mm / inspection.envelope_mm, text));
    }
    let angles = inspection.bends.iter().map(|b| (format!("angle of bend {}", b.bend), &b.angle_deg));
    let others = lengths_and_turns(inspection).filter(|_| state == State::Out);
    for (name, c) in angles.chain(others).filter(|(_, c)| c.state == Some(state)) {
        if let (Some(deviation), Some(tolerance)) = (c.deviation, c.tolerance) {
            let text = format!("{name} is off by {deviation:+.2} (tolerance {tolerance})");
            found.push((deviation.abs() / tolerance, text));
        }
    }
    found.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, text)| text)
}

fn decided(mut out: Inspection, verdict: Verdict) -> Inspection {
    out.verdict = verdict;
    out.advice = match verdict {
        Verdict::InTolerance => "in tolerance".to_owned(),
        Verdict::OutOfTolerance => {
            let what = worst(&out, State::Out).unwrap_or_default();
            format!("out of tolerance: {what}; correct the table")
        }
        Verdict::Uncertain => {
            let unseen = "not every check point was measured".to_owned();
            let what = worst(&out, State::Uncertain).unwrap_or(unseen);
            format!("not certain: {what}; scan again, more densely there")
        }
        Verdict::WrongHand => {
            "wrong hand: the mirror image fits better; check program and loading".to_owned()
        }
        Verdict::WrongPart => {
            let why = out.notes.last().map_or("", String::as_str);
            format!("not this part: {why}; check which part was scanned and which program ran")
        }
    };
    out
}
