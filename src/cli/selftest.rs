//! `benderd selftest`: what a fitter runs at a real machine.

use serde::Serialize;

use super::{Outcome, endpoint_of, run_on, say};
use crate::bender::Profile;
use crate::bender::selftest::{Report, Step, Verdict, run as test};

/// Arguments of `benderd selftest`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// What kind of machine: a shipped profile's name or a profile file.
    #[arg(long, value_name = "PROFILE")]
    bender: String,
    /// Where the machine is; a path begins at this folder [default: the profile's endpoint].
    #[arg(long, value_name = "ADDRESS")]
    on: Option<String>,
    /// Also stages a test pattern, reads it back and clears it. It cannot be committed.
    #[arg(long)]
    write_staging: bool,
    /// Prints the last frames that went over the link.
    #[arg(long)]
    frames: bool,
    /// Prints one JSON object.
    #[arg(long)]
    json: bool,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Printed<'a> {
    bender: &'a str,
    endpoint: &'a str,
    write_staging: bool,
    passed: bool,
    steps: &'a [Step],
    #[serde(skip_serializing_if = "Option::is_none")]
    frames: Option<&'a [String]>,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let profile = Profile::load(&args.bender)?;
    let endpoint = endpoint_of(&profile, args.on.as_deref())?;
    let writes = if args.write_staging { "only the staging area is written" } else { "nothing is written" };
    if !args.json {
        say(&format!("selftest of {} at {endpoint}: {writes}, nothing is committed", profile.name));
    }
    let mut tell = |step: &Step| {
        if !args.json {
            say(&text(step));
        }
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let report = run_on(runtime, test(&profile, &endpoint, args.write_staging, &mut tell))?;
    if args.json {
        let printed = Printed {
            bender: &profile.name,
            endpoint: &endpoint,
            write_staging: args.write_staging,
            passed: report.passed(),
            steps: &report.steps,
            frames: args.frames.then_some(&report.frames[..]),
        };
        say(&serde_json::to_string_pretty(&printed)?);
    } else {
        say(&ending(&report, args.frames));
    }
    Ok(if report.passed() { Outcome::Done } else { Outcome::No })
}

/// A step, and below it what to change.
fn text(step: &Step) -> String {
    let result = match step.result {
        Verdict::Ok => "ok",
        Verdict::Failed => "FAILED",
        Verdict::Skipped => "skipped",
    };
    let mut out = format!("{result:<8} {:<16} {}\n", step.step, step.found);
    step.advice.iter().for_each(|advice| out += &format!("{:<8} change:          {advice}\n", ""));
    out
}

fn ending(report: &Report, frames: bool) -> String {
    let count = |verdict| report.steps.iter().filter(|step| step.result == verdict).count();
    let (ok, failed, skipped) = (count(Verdict::Ok), count(Verdict::Failed), count(Verdict::Skipped));
    let mut out = format!("{ok} ok, {failed} failed, {skipped} skipped\n");
    if frames {
        out += "last frames (> sent, < received):\n";
        report.frames.iter().for_each(|line| out += &format!("{line}\n"));
    }
    out
}
