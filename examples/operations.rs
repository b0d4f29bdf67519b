//! What `benches/operations.sh` counts the instructions of: scans of tubes with few and many bends beside their nominals, and
//! the reconstruction up to a stage. `operations scans FOLDER` writes them; `operations until structure|fit SCAN
//! [--nominal PART]` ends where that stage begins.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::exit;

use anyhow::Context;
use clap::{Parser, ValueEnum};

use benderd::cell::measure_scan;
use benderd::cloud::{PlyForm, Unit, write_ply_as};
use benderd::config::{Materials, load_part};
use benderd::reconstruct::Stage;
use benderd::sim::population::{Specimen, random_tube};
use benderd::sim::scan::{Density, ScanSettings, scan};
use benderd::trial::accuracy::drawn;
use benderd::tube::Nominal;

/// Bends of the tubes, points of their scans, and the seed from which on the tubes are looked for.
const BENDS: [usize; 4] = [3, 5, 9, 14];
const POINTS: [usize; 3] = [6_000, 100_000, 1_000_000];
const FIRST_SEED: u64 = 70_000;

#[derive(Debug, Parser)]
enum Args {
    /// Writes BENDS.toml and BENDS-POINTS.ply for each tube.
    Scans { folder: PathBuf },
    /// Reconstructs up to a stage, which is not begun.
    Until {
        stage: Until,
        scan: PathBuf,
        #[arg(long)]
        nominal: Option<PathBuf>,
    },
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Until {
    Structure,
    Fit,
}

fn main() -> anyhow::Result<()> {
    match Args::parse() {
        Args::Scans { folder } => BENDS.into_iter().try_for_each(|bends| write(&folder, bends)),
        Args::Until { stage, scan, nominal } => until(stage, &scan, nominal.as_deref()),
    }
}

/// The first tube with so many bends, its scans and its nominal.
fn write(folder: &Path, bends: usize) -> anyhow::Result<()> {
    let has_bends = |(_, tube): &(u64, Specimen)| tube.shape.lra.bends.len() == bends;
    let mut tubes = (FIRST_SEED..).map(|seed| (seed, random_tube(seed)));
    let (seed, tube) = tubes.find(has_bends).context("no tube")?;
    std::fs::create_dir_all(folder)?;
    std::fs::write(folder.join(format!("{bends}.toml")), part_file(&drawn(&tube.shape, seed).nominal)?)?;
    for points in POINTS {
        let settings = ScanSettings { density: Density::Points(points), ..tube.settings.clone() };
        let cloud = scan(&tube.shape, &settings, seed).cloud();
        write_ply_as(&folder.join(format!("{bends}-{points}.ply")), &cloud, PlyForm::FloatLittle)?;
    }
    Ok(())
}

fn part_file(part: &Nominal) -> Result<String, std::fmt::Error> {
    let mut out = format!(
        "name = \"part\"\n[tube]\nod_mm = {:?}\nwall_mm = {:?}\nmaterial = \"304\"\n[die]\nclr_mm = {:?}\n",
        part.od_mm,
        part.od_mm / 10.0,
        part.die_clr_mm
    );
    for b in &part.lra.bends {
        let [rotation, angle] = [b.rotation_rad, b.angle_rad].map(f64::to_degrees);
        write!(out, "[[bend]]\nlength_mm = {:?}\nrotation_deg = {rotation:?}\n", b.length_mm)?;
        write!(out, "angle_deg = {angle:?}\nradius_mm = {:?}\n", b.radius_mm)?;
    }
    write!(out, "[end]\nlength_mm = {:?}\n", part.lra.last_length_mm)?;
    Ok(out + "[tolerance]\nenvelope_mm = 1.0\nangle_deg = 0.3\nrotation_deg = 0.5\nlength_mm = 0.5\n")
}

#[allow(clippy::disallowed_methods)] // the count ends here, and what is left to be dropped is not to be counted
fn until(stage: Until, scan: &Path, nominal: Option<&Path>) -> anyhow::Result<()> {
    let materials = Materials::shipped()?;
    let nominal = nominal.map(|path| load_part(path, &materials)).transpose()?;
    let end = match stage {
        Until::Structure => Stage::Structure,
        Until::Fit => Stage::Fit,
    };
    let mut leave = |begun: Stage| {
        if begun == end {
            exit(0);
        }
    };
    measure_scan(scan, Unit::Millimetre, nominal.as_ref(), &mut leave).map_err(anyhow::Error::msg)?;
    anyhow::bail!("the stage was not reached")
}
