//! `benderd inspect`: one measured tube against its part; a table for people or one JSON object.

use std::path::PathBuf;

use anyhow::Context;

use super::{Outcome, ScanUnit, say};
use crate::cell::measure;
use crate::config::{Materials, load_part};
use crate::inspect::{Comparison, Inspection, Place, State, Verdict, inspect};
use crate::tube::{MeasuredTube, Nominal};

/// Arguments of `benderd inspect`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The scan, or what `benderd reconstruct --json` printed of it (.json).
    scan: PathBuf,
    /// The part file.
    #[arg(long, value_name = "PART")]
    nominal: PathBuf,
    /// Unit of the scan's coordinates.
    #[arg(long, value_enum, default_value_t)]
    unit: ScanUnit,
    /// Materials file instead of the built-in one.
    #[arg(long)]
    materials: Option<PathBuf>,
    /// Prints one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let nominal = load_part(&args.nominal, &Materials::load(args.materials.as_deref())?)?;
    let measured = measured(args, &nominal)?;
    let inspection = inspect(&measured, &nominal).with_context(|| args.scan.display().to_string())?;
    if args.json {
        say(&serde_json::to_string(&inspection)?);
    } else {
        say(&table(&inspection));
    }
    Ok(if inspection.verdict == Verdict::InTolerance { Outcome::Done } else { Outcome::No })
}

fn measured(args: &Args, nominal: &Nominal) -> anyhow::Result<MeasuredTube> {
    let file = args.scan.display();
    if args.scan.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
        let text = std::fs::read_to_string(&args.scan).with_context(|| file.to_string())?;
        return serde_json::from_str(&text)
            .with_context(|| format!("{file}: not what `reconstruct --json` prints"));
    }
    measure(&args.scan, args.unit.into(), Some(nominal)).map_err(anyhow::Error::msg)
}

fn table(inspection: &Inspection) -> String {
    let mut lines = vec![format!(
        "{}: alignment {}, envelope {} mm",
        inspection.part, inspection.alignment, inspection.envelope_mm
    )];
    if !inspection.points.is_empty() {
        lines.push("straight  start mm        middle mm       end mm".to_owned());
        let last = inspection.points.iter().map(|p| p.straight).max().unwrap_or(0);
        for straight in 1..=last {
            let cell = |place| point(inspection, straight, place);
            let row = format!(
                "{straight:>8}  {:16}{:16}{}",
                cell(Place::Start),
                cell(Place::Middle),
                cell(Place::End)
            );
            lines.push(row.trim_end().to_owned());
        }
    }
    if !inspection.bends.is_empty() {
        lines.push("bend  value         nominal   measured   sigma  deviation".to_owned());
    }
    for b in &inspection.bends {
        for (name, c) in [
            ("length mm", &b.length_mm),
            ("rotation deg", &b.rotation_deg),
            ("angle deg", &b.angle_deg),
            ("radius mm", &b.radius_mm),
        ] {
            lines.push(format!("{:>4}  {}", b.bend, value(name, c)));
        }
    }
    if let Some(last) = &inspection.last_length_mm {
        lines.push(format!(" end  {}", value("length mm", last)));
    }
    lines.extend(inspection.notes.iter().map(|n| format!("note: {n}")));
    lines.push(inspection.advice.clone());
    lines.join("\n") + "\n"
}

fn point(inspection: &Inspection, straight: usize, place: Place) -> String {
    let found = inspection.points.iter().find(|p| p.straight == straight && p.place == place);
    match found {
        Some(p) => format!("{:.3} ±{:.3} {}", p.deviation_mm, p.sigma_mm, mark(Some(p.state))),
        None => "-".to_owned(),
    }
}

fn value(name: &str, c: &Comparison) -> String {
    let or_dash = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.3}"));
    let deviation = c.deviation.map_or("-".to_owned(), |v| format!("{v:+.3}"));
    format!(
        "{name:12} {:>8.3}  {:>9}  {:>6}  {deviation:>9} {}",
        c.nominal,
        or_dash(c.measured),
        or_dash(c.sigma),
        mark(c.state)
    )
    .trim_end()
    .to_owned()
}

fn mark(state: Option<State>) -> &'static str {
    match state {
        Some(State::Out) => "OUT",
        Some(State::Uncertain) => "?",
        Some(State::In) | None => "",
    }
}
