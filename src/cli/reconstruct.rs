//! `benderd reconstruct`: one scan to LRA.

use std::path::PathBuf;

use super::Outcome;

/// Arguments of `benderd reconstruct`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The scan file.
    scan: PathBuf,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    anyhow::bail!("{}: reconstruction is being built", args.scan.display())
}
