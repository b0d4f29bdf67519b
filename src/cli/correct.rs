//! `benderd correct`: one step of the loop by hand, history in, next table out.

use std::path::PathBuf;

use anyhow::Context;

use super::{Outcome, say};
use crate::bender::Profile;
use crate::config::{Materials, load_part};
use crate::correct::{Answer, Code, History, Knowledge, Limits, Predicted, Verdict, learn, step, store};
use crate::tube::MachineLimits;

/// Arguments of `benderd correct`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The part file.
    #[arg(long)]
    nominal: PathBuf,
    /// What was commanded and measured so far (JSON).
    #[arg(long)]
    history: PathBuf,
    /// File of what was learned about spring-back: read, and written back with this job in it.
    #[arg(long)]
    knowledge: Option<PathBuf>,
    /// What kind of machine bends it, so that its range and steps are kept: a shipped profile's name or a profile file [default: a
    /// machine without limits].
    #[arg(long, value_name = "PROFILE")]
    bender: Option<String>,
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
    let text = std::fs::read_to_string(&args.history).with_context(|| args.history.display().to_string())?;
    let history: History =
        serde_json::from_str(&text).with_context(|| format!("{}: not a history", args.history.display()))?;
    history.validate().with_context(|| args.history.display().to_string())?;
    let known = match &args.knowledge {
        Some(path) => store::load(path)?,
        None => Knowledge::default(),
    };
    let machine = match &args.bender {
        Some(profile) => Profile::load(profile)?.limits,
        None => MachineLimits::unlimited(),
    };
    let limits = Limits { machine, ..Limits::default() };
    let answer = step(&nominal, &history, &known, &limits);
    if let Some(path) = &args.knowledge {
        let learned = learn(&nominal, &history, &known, &limits);
        if learned != known {
            store::save(path, &learned)?;
        }
    }
    if args.json {
        say(&serde_json::to_string(&answer)?);
    } else {
        say(&table(&answer));
    }
    Ok(match answer.verdict {
        Verdict::FirstPiece | Verdict::InTolerance | Verdict::Correct => Outcome::Done,
        Verdict::Rescan | Verdict::Hold => Outcome::No,
    })
}

fn table(answer: &Answer) -> String {
    let mut lines = vec!["bend  length mm  rotation deg  angle deg  spring-back deg".to_owned()];
    for (i, row) in answer.commanded.bends.iter().enumerate() {
        let of = |list: &[f64]| list.get(i).map_or("-".to_owned(), |v| format!("{v:.2}"));
        lines.push(format!(
            "{:>4}  {:>9.2}  {:>12.2}  {:>9.2}  {} ±{}",
            i + 1,
            row.length_mm,
            row.rotation_rad.to_degrees(),
            row.angle_rad.to_degrees(),
            of(&answer.springback_deg),
            of(&answer.springback_sigma_deg)
        ));
    }
    lines.push(format!(" end  {:>9.2}", answer.commanded.last_length_mm));
    lines.extend(answer.predicted.as_ref().map(expected));
    lines.extend(answer.reasons.iter().map(|r| r.text.clone()));
    lines.push(
        match answer.verdict {
            Verdict::FirstPiece => "first piece: bend one tube with this table and scan it",
            Verdict::InTolerance => "in tolerance: keep this table",
            Verdict::Correct => "correct: bend the next tube with this table and scan it",
            Verdict::Rescan => "rescan: scan the same tube again; the table stays",
            Verdict::Hold if answer.is_about(Code::BatchChanged) => {
                "hold: bend the next tube with this table only when the change is meant to stay"
            }
            Verdict::Hold => "hold: nothing is sent before this is cleared; the table stays",
        }
        .to_owned(),
    );
    lines.join("\n") + "\n"
}

fn expected(predicted: &Predicted) -> String {
    let Predicted { alignment, envelope_mm, worst, .. } = predicted;
    format!(
        "expected of the next tube ({alignment}): check points within {:.2} mm ({} of straight {}), allowed {envelope_mm}; \
         ±{:.2} mm is not known or scatters, slip not counted",
        worst.deviation_mm, worst.place, worst.straight, worst.sigma_mm
    )
}
