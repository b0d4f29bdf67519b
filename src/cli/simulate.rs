//! `benderd simulate`: the simulators on their own.

use super::{Outcome, simulate_bender};

/// What is simulated.
#[derive(Debug, clap::Subcommand)]
pub enum Simulate {
    /// A bender with a real Modbus TCP server.
    Bender(simulate_bender::Args),
}

/// Runs the subcommand.
pub fn run(what: &Simulate) -> anyhow::Result<Outcome> {
    match what {
        Simulate::Bender(args) => simulate_bender::run(args),
    }
}
