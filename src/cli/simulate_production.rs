//! `benderd simulate production`: many jobs of a part on simulated benders, and how benderd does.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context as _, bail};

use super::progress::Progress;
use super::{Outcome, say};
use crate::config::{Materials, load_part};
use crate::sim::forming::{World, curves};
use crate::trial::production::campaign::{self, Campaign, TUBES};

/// Arguments of `benderd simulate production`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The part file.
    #[arg(long)]
    part: PathBuf,
    /// Another material than the part's: a key of the materials file.
    #[arg(long)]
    material: Option<String>,
    /// Jobs, each on a bender and a batch of its own, eight tubes long.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    jobs: u64,
    /// Same seed, same jobs.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Puts one mix-up into each job: mirrored, another part, an older table, a bend missing, the same scan twice, ...
    #[arg(long)]
    faults: bool,
    /// Spring-back curves of a CSV file instead of the believable bender's laws; those of the part's tube and die.
    #[arg(long, value_name = "FILE")]
    curves: Option<PathBuf>,
    /// Prints one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let materials = Materials::shipped()?;
    let mut part = load_part(&args.part, &materials)?;
    if let Some(key) = &args.material {
        part.material = materials.get(key).cloned().with_context(|| {
            let known: Vec<&str> = materials.keys().collect();
            format!("--material {key:?}: allowed are {}", known.join(", "))
        })?;
    }
    if part.lra.bends.is_empty() {
        bail!("{}: a tube without a bend has nothing to be corrected", args.part.display());
    }
    let mut world = World::believable();
    if let Some(file) = &args.curves {
        let all = curves::load(file)?;
        let fits =
            |c: &curves::Curve| (c.od_mm, c.wall_mm, c.clr_mm) == (part.od_mm, part.wall_mm, part.die_clr_mm);
        world.curves = all.into_iter().filter(fits).map(Arc::new).collect();
        if world.curves.is_empty() {
            bail!(
                "{}: no curve is of the part's tube and die (od_mm = {}, wall_mm = {}, clr_mm = {})",
                file.display(),
                part.od_mm,
                part.wall_mm,
                part.die_clr_mm
            );
        }
    }
    let progress = Progress::new(true);
    progress.stage("bending");
    let done = campaign::run(&part, &world, args.jobs, args.seed, args.faults);
    drop(progress);
    say(&if args.json { serde_json::to_string(&done)? } else { text(&done)? });
    Ok(Outcome::Done)
}

fn text(done: &Campaign) -> anyhow::Result<String> {
    let mut out = String::new();
    writeln!(out, "{} jobs of {} in {}, seed {}", done.jobs, done.part, done.material, done.seed)?;
    writeln!(out, "\ntube  good %  called good %  corrected %  held %  scanned again %")?;
    for t in &done.tubes {
        writeln!(
            out,
            "{:>4}  {:>6.1}  {:>13.1}  {:>11.1}  {:>6.1}  {:>15.1}",
            t.tube,
            t.good_percent,
            t.in_tolerance_percent,
            t.corrected_percent,
            t.held_percent,
            t.scanned_again_percent
        )?;
    }
    writeln!(out, "\ntubes to the first good one: jobs")?;
    for (k, jobs) in done.tubes_to_good.iter().enumerate().filter(|(_, jobs)| **jobs > 0) {
        let number = if k < TUBES { format!("{}", k + 1) } else { format!("more than {TUBES}") };
        writeln!(out, "{number:>12}: {jobs}")?;
    }
    let per_job = done.scrap as f64 / done.jobs as f64;
    writeln!(out, "\nscrap before it: {} tubes, {per_job:.2} per job", done.scrap)?;
    writeln!(out, "held though nothing was wrong: {:.2} % of all tubes", done.false_holds_percent)?;
    if !done.mix_ups.is_empty() {
        writeln!(out, "\nmixed up                      how often  missed")?;
        for (name, met) in &done.mix_ups {
            writeln!(out, "{name:<28}  {:>9}  {:>6}", met.injected, met.missed)?;
        }
    }
    Ok(out)
}
