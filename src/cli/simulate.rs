//! `benderd simulate`: the simulators on their own.

use std::path::PathBuf;

use anyhow::bail;
use clap::Subcommand;

use super::{Outcome, say, simulate_bender, simulate_production};
use crate::cloud::write_scan;
use crate::config::{Materials, load_part};
use crate::sim::scan::{Density, Jaws, PointKind, ScanSettings, TubeShape, scan};

/// Arguments of `benderd simulate`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    simulator: Simulator,
}

#[derive(Debug, Subcommand)]
enum Simulator {
    /// Scans a part as if it had been bent perfectly, with a simulated laser line.
    Scan(ScanArgs),
    /// A bender on the link that its profile names (Modbus, a serial line, a folder, CAN), until Ctrl-C.
    Bender(simulate_bender::Args),
    /// Many jobs of a part, bent, scanned and corrected on simulated benders: how soon tubes are good, what is scrapped.
    Production(simulate_production::Args),
}

#[derive(Debug, clap::Args)]
struct ScanArgs {
    /// The part file.
    #[arg(long)]
    part: PathBuf,
    /// Same seed, same scan.
    #[arg(long)]
    seed: u64,
    /// The scan file to write: .ply, .e57, .stl, or text as .xyz, .asc, .txt, .pts or .csv.
    #[arg(long)]
    out: PathBuf,
    /// About this many points on the tube.
    #[arg(long, default_value_t = 50_000, value_parser = clap::value_parser!(u32).range(100..=20_000_000))]
    points: u32,
    /// Passes from different sides.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=20))]
    views: u8,
    /// Noise along the ray at normal incidence (one sigma).
    #[arg(long, default_value_t = 0.03, value_parser = at_most(10.0))]
    noise_mm: f64,
    /// Share of flying points, 0 to 1.
    #[arg(long, default_value_t = 0.005, value_parser = at_most(1.0))]
    outliers: f64,
    /// Patches of the surface without data.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=1000))]
    patches: u16,
    /// Puts a table under the tube.
    #[arg(long)]
    table: bool,
    /// Rests the tube on V-blocks.
    #[arg(long)]
    v_blocks: bool,
    /// Holds the tube by clamp jaws: grip (a V from either side) or flat (a face from one side).
    #[arg(long)]
    jaws: Option<Jaws>,
    /// How far passes disagree (one sigma of each pass's displacement).
    #[arg(long, default_value_t = 0.0, value_parser = at_most(10.0))]
    drift_mm: f64,
    /// Ovality of every bend: (largest - smallest) / nominal diameter.
    #[arg(long, default_value_t = 0.0, value_parser = at_most(1.0))]
    ovality: f64,
    /// Flattening of every bend's outer wall: how far it lies within the oval section / nominal diameter.
    #[arg(long, default_value_t = 0.0, value_parser = at_most(0.1))]
    flattening: f64,
}

fn at_most(most: f64) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync {
    move |word| {
        let value: f64 = word.parse().map_err(|_| "not a number".to_owned())?;
        if (0.0..=most).contains(&value) { Ok(value) } else { Err(format!("allowed is 0 to {most}")) }
    }
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    match &args.simulator {
        Simulator::Scan(args) => simulate_scan(args),
        Simulator::Bender(args) => simulate_bender::run(args),
        Simulator::Production(args) => simulate_production::run(args),
    }
}

fn simulate_scan(args: &ScanArgs) -> anyhow::Result<Outcome> {
    let part = load_part(&args.part, &Materials::shipped()?)?;
    let [ovality, flattening] =
        [args.ovality, args.flattening].map(|share| vec![share; part.lra.bends.len()]);
    let shape = TubeShape { ovality, flattening, ..TubeShape::round(part.lra, part.od_mm) };
    let settings = ScanSettings {
        density: Density::Points(args.points as usize),
        views: args.views.into(),
        noise_mm: args.noise_mm,
        outlier_share: args.outliers,
        missing_patches: args.patches.into(),
        table: args.table,
        v_blocks: args.v_blocks,
        jaws: args.jaws,
        pass_drift_mm: args.drift_mm,
        ..ScanSettings::default()
    };
    let got = scan(&shape, &settings, args.seed);
    if got.points.is_empty() {
        bail!("{}: a tube without length cannot be scanned", args.part.display());
    }
    write_scan(&args.out, &got.cloud())?;
    say(&format!(
        "{}: {} points of {} ({} tube, {} surroundings, {} outliers), true tube radius {} mm",
        args.out.display(),
        got.points.len(),
        part.name,
        got.count(PointKind::Tube),
        got.count(PointKind::Surroundings),
        got.count(PointKind::Outlier),
        shape.od_mm / 2.0
    ));
    Ok(Outcome::Done)
}
