//! Thirty simulated tubes like the benchmark of paper 000 (radii 2 to 50 mm, one view each): reconstructs every scan
//! and prints what was found beside the truth. `cargo run --release --example thirty [FIRST_SEED [COUNT]]`; fails below
//! 28 of 30 right.

#![allow(clippy::print_stdout)] // an example prints

use std::process::ExitCode;
use std::time::Instant;

use benderd::reconstruct::{Options, reconstruct};
use benderd::sim::population::{Specimen, random_tube};
use benderd::sim::scan::{Density, ScanSettings, TubeShape, scan};
use benderd::tube::{Bend, Lra, MeasuredTube, wrap_angle};

/// Right numbers of bends that must be reached, as paper 000 did: 28 of 30.
const LEAST_SHARE: f64 = 28.0 / 30.0;

fn main() -> ExitCode {
    let argument =
        |k: usize, default: u64| std::env::args().nth(k).and_then(|a| a.parse().ok()).unwrap_or(default);
    let (first, count) = (argument(1, 0), argument(2, 30));
    println!(
        " seed radius_mm bends found   points  used  median_mm angle_deg rot_deg corner_mm clr_mm radius_mm  ms"
    );
    let run = |seed: &u64| case(&seed.to_string(), &random_tube(*seed), *seed);
    let right = (first..first + count).filter(run).count();
    println!("right number of bends: {right} of {count}");
    println!(
        "the tube of paper 000's Results (radius 4 mm, 268 mm, 5 bends, 6005 points; there 50 s on a 2 GHz PC):"
    );
    let paper = case("paper", &papers_tube(), 0);
    let enough = right as f64 >= LEAST_SHARE * count as f64;
    if paper && enough { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// The tube of paper 000, section 8, as far as it is described there.
fn papers_tube() -> Specimen {
    let bend = |length_mm, rotation_deg: f64, angle_deg: f64| Bend {
        length_mm,
        rotation_rad: rotation_deg.to_radians(),
        angle_rad: angle_deg.to_radians(),
        radius_mm: 15.0,
    };
    let bends = vec![
        bend(30.0, 0.0, 60.0),
        bend(25.0, 90.0, 45.0),
        bend(30.0, -60.0, 4.0),
        bend(25.0, 120.0, 90.0),
        bend(20.0, 180.0, 70.0),
    ];
    let mut lra = Lra { bends, last_length_mm: 0.0 };
    lra.last_length_mm = 268.0 - lra.developed_length_mm();
    let settings = ScanSettings { density: Density::Points(6005), ..ScanSettings::default() };
    Specimen { shape: TubeShape::round(lra, 8.0), settings, common_clr: true }
}

/// Scans and reconstructs one tube and prints its row: largest errors over the tube. True when the number of bends is
/// right.
fn case(name: &str, tube: &Specimen, seed: u64) -> bool {
    let scanned = scan(&tube.shape, &tube.settings, seed);
    let (truth, radius) = (&tube.shape.lra, tube.shape.od_mm / 2.0);
    let bends = truth.bends.len();
    let started = Instant::now();
    let found = reconstruct(&scanned.cloud(), &Options::default());
    let ms = started.elapsed().as_secs_f64() * 1e3;
    let measured = match found {
        Ok(found) => found.measured,
        Err(error) => {
            println!("{name:>5} {radius:9.2} {bends:5}     -  {error}");
            return false;
        }
    };
    let right = measured.bends.len() == bends;
    print!("{name:>5} {radius:9.2} {bends:5} {:5} {:8}", measured.bends.len(), measured.points_total);
    let used = 100.0 * measured.points_used as f64 / measured.points_total as f64;
    print!(" {used:5.1} {:10.4}", measured.residual_median_mm);
    match errors(&measured, truth) {
        Some([angle, rotation, corner, clr]) => print!(" {angle:9.4} {rotation:7.4} {corner:9.3} {clr:6.3}"),
        None => print!("   wrong number of bends          "),
    }
    println!(" {:9.4} {ms:5.0}{}", measured.tube_radius_mm - radius, if right { "" } else { "  <--" });
    right
}

/// Largest errors of angle and rotation (degrees), intersection distance and CLR (mm), in the better direction; None
/// with another number of bends.
fn errors(measured: &MeasuredTube, truth: &Lra) -> Option<[f64; 4]> {
    let one = |m: &MeasuredTube| {
        let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
        let pairs = || m.bends.iter().zip(&truth.bends);
        let angle = largest(&mut pairs().map(|(a, b)| (a.angle_rad - b.angle_rad).abs().to_degrees()));
        let rotation = |(a, b): (&benderd::tube::MeasuredBend, &Bend)| {
            a.rotation_rad.map(|r| wrap_angle(r - b.rotation_rad).abs().to_degrees())
        };
        let corners = truth.intersection_distances_mm(MeasuredTube::INTERSECTION_LIMIT_RAD);
        let corner = m.intersection_mm.iter().zip(&corners).filter_map(|(a, b)| Some(((*a)? - (*b)?).abs()));
        let clr = pairs().filter_map(|(a, b)| Some((a.radius_mm? - b.radius_mm).abs()));
        [
            angle,
            largest(&mut pairs().skip(1).filter_map(rotation)),
            largest(&mut { corner }),
            largest(&mut { clr }),
        ]
    };
    let same = measured.bends.len() == truth.bends.len();
    let (forward, backward) = (one(measured), one(&measured.reversed()));
    same.then_some(if forward[0] + forward[1] <= backward[0] + backward[1] { forward } else { backward })
}
