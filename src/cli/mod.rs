//! The command line: one file per subcommand, no logic of its own.
//!
//! Exit status: 0 done, 1 the tube or the machine said no, 2 the input or the arguments are unusable. Errors go
//! to stderr, results to stdout; `--json` prints exactly one JSON object.

mod check;
mod convert;
mod correct;
mod demo;
mod export;
mod inspect;
mod knowledge;
mod knowledge_text;
mod plan_objects;
mod plan_text;
mod progress;
mod push;
mod push_text;
mod reconstruct;
mod run;
mod selftest;
mod simulate;
mod simulate_bender;
mod simulate_production;

use std::future::Future;
use std::io::{ErrorKind, Write};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::{Parser, Subcommand};
use tokio::runtime::Runtime;

use crate::bender::Profile;
use crate::cloud::Unit;

/// Closes the loop on CNC tube bending.
#[derive(Debug, Parser)]
#[command(name = "benderd", version, about, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Shows the loop at work against simulated hardware, until a part is in tolerance.
    Demo(demo::Args),
    /// Runs the daemon: every cell of the configuration, until told to stop.
    Run(run::Args),
    /// Validates a configuration and everything that it names; connects to nothing.
    Check(check::Args),
    /// Reconstructs the tube in one scan: LRA with uncertainties.
    Reconstruct(reconstruct::Args),
    /// Runs a simulator on its own.
    Simulate(simulate::Args),
    /// Compares a measured tube with its part: deviations and verdict.
    Inspect(inspect::Args),
    /// One step of the correction loop: from what was measured to the next table.
    Correct(correct::Args),
    /// What was learned of spring-back: lists, shows, draws, takes in, gives out.
    Knowledge(knowledge::Args),
    /// Converts bending tables between LRA, XYZ and YBC.
    Convert(convert::Args),
    /// Delivers one table to a bender by hand: stage, verify, commit.
    Push(push::Args),
    /// Tries a profile at a real machine, step by step, and says what to change.
    Selftest(selftest::Args),
}

/// Units in which scan files come.
#[derive(Debug, Clone, Copy, Default, clap::ValueEnum)]
pub enum ScanUnit {
    /// Millimetres.
    #[default]
    Mm,
    /// Metres.
    M,
    /// Inches.
    Inch,
}

impl From<ScanUnit> for Unit {
    fn from(unit: ScanUnit) -> Unit {
        match unit {
            ScanUnit::Mm => Unit::Millimetre,
            ScanUnit::M => Unit::Metre,
            ScanUnit::Inch => Unit::Inch,
        }
    }
}

/// How a subcommand ended; errors (unusable input, exit 2) travel as `anyhow::Error`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Exit 0.
    Done,
    /// Exit 1: the tube or the machine said no.
    No,
    /// Exit 3: a delivery's outcome stayed unknown.
    Unknown,
}

/// Set when stdout took less than it was given.
static OUTPUT_LOST: AtomicBool = AtomicBool::new(false);

/// Prints to stdout, a line at least, at once. Nobody reading it (`benderd ... | head`) is no reason to stop, and
/// `println!` would panic; anything else (a full disk) ends the program with status 2.
fn say(text: &str) {
    let mut out = std::io::stdout().lock();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    if let Err(error) = write!(out, "{text}{end}").and_then(|()| out.flush())
        && error.kind() != ErrorKind::BrokenPipe
        && !OUTPUT_LOST.swap(true, Ordering::Relaxed)
    {
        eprintln!("error: the output cannot be written: {error}");
    }
}

/// How long file work that nobody waits for any more may go on before the program ends.
const LEFT_OVER: Duration = Duration::from_secs(1);

/// Runs this to its end; a thread that hangs at a share does not keep the program from ending.
fn run_on<T>(runtime: Runtime, work: impl Future<Output = T>) -> T {
    let result = runtime.block_on(work);
    runtime.shutdown_timeout(LEFT_OVER);
    result
}

/// Where the machine is: as given, where a path begins at this folder, or as its profile says.
fn endpoint_of(profile: &Profile, on: Option<&str>) -> anyhow::Result<String> {
    let Some(on) = on else { return Ok(profile.endpoint.clone()) };
    let endpoint = match std::path::absolute(on) {
        Ok(path) if profile.transport.is_path() => path.display().to_string(),
        _ => on.to_owned(),
    };
    if !profile.transport.takes(&endpoint) {
        anyhow::bail!("--on {on}: allowed is {}", profile.transport.form());
    }
    Ok(endpoint)
}

/// Whether an error only says that nobody reads the output any more.
fn reader_gone(error: &anyhow::Error) -> bool {
    let broken = |e: &std::io::Error| e.kind() == ErrorKind::BrokenPipe;
    error.chain().any(|cause| cause.downcast_ref::<std::io::Error>().is_some_and(broken))
}

/// Runs the program's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let result: anyhow::Result<Outcome> = match cli.command {
        Command::Demo(args) => demo::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Reconstruct(args) => reconstruct::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Correct(args) => correct::run(&args),
        Command::Knowledge(args) => knowledge::run(&args),
        Command::Convert(args) => convert::run(&args),
        Command::Push(args) => push::run(&args),
        Command::Selftest(args) => selftest::run(&args),
    };
    match result {
        Ok(_) if OUTPUT_LOST.load(Ordering::Relaxed) => ExitCode::from(2),
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::No) => ExitCode::from(1),
        Ok(Outcome::Unknown) => ExitCode::from(3),
        Err(error) if reader_gone(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(2)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A read at a share that hung kept `push`, `selftest` and the daemon for ever, after all was said.
    #[test]
    fn a_thread_that_hangs_does_not_keep_the_program_from_ending() {
        let (release, held) = std::sync::mpsc::channel::<()>();
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let work = async move {
            tokio::task::spawn_blocking(move || held.recv());
            7
        };
        assert_eq!(run_on(runtime, work), 7);
        drop(release);
    }
}
