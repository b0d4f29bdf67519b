//! `benderd check`: validates everything that `run` would load, or prints what a profile asks of its machine; connects to nothing,
//! makes nothing.

use std::path::{Path, PathBuf};

use anyhow::Context as _;

use super::{Outcome, plan_text, say};
use crate::bender::Profile;
use crate::cell::Setup;
use crate::config::{DaemonConfig, load_daemon};

/// Arguments of `benderd check`.
#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
pub struct Args {
    /// The daemon's configuration.
    config: Option<PathBuf>,
    /// Prints the requests that a profile (a shipped one's name, or a file) asks of its machine.
    #[arg(long, value_name = "PROFILE")]
    plan: Option<String>,
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
    let setups = Setup::load_all(&config).with_context(|| path.display().to_string())?;
    for setup in &setups {
        for warning in &setup.warnings {
            tracing::warn!(cell = setup.identity.name, "{warning}");
        }
    }
    Ok(Loaded { config, setups })
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    if let Some(profile) = &args.plan {
        say(&plan_text::of(&Profile::load(profile)?));
        return Ok(Outcome::Done);
    }
    let Some(config) = &args.config else { anyhow::bail!("CONFIG or --plan PROFILE is missing") };
    let loaded = load(config)?;
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
    say(&format!("{}: good", config.display()));
    Ok(Outcome::Done)
}
