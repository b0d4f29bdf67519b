//! What the demo tells a newcomer: what is simulated, what is real, each part, the end.

use std::fmt::Write;

use super::demo::{Demo, DemoResult};
use super::record::PartRecord;

/// Before the first part.
pub fn header(demo: &Demo, address: &str) -> String {
    let (n, t) = (&demo.nominal, &demo.nominal.tolerance);
    let (angle, envelope) = (t.angle_rad.to_degrees(), t.envelope_mm);
    format!(
        "benderd demo: {} bends of {} in {} ({} x {} mm, CLR {} mm), seed {}\n\
         \n\
         simulated  the tube, which springs back by an amount that benderd does not know; the bender;\n\
         \x20          the laser scan arm, which sees the tube from one side and writes PLY files\n\
         real       benderd's own loop: it reads each scan, reconstructs the tube, compares it with the\n\
         \x20          nominal, learns the spring-back, and delivers a corrected table over Modbus TCP to\n\
         \x20          {address} ({}): staged, read back, committed, verified, journalled\n\
         tolerance  angles ±{angle:.2} deg; every check point within {envelope:.1} mm of the nominal\n\
         \n",
        n.lra.bends.len(),
        n.name,
        n.material.key,
        n.od_mm,
        n.wall_mm,
        n.die_clr_mm,
        demo.seed,
        demo.profile.name,
    )
}

/// After each part. `off_mm`: the next tube would be that much too long, so it is cut otherwise.
pub fn part(part: &PartRecord, off_mm: Option<f64>) -> String {
    let mut out = part.table();
    if let Some(off_mm) = off_mm {
        let how = if off_mm > 0.0 { "shorter" } else { "longer" };
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "    the tail is the cut's matter, no feed corrects it: the operator cuts the next tube {:.1} mm {how}",
            off_mm.abs()
        );
    }
    out.push('\n');
    out
}

/// After the last part.
pub fn ending(result: &DemoResult, journal_records: i64) -> String {
    let mut out = format!("The journal holds {journal_records} records and its chain is whole.\n");
    let parts = result.parts.len();
    let worst = result.parts.last().map_or(0.0, PartRecord::worst_angle_deg);
    let off = result.parts.last().and_then(PartRecord::worst).map_or(0.0, |p| p.deviation_mm);
    let verdict = if result.in_tolerance { "In tolerance on" } else { "Still out of tolerance on" };
    let _ =
        writeln!(out, "{verdict} part {parts}: worst angle {worst:.2} deg, worst check point {off:.2} mm.");
    out
}
