//! How right and how accurate the reconstruction is on simulated scans: a row per case, totals, targets.
//! `cargo run --release --example accuracy -- thirty|hard|flattened|paper [--seed FIRST] [--count M] [--nominal] [--markdown]`; exit
//! status 0 when the targets of the set are met, 1 when not.

#![allow(clippy::print_stdout)] // an example prints

use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;

use benderd::trial::accuracy::{Known, Set, Tally, heading, markdown, row, run, totals};

#[derive(Debug, Parser)]
struct Args {
    /// thirty (like the benchmark of paper 000), hard (scans spoiled in every way), flattened (thirty's tubes with flattened
    /// outer walls) or paper (its one example).
    set: Set,
    /// Seed of the first case.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Number of cases; the set's usual one if not given.
    #[arg(long)]
    count: Option<u64>,
    /// Gives the nominal (the part as drawn, before this tube sprang back); and then wrong ones, to be recognised.
    #[arg(long)]
    nominal: bool,
    /// Prints the totals alone, as a markdown table without times.
    #[arg(long)]
    markdown: bool,
}

fn main() -> anyhow::Result<ExitCode> {
    let args = Args::parse();
    let folder = tempfile::tempdir().context("no folder for scan files")?;
    let count = args.count.unwrap_or(args.set.usual_count());
    if !args.markdown {
        println!("{}", heading());
    }
    let known = if args.nominal { Known::Nominal } else { Known::Nothing };
    let mut tally = Tally::default();
    for seed in args.seed..args.seed + count {
        let case = run(args.set, seed, known, folder.path())?;
        if !args.markdown {
            println!("{}", row(&case));
        }
        tally.cases.push(case);
    }
    println!("{}", if args.markdown { markdown(&tally, args.set) } else { totals(&tally, args.set) });
    let met = tally.misses(args.set).is_empty();
    Ok(if met { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
