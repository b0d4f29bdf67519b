//! What a trial keeps of each part, and how it is told as text.

use std::fmt::Write;

use crate::inspect::{Inspection, Place, PointDeviation};
use crate::tube::{CommandTable, MeasuredTube};

/// One bent, scanned and judged part.
#[derive(Debug, Clone)]
pub struct PartRecord {
    /// Counted from 1.
    pub number: usize,
    /// Revision of the table it was bent with.
    pub revision: u32,
    /// That table.
    pub commanded: CommandTable,
    /// What the scan gave.
    pub measured: MeasuredTube,
    /// Against the nominal.
    pub inspection: Inspection,
    /// The table decided on next; None where the one in force stays.
    pub next: Option<CommandTable>,
}

impl PartRecord {
    /// The check point that lies farthest off, if the scan carries any.
    pub fn worst(&self) -> Option<&PointDeviation> {
        self.inspection.points.iter().max_by(|a, b| a.deviation_mm.total_cmp(&b.deviation_mm))
    }

    /// The largest angle deviation in degrees, as a size.
    pub fn worst_angle_deg(&self) -> f64 {
        let sizes = self.inspection.bends.iter().filter_map(|b| b.angle_deg.deviation).map(f64::abs);
        sizes.fold(0.0, f64::max)
    }

    /// The part as a table for people: a row per bend, then the envelope and the inspection's words.
    pub fn table(&self) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = self.write_table(&mut out);
        out
    }

    fn write_table(&self, out: &mut String) -> std::fmt::Result {
        writeln!(out, "  Part {}, bent with table revision {}", self.number, self.revision)?;
        writeln!(
            out,
            "    bend   angle   commanded         measured   deviation     next   rotation    length"
        )?;
        writeln!(
            out,
            "             deg         deg              deg         deg  command   dev. deg   dev. mm"
        )?;
        for (i, bend) in self.inspection.bends.iter().enumerate() {
            let angle = &bend.angle_deg;
            let commanded = self.commanded.bends.get(i).map(|row| row.angle_rad.to_degrees());
            let next = self.next.as_ref().and_then(|t| t.bends.get(i)).map(|row| row.angle_rad.to_degrees());
            let change = next.zip(commanded).map(|(n, c)| n - c).filter(|d| d.abs() >= 0.005);
            writeln!(
                out,
                "    {:>4} {:7.2} {:>11} {:>8} ± {:<5} {:>11} {:>8} {:>10} {:>9}",
                bend.bend,
                angle.nominal,
                number(commanded, 2, false),
                number(angle.measured, 2, false),
                number(angle.sigma, 3, false),
                number(angle.deviation, 2, true),
                number(change, 2, true),
                number(bend.rotation_deg.deviation.filter(|_| i > 0), 2, true),
                number(bend.length_mm.deviation, 2, true),
            )?;
        }
        let tail = self.inspection.last_length_mm.as_ref().and_then(|c| c.deviation);
        writeln!(out, "    tail {:>78}", number(tail, 2, true))?;
        if let Some(worst) = self.worst() {
            let (mm, limit) = (worst.deviation_mm, self.inspection.envelope_mm);
            let place = place(worst);
            writeln!(out, "    worst check point: {mm:.2} mm at the {place}, allowed {limit:.2} mm")?;
        }
        writeln!(out, "    {}", self.inspection.advice)
    }
}

/// A check point's place in words.
pub fn place(point: &PointDeviation) -> String {
    let place = match point.place {
        Place::Start => "start",
        Place::Middle => "middle",
        Place::End => "end",
    };
    format!("{place} of straight {}", point.straight)
}

fn number(value: Option<f64>, digits: usize, signed: bool) -> String {
    match value {
        // A deviation that rounds to nothing has no sign.
        Some(v) if signed && v.abs() < 0.5 * 0.1_f64.powi(digits as i32) => format!("{:.digits$}", 0.0),
        Some(v) if signed => format!("{v:+.digits$}"),
        Some(v) => format!("{v:.digits$}"),
        None => "-".into(),
    }
}
