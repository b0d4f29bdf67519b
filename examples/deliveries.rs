//! Deliveries over a link that fails: `cargo run --release --example deliveries -- --count 10000` in memory and simulated time, with
//! `--real` over a pseudo terminal or a socket, in as much time as it takes. Prints how they ended; exit status 1 when something
//! that must hold did not.

#![allow(clippy::print_stdout)] // a program of its own

use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use benderd::bender::{Profile, Transport};
use benderd::trial::deliveries::{Totals, in_memory, real, run};
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
    /// Over the transport's own pseudo terminal, socket or folder, with short deadlines.
    #[arg(long)]
    real: bool,
    /// The CAN interface [default: the profile's].
    #[arg(long)]
    on: Option<String>,
    /// Of a thousand answers so many are damaged.
    #[arg(long, default_value_t = 100)]
    per_mille: u32,
}

fn main() -> anyhow::Result<ExitCode> {
    let args = Args::parse();
    let mut profile = Profile::load(&args.profile)?;
    if let Some(on) = &args.on {
        profile.endpoint.clone_from(on);
    }
    if args.real {
        hurry(&mut profile);
    }
    // In memory, where there is such a place.
    let memory = Path::new("/dev/shm");
    let folder =
        if memory.is_dir() && !args.real { tempfile::tempdir_in(memory)? } else { tempfile::tempdir()? };
    let (mut totals, started) = (Totals::default(), Instant::now());
    for seed in args.seed..args.seed + args.count {
        let mut builder = tokio::runtime::Builder::new_current_thread();
        let case = if args.real {
            builder.enable_all().build()?.block_on(async {
                let (ends, _kept) = real(&profile, folder.path()).await?;
                run(seed, args.per_mille, &profile, ends).await
            })
        } else {
            let runtime = builder.enable_time().start_paused(true).build()?;
            runtime.block_on(async {
                run(seed, args.per_mille, &profile, in_memory(&profile, folder.path())?).await
            })
        };
        totals.add(seed, case?);
    }
    println!(
        "{} deliveries over {}{}, seeds from {}, {} of 1000 answers damaged, {:.1} s",
        args.count,
        args.profile,
        if args.real { "" } else { " in memory" },
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

/// Deadlines of a machine that answers at once, or hundreds of lost answers would take an hour.
fn hurry(profile: &mut Profile) {
    let on_bus = matches!(profile.transport, Transport::Can(_) | Transport::Canopen(_));
    // A status comes by itself ten times a second there.
    profile.deadlines.request = Duration::from_millis(if on_bus { 300 } else { 60 });
    profile.deadlines.poll_ms = 5;
    profile.deadlines.settle_ms = 70;
    profile.deadlines.confirm_ms = 1500;
    match &mut profile.transport {
        Transport::ModbusRtu(_, line, _)
        | Transport::ModbusRtuOverTcp(_, line)
        | Transport::SerialTable(_, line, _) => line.quiet = Duration::from_millis(60),
        _ => {}
    }
}
