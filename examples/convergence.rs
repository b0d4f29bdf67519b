//! The campaign of simulated production: every line beside the oracle and what is done by hand.
//!
//! `cargo run --release --example convergence -- [--jobs N] [--seed S] [--curves FILE] [--only WORDS]`

#![allow(clippy::print_stdout)]

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context as _;
use benderd::config::Materials;
use benderd::sim::forming::{World, curves};
use benderd::trial::production::controllers::Who;
use benderd::trial::production::lines::{self, Figures, figures};
use benderd::trial::production::parts::Stock;
use clap::Parser;

/// The campaign of simulated production.
#[derive(Debug, Parser)]
struct Args {
    /// Jobs per line.
    #[arg(long, default_value_t = 1000)]
    jobs: u64,
    /// The first seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Curves of a file as a further plant.
    #[arg(long)]
    curves: Option<PathBuf>,
    /// Only lines whose name has this in it.
    #[arg(long, default_value = "")]
    only: String,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let materials = Materials::shipped()?;
    let material = |key: &str| materials.get(key).cloned().with_context(|| format!("no material {key}"));
    let (mut all, mut missed) = (Vec::new(), Vec::new());
    for key in ["steel", "304", "ti-3al-2.5v"] {
        all.extend(lines::of("A", &World::plain(), &material(key)?, &[Stock::INCH]));
        all.extend(lines::of("B", &World::believable(), &material(key)?, &[Stock::INCH]));
    }
    if let Some(file) = &args.curves {
        let curves: Vec<_> = curves::load(file)?.into_iter().map(Arc::new).collect();
        let stocks: Vec<Stock> = curves.iter().map(|curve| Stock::of(curve)).collect();
        let world = World { curves, ..World::believable() };
        all.extend(lines::of("curves", &world, &material("ti-6al-4v")?, &stocks));
    }
    let shown: Vec<_> = all.iter().filter(|line| line.name.contains(&args.only)).collect();
    println!(
        "`convergence --jobs {} --seed {}`: benderd / oracle / deadbeat / half gain\n",
        args.jobs, args.seed
    );
    println!("{HEAD}");
    for line in shown {
        let jobs = Who::ALL.map(|who| line.run(who, args.seed, args.jobs));
        for (name, range) in line.told() {
            row(&line.name, &name, &jobs.each_ref().map(|jobs| figures(jobs, range.clone())));
        }
        let mixed = || jobs[0].iter().flatten().filter_map(|tube| tube.mix_up);
        if mixed().count() > 0 {
            missed.push(format!(
                "{}: {} of {}",
                line.name,
                mixed().filter(|(_, met)| !met).count(),
                mixed().count()
            ));
        }
    }
    if !missed.is_empty() {
        println!("\nMix-ups missed: {}.", missed.join("; "));
    }
    Ok(())
}

const HEAD: &str = "| line | tube | angles 0.3 deg | 0.5 deg | lateral 1 mm | sphere 1 mm | length mm | envelope mm | called good | held falsely | scanned again |
| --- | --- | --- | --- | --- | --- | --- | --- | --: | --: | --: |";

fn row(line: &str, tube: &str, of: &[Figures; 4]) {
    let each = |value: &dyn Fn(&Figures) -> String| of.each_ref().map(value).join(" / ");
    let share = |value: &dyn Fn(&Figures) -> f64| each(&|f| format!("{:.1}", value(f)));
    println!(
        "| {line} | {tube} | {} | {} | {} | {} | {} | {} | {:.1} | {:.2} | {:.1} |",
        share(&|f| f.within_03),
        share(&|f| f.within_05),
        share(&|f| f.lateral_1),
        share(&|f| f.envelope_1),
        each(&|f| format!("{:.3}", f.length_mm)),
        each(&|f| format!("{:.2}", f.envelope_mm)),
        of[0].called_good,
        of[0].held,
        of[0].scanned_again
    );
}
