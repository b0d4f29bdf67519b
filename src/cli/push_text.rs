//! What `benderd push` says to people: the two tables side by side, and how it ended.

use super::push::{Ending, Report};
use crate::bender::{ActiveTable, Job, Outcome, Profile, decode_payload, encode_payload};
use crate::tube::CommandTable;

/// The machine, and the table in force beside the new one, both as the machine holds them.
pub fn comparison(profile: &Profile, report: &Report, job: &Job, active: &ActiveTable) {
    let status = &active.status;
    println!("bender    {} at {}", report.bender, report.endpoint);
    println!("loaded    program {:?} with {} bends", status.program, status.bend_count);
    let on = profile.state_bits.iter().filter(|b| status.state >> b.bit & 1 == 1);
    let names = on.map(|b| b.name.as_str()).collect::<Vec<_>>().join(", ");
    println!("state     0x{:04X}: {}", status.state, if names.is_empty() { "nothing" } else { &names });
    println!("active    {}", status.active);
    if let Some(new) = report.new {
        println!("new       {new}, for program {:?}", report.program);
    }
    let now = decode_payload(profile, &active.payload).map(|(_, table)| table).unwrap_or_default();
    let rounded = encode_payload(profile, &job.program, &job.table)
        .ok()
        .and_then(|payload| decode_payload(profile, &payload).ok());
    if let Some((_, new)) = rounded {
        print!("{}", side_by_side(&now, &new));
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

/// The last lines: results to stdout, refusals to stderr.
pub fn ending(report: &Report) {
    if let Some(resolved) = &report.resolved {
        println!("earlier   a delivery whose outcome was open is decided now: {}", one_line(resolved));
    }
    match &report.result {
        Ending::WouldApply { .. } => {
            println!("dry run   nothing was written; the table would be staged, verified and committed");
        }
        Ending::Delivered(outcome @ (Outcome::Applied(_) | Outcome::AlreadyActive(_))) => {
            println!("done      {}", one_line(outcome));
        }
        Ending::Delivered(Outcome::Rejected { reasons }) => {
            eprintln!("refused: the machine's table was not changed");
            reasons.iter().for_each(|reason| eprintln!("  {reason}"));
        }
        Ending::Delivered(Outcome::NotApplied { why }) => {
            eprintln!("failed: {why}");
            eprintln!("  the machine's table was not changed by this");
        }
        Ending::Delivered(Outcome::Unknown { why }) => {
            eprintln!("unknown: {why}");
            eprintln!(
                "  look at the machine before bending; push again when it answers: its table is read first"
            );
        }
    }
    match (report.record, &report.journal) {
        (Some(record), Some(journal)) => println!("journal   record {record} in {journal}"),
        (None, Some(journal)) => eprintln!("warning: the outcome could not be written to journal {journal}"),
        (_, None) => {}
    }
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
