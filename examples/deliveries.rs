//! Deliveries over a link that fails, in simulated time: `cargo run --release --example deliveries -- --count 10000`. Prints how they
//! ended; exit status 1 when something that must hold did not.

#![allow(clippy::print_stdout)] // a program of its own

use std::process::ExitCode;
use std::time::Instant;

use anyhow::Context as _;
use benderd::bender::Profile;
use benderd::trial::deliveries::{Totals, in_memory, run};
use clap::Parser;

/// Deliveries of random tables with seeded faults.
#[derive(Parser)]
struct Args {
    /// What kind of machine.
    #[arg(long, default_value = "reference-rtu")]
    profile: String,
    /// How many.
    #[arg(long, default_value_t = 1000)]
    count: u64,
    /// The first seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Of a thousand answers so many are damaged.
    #[arg(long, default_value_t = 100)]
    per_mille: u32,
}

fn main() -> anyhow::Result<ExitCode> {
    let args = Args::parse();
    let profile = Profile::load(&args.profile)?;
    profile.transport.line().context("only lines can be simulated in memory so far")?;
    let (mut totals, started) = (Totals::default(), Instant::now());
    for seed in args.seed..args.seed + args.count {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build()?;
        let case =
            runtime.block_on(async { run(seed, args.per_mille, &profile, in_memory(&profile)?).await })?;
        totals.add(seed, case);
    }
    println!(
        "{} deliveries over {}, seeds from {}, {} of 1000 answers damaged, {:.1} s",
        args.count,
        args.profile,
        args.seed,
        args.per_mille,
        started.elapsed().as_secs_f64()
    );
    println!("{totals}");
    for (seed, what) in &totals.wrong {
        println!("seed {seed}: {what}");
    }
    Ok(if totals.wrong.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
