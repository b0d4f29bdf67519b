//! `benderd reconstruct`: one scan to LRA, and to pictures of how well it fits.

use std::path::PathBuf;

use super::export::{self, Export};
use super::progress::Progress;
use super::{Outcome, ScanUnit, say};
use crate::cell::measure_scan;
use crate::config::{Materials, load_part};
use crate::reconstruct::Stage;
use crate::tube::MeasuredTube;

/// Arguments of `benderd reconstruct`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The scan: PLY, E57, STL, XYZ, ASC, PTS or CSV.
    scan: PathBuf,
    /// The part that the scan should show; its direction of travel is used.
    #[arg(long, value_name = "PART")]
    nominal: Option<PathBuf>,
    /// Unit of the file's coordinates.
    #[arg(long, value_enum, default_value_t)]
    unit: ScanUnit,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
    /// Also writes a file: .csv the spine, .ply the points coloured by deviation, .html the report; repeatable.
    #[arg(long, value_name = "FILE")]
    export: Vec<Export>,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let nominal = match &args.nominal {
        Some(path) => Some(load_part(path, &Materials::shipped()?)?),
        None => None,
    };
    export::check(&args.export, &args.scan)?;
    let progress = Progress::new(!args.json);
    progress.stage("reading the scan");
    let scan = measure_scan(&args.scan, args.unit.into(), nominal.as_ref(), &mut |s| progress.stage(name(s)));
    let scan = scan.map_err(anyhow::Error::msg)?;
    drop(progress);
    // The measurement first: it is worth having whatever becomes of the exports.
    let measured = &scan.found.measured;
    say(&if args.json { serde_json::to_string(measured)? } else { table(measured) });
    let progress = Progress::new(!args.json);
    progress.stage("writing the exports");
    let file = args.scan.display().to_string();
    let part = nominal.as_ref().map(|n| n.name.as_str());
    args.export.iter().try_for_each(|e| e.write(&file, part, &scan))?;
    Ok(Outcome::Done)
}

/// A stage for people.
fn name(stage: Stage) -> &'static str {
    match stage {
        Stage::CentreLine => "finding the centre line",
        Stage::Structure => "telling straights from bends",
        Stage::Fit => "fitting all points",
    }
}

/// The measured tube for people.
pub fn table(tube: &MeasuredTube) -> String {
    let sigma = tube.tube_radius_sigma_mm.map_or(String::new(), |s| format!(" ±{s:.3}"));
    let mut out = format!(
        "tube radius {:.3}{sigma} mm, {} of {} points used, median residual {:.3} mm, {:.0} ms\n",
        tube.tube_radius_mm, tube.points_used, tube.points_total, tube.residual_median_mm, tube.elapsed_ms
    );
    if tube.reversed == Some(true) {
        out += "the scan starts at the part's other end; turned round\n";
    }
    // These columns only where some bend has them.
    let oval = tube.bends.iter().any(|b| b.ovality.is_some());
    let flattened = tube.bends.iter().any(|b| b.flattening.is_some());
    out += "bend        length mm      rotation deg         angle deg            CLR mm";
    out += if oval { "        ovality %" } else { "" };
    out += if flattened { "      flattening %\n" } else { "\n" };
    for (i, b) in tube.bends.iter().enumerate() {
        let degrees = |rad: Option<f64>| rad.map(f64::to_degrees);
        let percent = |share: Option<f64>| share.map(|s| 100.0 * s);
        out += &format!(
            "{:>4} {} {} {} {}",
            i + 1,
            cell(b.length_mm, b.length_sigma_mm),
            cell(degrees(b.rotation_rad), degrees(b.rotation_sigma_rad)),
            cell(degrees(Some(b.angle_rad)), degrees(Some(b.angle_sigma_rad))),
            cell(b.radius_mm, b.radius_sigma_mm),
        );
        if oval {
            out += &format!(" {}", cell(percent(b.ovality), percent(b.ovality_sigma)));
        }
        if flattened {
            out += &format!(" {}", cell(percent(b.flattening), percent(b.flattening_sigma)));
        }
        out += "\n";
    }
    out += &format!(" end {}\n", cell(tube.last_length_mm, tube.last_length_sigma_mm));
    out += &ends(tube);
    for d in &tube.decisions {
        let bend = d.bend.map_or(String::new(), |b| format!("bend {b}: "));
        let verdict = if d.kept { "kept" } else { "not kept" };
        out += &format!("decision: {bend}{}, gain {:.1}, {verdict}\n", d.what, d.gain);
    }
    tube.warnings.iter().for_each(|w| out += &format!("warning: {w}\n"));
    out
}

/// How the ends are cut, where that was seen.
fn ends(tube: &MeasuredTube) -> String {
    let cuts = [
        ("first", tube.first_cut_rad, tube.first_cut_sigma_rad),
        ("last", tube.last_cut_rad, tube.last_cut_sigma_rad),
    ];
    let line = |(which, cut, sigma): (&str, Option<f64>, Option<f64>)| {
        let (cut, sigma) = (cut?.to_degrees(), sigma?.to_degrees());
        Some(format!("{which} end cut {cut:.2} ±{sigma:.2} degrees from square\n"))
    };
    cuts.into_iter().filter_map(line).collect()
}

fn cell(value: Option<f64>, sigma: Option<f64>) -> String {
    match value {
        Some(value) => format!("{value:>9.3} ±{:.3}", sigma.unwrap_or(0.0)).chars().take(16).collect(),
        None => format!("{:>16}", "not known"),
    }
}
