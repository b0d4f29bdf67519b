//! `benderd check`: validates everything that `run` would load; connects to nothing.

use std::path::{Path, PathBuf};

use super::{Outcome, say};
use crate::cell::Setup;
use crate::config::{DaemonConfig, Materials, load_daemon};

/// Arguments of `benderd check`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The daemon's configuration.
    config: PathBuf,
}

/// A configuration with its cells.
pub struct Loaded {
    /// benderd.toml.
    pub config: DaemonConfig,
    /// Its cells, in its order.
    pub setups: Vec<Setup>,
}

/// Loads benderd.toml and all that it names.
pub fn load(path: &Path) -> anyhow::Result<Loaded> {
    let config = load_daemon(path)?;
    let materials = match &config.materials {
        Some(path) => Materials::load(path)?,
        None => Materials::shipped()?,
    };
    let setups = config.cells.iter().map(|c| Setup::load(c, &materials)).collect::<Result<Vec<_>, _>>()?;
    for setup in &setups {
        for warning in &setup.warnings {
            tracing::warn!(cell = setup.identity.name, "{warning}");
        }
    }
    Ok(Loaded { config, setups })
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let loaded = load(&args.config)?;
    for setup in &loaded.setups {
        let id = &setup.identity;
        let mode = match id.mode {
            crate::config::Mode::Observe => "observe",
            crate::config::Mode::Automatic => "automatic",
        };
        let bends = setup.chain.nominal().lra.bends.len();
        say(&format!("cell {}: {mode}, part {} with {bends} bends", id.name, id.program));
        say(&format!("  machine {} at {}", setup.profile.name, setup.address));
        say(&format!("  scans   {}", setup.folder.folder.display()));
        setup.warnings.iter().for_each(|w| say(&format!("  warning: {w}")));
    }
    say(&format!("{}: good", args.config.display()));
    Ok(Outcome::Done)
}
