//! What `benderd push` says to people: the two tables side by side, and how it ended.

use super::push::{Ending, Report};
use crate::bender::{ActiveTable, Job, Outcome, Profile, decode_payload, encode_payload};
use crate::tube::CommandTable;

/// The machine, and the table in force beside the new one, both as the machine holds them.
pub fn comparison(profile: &Profile, report: &Report, job: &Job, active: &ActiveTable) -> String {
    let status = &active.status;
    let on = profile.state_bits.iter().filter(|b| status.state >> b.bit & 1 == 1);
    let names = on.map(|b| b.name.as_str()).collect::<Vec<_>>().join(", ");
    let mut out = format!("bender    {} at {}\n", report.bender, report.endpoint);
    out += &format!("loaded    program {:?} with {} bends\n", status.program, status.bend_count);
    out +=
        &format!("state     0x{:04X}: {}\n", status.state, if names.is_empty() { "nothing" } else { &names });
    out += &format!("active    {}\n", status.active);
    if let Some(new) = report.new {
        out += &format!("new       {new}, for program {:?}\n", report.program);
    }
    let now = decode_payload(profile, &active.payload).map(|(_, table)| table).unwrap_or_default();
    let rounded = encode_payload(profile, &job.program, &job.table)
        .ok()
        .and_then(|payload| decode_payload(profile, &payload).ok());
    match rounded {
        Some((_, new)) => out + &side_by_side(&now, &new),
        None => out,
    }
}

fn side_by_side(now: &CommandTable, new: &CommandTable) -> String {
    let mut out = format!(
        "\n{:>4}  {:^21}  {:^21}  {:^21}\n{:>4}  {n:>10} {w:>10}  {n:>10} {w:>10}  {n:>10} {w:>10}\n",
        "",
        "length mm",
        "rotation deg",
        "angle deg",
        "bend",
        n = "now",
        w = "new"
    );
    for i in 0..now.bends.len().max(new.bends.len()) {
        let pair = |value: &dyn Fn(usize, &CommandTable) -> Option<f64>, decimals: usize| {
            let cell = |table| value(i, table).map_or("-".into(), |v| format!("{:.decimals$}", v + 0.0));
            format!("  {:>10} {:>10}", cell(now), cell(new))
        };
        let length = pair(&|i, t| t.bends.get(i).map(|b| b.length_mm), 2);
        let rotation = pair(&|i, t| t.bends.get(i).map(|b| b.rotation_rad.to_degrees()), 3);
        let angle = pair(&|i, t| t.bends.get(i).map(|b| b.angle_rad.to_degrees()), 3);
        out += &format!("{:>4}{length}{rotation}{angle}\n", i + 1);
    }
    let last = if now.bends.is_empty() { "-".into() } else { format!("{:.2}", now.last_length_mm) };
    out += &format!("{:>4}  {last:>10} {:>10.2}\n", "last", new.last_length_mm);
    out.lines().map(|line| format!("{}\n", line.trim_end())).collect::<String>() + "\n"
}

/// The last lines: what was done for stdout, refusals and warnings for stderr.
pub fn ending(report: &Report) -> (String, String) {
    let (mut out, mut err) = (String::new(), String::new());
    if let Some(resolved) = &report.resolved {
        out +=
            &format!("earlier   a delivery whose outcome was open is decided now: {}\n", one_line(resolved));
    }
    match &report.result {
        Ending::WouldApply { .. } => {
            out += "dry run   nothing was written; the table would be staged, verified and committed\n";
        }
        Ending::Delivered(outcome @ (Outcome::Applied(_) | Outcome::AlreadyActive(_))) => {
            out += &format!("done      {}\n", one_line(outcome));
        }
        Ending::Delivered(Outcome::Rejected { reasons }) => {
            err += "refused: the machine's table was not changed\n";
            reasons.iter().for_each(|reason| err += &format!("  {reason}\n"));
        }
        Ending::Delivered(Outcome::NotApplied { why }) => {
            err += &format!("failed: {why}\n  the machine's table was not changed by this\n");
        }
        Ending::Delivered(Outcome::Unknown { why }) => {
            err += &format!(
                "unknown: {why}\n  look at the machine before bending; push again when it answers: its table is \
                 read first\n"
            );
        }
    }
    match (report.record, &report.journal) {
        (Some(record), Some(journal)) => out += &format!("journal   record {record} in {journal}\n"),
        (None, Some(journal)) => {
            err += &format!("warning: the outcome could not be written to journal {journal}\n");
        }
        (_, None) => {}
    }
    (out, err)
}

fn one_line(outcome: &Outcome) -> String {
    match outcome {
        Outcome::Applied(id) => format!("applied and read back: {id}"),
        Outcome::AlreadyActive(id) => format!("this table is active already, nothing was sent: {id}"),
        Outcome::Rejected { reasons } => {
            let texts = reasons.iter().map(ToString::to_string).collect::<Vec<_>>();
            format!("refused: {}", texts.join("; "))
        }
        Outcome::NotApplied { why } => format!("not applied: {why}"),
        Outcome::Unknown { why } => format!("unknown: {why}"),
    }
}
