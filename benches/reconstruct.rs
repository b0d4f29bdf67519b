//! How long a scan takes from file to measured tube, stage by stage and as a whole: `cargo bench`.
//!
//! The scans are simulated once into `target/bench/` (bracket-17, seed 1, binary PLY in single precision).
//! `bash benches/report.sh` writes docs/benchmarks.md from what this leaves behind.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use criterion::{BenchmarkId, Criterion, SamplingMode};

use benderd::cell::measure;
use benderd::cloud::{PlyForm, PointCloud, Unit, read_scan, write_ply_as};
use benderd::config::{Materials, load_part};
use benderd::reconstruct::finish::finish;
use benderd::reconstruct::structure::{self, Shown};
use benderd::reconstruct::{Options, reconstruct, sample, scene};
use benderd::sim::scan::{Density, ScanSettings, TubeShape, scan};

/// Points of the scans: the paper's, and more.
const SIZES: [usize; 4] = [6_005, 100_000, 1_000_000, 5_000_000];

/// The scan of this many points.
fn scan_file(points: usize) -> anyhow::Result<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = root.join("target/bench");
    let path = folder.join(format!("{points}.ply"));
    if !path.exists() {
        std::fs::create_dir_all(&folder)?;
        let part = load_part(&root.join("config/parts/bracket-17.toml"), &Materials::shipped()?)?;
        let shape = TubeShape::round(part.lra, part.od_mm);
        let settings = ScanSettings { density: Density::Points(points), ..ScanSettings::default() };
        write_ply_as(&path, &scan(&shape, &settings, 1).cloud(), PlyForm::FloatLittle)?;
    }
    Ok(path)
}

fn stages(criterion: &mut Criterion, points: usize) -> anyhow::Result<()> {
    let path = scan_file(points)?;
    let cloud: PointCloud = read_scan(&path, Unit::Millimetre)?.cloud;
    let seen = scene::look(&cloud, None)?;
    let thin = sample(&seen);
    let shown = Shown::new(&cloud, &seen, &thin);
    let choose = || structure::choose(&shown);
    let chosen = choose().context("no structure")?;
    let mut group = criterion.benchmark_group("reconstruct");
    group.sample_size(10).sampling_mode(SamplingMode::Flat);
    group.warm_up_time(Duration::from_millis(500)).measurement_time(Duration::from_secs(3));
    let id = |stage: &str| BenchmarkId::new(stage, points);
    group.bench_function(id("read"), |b| b.iter(|| read_scan(&path, Unit::Millimetre)));
    group.bench_function(id("scene"), |b| b.iter(|| scene::look(&cloud, None)));
    group.bench_function(id("structure"), |b| b.iter(choose));
    group.bench_function(id("finish"), |b| b.iter(|| finish(&shown, &seen.warnings, &chosen)));
    group.bench_function(id("reconstruct"), |b| b.iter(|| reconstruct(&cloud, &Options::default())));
    group.bench_function(id("file to table"), |b| b.iter(|| measure(&path, Unit::Millimetre, None)));
    group.finish();
    Ok(())
}

fn main() -> anyhow::Result<()> {
    let mut criterion = Criterion::default().configure_from_args();
    SIZES.into_iter().try_for_each(|points| stages(&mut criterion, points))?;
    criterion.final_summary();
    Ok(())
}
