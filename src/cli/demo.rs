//! `benderd demo`: the daemon's loop against simulated hardware. Needs no hardware and no configuration.

use std::path::PathBuf;

use anyhow::Context as _;

use super::{Outcome, say};
use crate::bender::Profile;
use crate::config::{Document, Materials, load_part, parse_part};
use crate::trial::{Demo, TrialError, draw, run as run_demo};

/// The part that is made when none is named.
const PART: &str = include_str!("../../config/parts/bracket-17.toml");

/// Arguments of `benderd demo`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Decides everything that is random; the same seed tells the same story.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// A part file to make instead of the built-in bracket.
    #[arg(long, value_name = "FILE")]
    part: Option<PathBuf>,
    /// Another material than the part's: steel, e355, 304, 316l, 6061-t6, ti-3al-2.5v.
    #[arg(long, value_name = "KEY")]
    material: Option<String>,
    /// Also draws the story as SVG.
    #[arg(long, value_name = "FILE.svg")]
    picture: Option<PathBuf>,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let materials = Materials::shipped()?;
    let mut nominal = match &args.part {
        Some(path) => load_part(path, &materials)?,
        None => parse_part(&Document::new("config/parts/bracket-17.toml (built in)", PART), &materials)?,
    };
    if let Some(key) = &args.material {
        let known = || materials.keys().collect::<Vec<_>>().join(", ");
        let found = materials.get(key).cloned();
        nominal.material = found.with_context(|| format!("--material {key}: known are {}", known()))?;
    }
    let demo = Demo { nominal, profile: Profile::load("reference-modbus")?, seed: args.seed };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let result = match runtime.block_on(run_demo(&demo, &mut say)) {
        Ok(result) => result,
        Err(error @ TrialError::Held(_)) => {
            eprintln!("error: {error}");
            return Ok(Outcome::No);
        }
        Err(error) => return Err(error.into()),
    };
    if let Some(path) = &args.picture {
        let n = &demo.nominal;
        let bends = n.lra.bends.len();
        let title = format!("{}: in tolerance on part {}", n.name, result.parts.len());
        let subtitle = format!(
            "{bends} bends in {}, {} x {} mm, CLR {} mm; drawn by benderd demo --seed {}",
            n.material.key, n.od_mm, n.wall_mm, n.die_clr_mm, args.seed
        );
        let title = if result.in_tolerance { title } else { format!("{}: not in tolerance", n.name) };
        let svg = draw(&title, &subtitle, n, &result.parts);
        std::fs::write(path, svg).with_context(|| format!("{}: cannot be written", path.display()))?;
    }
    Ok(if result.in_tolerance { Outcome::Done } else { Outcome::No })
}
