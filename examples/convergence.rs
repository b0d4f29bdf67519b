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
    let mut all = Vec::new();
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
    println!(
        "| line | part | who | 0.3 deg | 0.5 deg | lateral 1 mm | envelope 1 mm | good | length mm | envelope mm | called good | held | scanned again |"
    );
    println!("| --- | --- | --- | --: | --: | --: | --: | --: | --: | --: | --: | --: | --: |");
    for line in all.iter().filter(|line| line.name.contains(&args.only)) {
        for who in Who::ALL {
            let jobs = line.run(who, args.seed, args.jobs);
            for (name, range) in line.told() {
                row(&line.name, &name, who, &figures(&jobs, range));
            }
        }
    }
    Ok(())
}

fn row(line: &str, part: &str, who: Who, f: &Figures) {
    println!(
        "| {line} | {part} | {who:?} | {:.1} | {:.1} | {:.1} | {:.1} | {:.1} | {:.3} | {:.3} | {:.1} | {:.1} | {:.1} |",
        f.within_03,
        f.within_05,
        f.lateral_1,
        f.envelope_1,
        f.good,
        f.length_mm,
        f.envelope_mm,
        f.called_good,
        f.held,
        f.scanned_again
    );
}
