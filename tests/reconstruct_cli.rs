//! `benderd reconstruct --export`: what it writes is read back as other programs would, and what cannot be written is said.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::path::Path;
use std::process::{Command, Output};

use benderd::cloud::{PointCloud, Unit, read_scan, write_ply};
use benderd::reconstruct::{Options, Reconstruction, reconstruct};
use benderd::report::{About, html};
use benderd::sim::scan::{Density, ScanSettings, TubeShape, scan};
use benderd::tube::{Bend, Decision, Lra};
use tempfile::TempDir;

/// Three bends, scanned all round.
fn cloud() -> PointCloud {
    let bend = |rotation_deg: f64, angle_deg: f64| Bend {
        length_mm: 90.0,
        rotation_rad: rotation_deg.to_radians(),
        angle_rad: angle_deg.to_radians(),
        radius_mm: 40.0,
    };
    let lra =
        Lra { bends: vec![bend(0.0, 90.0), bend(60.0, 45.0), bend(-100.0, 70.0)], last_length_mm: 80.0 };
    let settings = ScanSettings { density: Density::Points(9_000), ..ScanSettings::default() };
    scan(&TubeShape::round(lra, 20.0), &settings, 11).cloud()
}

fn scanned() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_ply(&folder.path().join("scan.ply"), &cloud()).unwrap();
    folder
}

fn run(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_benderd"));
    command.arg("reconstruct").args(args).current_dir(folder).output().unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn read(folder: &Path, name: &str) -> String {
    std::fs::read_to_string(folder.join(name)).unwrap()
}

/// One page whose tags all close in order, and which asks for nothing outside it.
fn check_page(page: &str) {
    assert!(page.starts_with("<!DOCTYPE html>") && page.len() < 3_000_000);
    for outside in ["http", "href", "src=", "url(", "@import", "<script"] {
        assert!(!page.contains(outside), "the page refers to something outside: {outside}");
    }
    assert!(!page.contains("NaN") && !page.contains(">inf"), "a number that is none");
    let mut open: Vec<&str> = Vec::new();
    let body = page.split_once("</style>").unwrap().1;
    for tag in body.split('<').skip(1).map(|t| t.split_once('>').unwrap().0) {
        if let Some(name) = tag.strip_prefix('/') {
            // The style's own head is before the part looked at.
            assert!(
                open.pop() == Some(name) || ["head", "body", "html"].contains(&name),
                "</{name}> closes nothing"
            );
        } else if !tag.ends_with('/') && tag != "body" {
            open.push(tag.split_whitespace().next().unwrap());
        }
    }
    assert!(open.is_empty(), "never closed: {open:?}");
}

#[test]
fn json_stays_one_object_beside_the_exports() {
    let folder = scanned();
    let output = run(
        folder.path(),
        &["scan.ply", "--json", "--export", "spine.csv", "--export", "dev.PLY", "--export", "report.html"],
    );
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    assert!(output.stderr.is_empty(), "no progress in a pipe: {}", said(&output));
    let measured: benderd::tube::MeasuredTube = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(measured.bends.len(), 3);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 4);
    // The same scan without exports says the same.
    let alone = run(folder.path(), &["scan.ply", "--json"]);
    let mut again: benderd::tube::MeasuredTube = serde_json::from_slice(&alone.stdout).unwrap();
    again.elapsed_ms = measured.elapsed_ms;
    assert_eq!(again, measured);
}

#[test]
fn the_spine_has_the_lengths_of_the_table() {
    let folder = scanned();
    let output = run(folder.path(), &["scan.ply", "--json", "--export", "spine.csv"]);
    let measured: benderd::tube::MeasuredTube = serde_json::from_slice(&output.stdout).unwrap();
    let csv = read(folder.path(), "spine.csv");
    let (head, rows) = csv.split_once('\n').unwrap();
    assert_eq!(head, "arc_length_mm,x_mm,y_mm,z_mm,segment,kind,mark");
    let rows: Vec<Vec<&str>> = rows.lines().map(|l| l.split(',').collect()).collect();
    let number = |row: &[&str], k: usize| row[k].parse::<f64>().unwrap();
    let place = |row: &[&str]| nalgebra::Point3::new(number(row, 1), number(row, 2), number(row, 3));
    for pair in rows.windows(2) {
        let (along, straight) =
            (number(&pair[1], 0) - number(&pair[0], 0), (place(&pair[1]) - place(&pair[0])).norm());
        assert!(along > 0.0 && along < 1.001, "a step of {along}");
        assert!((along - straight).abs() < 2e-4, "{along} along, {straight} in space");
    }
    let marked: Vec<f64> = rows.iter().filter(|r| !r[6].is_empty()).map(|r| number(r, 0)).collect();
    let marks: Vec<&str> = rows.iter().map(|r| r[6]).filter(|m| !m.is_empty()).collect();
    assert_eq!(marks, ["end", "tangent", "tangent", "tangent", "tangent", "tangent", "tangent", "end"]);
    let mut lengths = measured.bends.iter().map(|b| b.length_mm.unwrap()).collect::<Vec<_>>();
    lengths.push(measured.last_length_mm.unwrap());
    for (k, pair) in marked.windows(2).enumerate() {
        let expected = match k % 2 {
            0 => lengths[k / 2],
            _ => measured.bends[k / 2].angle_rad * measured.bends[k / 2].radius_mm.unwrap(),
        };
        assert!((pair[1] - pair[0] - expected).abs() < 1e-4, "segment {}: {pair:?}, {expected}", k + 1);
        let own = rows.iter().filter(|r| number(r, 0) > pair[0] && number(r, 0) <= pair[1]);
        let expected = ((k + 1).to_string(), if k % 2 == 0 { "line" } else { "arc" });
        assert!(own.into_iter().all(|r| r[4] == expected.0 && r[5] == expected.1), "segment {}", k + 1);
    }
}

/// Positions, colours and deviations of the coloured cloud, by its header.
fn coloured(bytes: &[u8]) -> Vec<([u8; 3], f32)> {
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let head = std::str::from_utf8(&bytes[..at]).unwrap();
    assert!(
        head.contains("format binary_little_endian 1.0") && head.contains("property float deviation_mm"),
        "{head}"
    );
    let record = |r: &[u8]| ([r[24], r[25], r[26]], f32::from_le_bytes(r[27..31].try_into().unwrap()));
    assert_eq!((bytes.len() - at) % 31, 0);
    bytes[at..].chunks(31).map(record).collect()
}

#[test]
fn the_coloured_cloud_is_the_scan_with_its_deviations() {
    let folder = scanned();
    let output = run(folder.path(), &["scan.ply", "--export", "dev.ply"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let before = read_scan(&folder.path().join("scan.ply"), Unit::Millimetre).unwrap();
    let after = read_scan(&folder.path().join("dev.ply"), Unit::Millimetre).unwrap();
    assert_eq!(before.cloud, after.cloud, "points and order are the scan's");
    let found = reconstruct(&before.cloud, &Options::default()).unwrap();
    let residuals = found.residuals_mm(&before.cloud);
    let points = coloured(&std::fs::read(folder.path().join("dev.ply")).unwrap());
    let same = points.iter().zip(&residuals).all(|((_, d), r)| *d == *r as f32);
    assert!(same && points.len() == residuals.len());
    // Blue inside, orange outside.
    let noise = found.measured.residual_median_mm as f32;
    for ([red, _, blue], deviation) in points.iter().filter(|p| p.1.abs() > 2.0 * noise && p.1.abs() < 0.5) {
        assert_eq!(red < blue, *deviation < 0.0, "{red} {blue} at {deviation}");
    }
}

#[test]
fn the_page_stands_alone_and_names_every_bend() {
    let folder = scanned();
    let output = run(folder.path(), &["scan.ply", "--export", "report.html"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let page = read(folder.path(), "report.html");
    check_page(&page);
    let sha = read_scan(&folder.path().join("scan.ply"), Unit::Millimetre).unwrap().sha256;
    assert!(page.contains(&sha) && page.contains("scan.ply: 3 bends"));
    for bend in 1..=3 {
        assert!(page.contains(&format!("<td class=\"words\">{bend}</td>")), "bend {bend} in the table");
        // Three views and the unrolled surface.
        assert_eq!(page.matches(&format!(">{bend}</text>")).count(), 4, "bend {bend} in the pictures");
    }
}

#[test]
fn the_page_shows_what_there_may_be() {
    let cloud = cloud();
    let mut found = reconstruct(&cloud, &Options::default()).unwrap();
    assert!(found.measured.bends.iter().all(|b| b.ovality.is_some()) && !found.measured.decisions.is_empty());
    // Other programs' measurements lack them.
    found.measured.bends.iter_mut().for_each(|b| b.ovality = None);
    found.measured.decisions.clear();
    let about = About { file: "a<b>&\"c\".ply", nominal: Some("bracket") };
    let plain = html(&about, &found, &cloud);
    check_page(&plain);
    assert!(
        plain.contains("a&lt;b&gt;&amp;") && !plain.contains("ovality, %") && !plain.contains("Decisions")
    );
    let mut measured = found.measured.clone();
    measured.bends[1].ovality = Some(0.034);
    measured.bends[1].ovality_sigma = Some(0.002);
    measured.bends[2].radius_mm = None;
    measured.last_length_mm = None;
    measured.tube_radius_sigma_mm = Some(0.0123);
    measured.warnings = vec!["several <tubes>".to_owned()];
    let what = "two bends instead of one".to_owned();
    measured.decisions = vec![Decision { what, bend: Some(2), gain: 123.44, kept: true }];
    let full = html(&about, &Reconstruction { measured, ..found }, &cloud);
    check_page(&full);
    for words in
        ["ovality, %", "3.40", "±0.20", "±0.012", "not known", "several &lt;tubes&gt;", "two bends", "123.4"]
    {
        assert!(full.contains(words), "{words}");
    }
}

#[test]
fn what_cannot_be_exported_is_said_before_or_after_but_never_lost() {
    let folder = scanned();
    let before = std::fs::read(folder.path().join("scan.ply")).unwrap();
    for (args, expected) in [
        (["--export", "report.pdf", "--export", "a.csv"], ".csv (the spine), .ply (the points"),
        (["--export", "report", "--export", "a.csv"], "no ending"),
        (["--export", "./scan.ply", "--export", "a.csv"], "this is the scan itself"),
        (["--export", "a.csv", "--export", "a.csv"], "named twice"),
    ] {
        let output = run(folder.path(), &[&["scan.ply"], &args[..]].concat());
        assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0), "{}", said(&output));
        assert!(said(&output).contains(expected), "{}", said(&output));
    }
    assert_eq!(std::fs::read(folder.path().join("scan.ply")).unwrap(), before);
    for name in ["missing/a.csv", "missing/a.ply", "missing/a.html"] {
        let output = run(folder.path(), &["scan.ply", "--json", "--export", name]);
        assert_eq!(output.status.code(), Some(2));
        assert!(said(&output).contains(&format!("{name}: cannot be written")), "{}", said(&output));
        serde_json::from_slice::<benderd::tube::MeasuredTube>(&output.stdout).unwrap();
    }
}
