//! The door as its users see it: every variant of every format read alike, every bad file refused with the reason.

mod e57;
mod e57_hostile;
mod ply;
mod stl;
mod streams;
mod text;

use std::path::{Path, PathBuf};

use nalgebra::Point3;
use proptest::prelude::*;

use super::*;

/// 400 points over some 300 mm, no two alike.
fn sample() -> Vec<Point3<f64>> {
    (0..400)
        .map(|i| {
            let t = f64::from(i) * 0.75;
            Point3::new(t, 10.0 * (t * 0.3).sin() - 500.0, 10.0 * (t * 0.3).cos())
        })
        .collect()
}

fn refusal(name: &str, bytes: &[u8]) -> String {
    parse_scan(Path::new(name), bytes, Unit::Millimetre).expect_err("should be refused").to_string()
}

fn accepted(name: &str, bytes: &[u8]) -> Scan {
    parse_scan(Path::new(name), bytes, Unit::Millimetre).unwrap()
}

fn text(points: &[Point3<f64>], separator: &str) -> String {
    points.iter().map(|p| format!("{}{separator}{}{separator}{}\n", p.x, p.y, p.z)).collect()
}

/// Largest distance between the cloud's points and the given ones.
fn error_mm(cloud: &PointCloud, points: &[Point3<f64>]) -> f64 {
    assert_eq!(cloud.len(), points.len());
    cloud.iter().zip(points).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
}

/// The parts of a refusal that its reader needs.
fn says(refusal: &str, parts: &[&str]) {
    for part in parts {
        assert!(refusal.contains(part), "{part:?} is missing in: {refusal}");
    }
}

#[test]
fn unknown_kinds_and_empty_files() {
    says(&refusal("s.xyz", b""), &["s.xyz", "empty"]);
    says(&refusal("s.igs", b"1 2 3\n"), &[".igs", ".ply", ".xyz .asc .pts .csv .txt"]);
    says(&refusal("scan", b"1 2 3\n"), &["no extension"]);
    says(&refusal("s.ply", b"1 2 3\n"), &["does not begin"]);
    says(&refusal("s.xyz", b"# only a comment\n"), &["0 found"]);
    let missing = read_scan(Path::new("/nonexistent/s.ply"), Unit::Metre).unwrap_err().to_string();
    says(&missing, &["/nonexistent/s.ply", "cannot be read"]);
    let folder = read_scan(&std::env::temp_dir(), Unit::Metre).unwrap_err().to_string();
    says(&folder, &["cannot be read"]);
}

#[test]
fn at_least_a_hundred_points() {
    let points = sample();
    let wide = |n: usize| text(&points[400 - n..], " ");
    says(&refusal("s.xyz", wide(50).as_bytes()), &["50 points", "at least 100"]);
    says(&refusal("s.xyz", wide(99).as_bytes()), &["99 points"]);
    assert_eq!(accepted("s.xyz", wide(100).as_bytes()).cloud.len(), 100);
    // Copies do not count.
    says(&refusal("s.xyz", wide(99).repeat(3).as_bytes()), &["99 points"]);
}

#[test]
fn duplicates_are_removed_and_counted() {
    let points = sample();
    let mut rows = text(&points, " ");
    rows.push_str(&text(&points[..312], " "));
    rows.push_str("-0.0 1 2\n0.0 1 2\n");
    let scan = accepted("s.xyz", rows.as_bytes());
    assert_eq!(scan.notes, ["313 duplicate points removed"]);
    assert!(error_mm(&scan.cloud.select(&(0..400).collect::<Vec<_>>()), &points) < 2e-5);
    assert_eq!(scan.cloud.len(), 401);
}

#[test]
fn coordinates_that_are_none() {
    let rows = text(&sample(), " ");
    for bad in ["nan 0 0", "0 inf 0", "0 0 -infinity", "0 1e999 0"] {
        says(
            &refusal("s.xyz", format!("{rows}{bad}\n{bad}\n").as_bytes()),
            &["2 of 402 points", "the first is point 400"],
        );
    }
    says(&refusal("s.xyz", format!("{rows}0 -3e9 0\n").as_bytes()), &["1 points", "point 400", "3e9"]);
}

#[test]
fn the_wrong_unit_is_refused_with_the_right_one() {
    let scaled = |by: f64| text(&sample().iter().map(|p| p * by).collect::<Vec<_>>(), " ");
    let read = |by: f64, unit| parse_scan(Path::new("s.xyz"), scaled(by).as_bytes(), unit);
    says(&read(1e-3, Unit::Millimetre).unwrap_err().to_string(), &["extent is 0.301 mm", "--unit m"]);
    says(&read(1.0, Unit::Metre).unwrap_err().to_string(), &["--unit mm"]);
    says(&read(1.0 / 25.4, Unit::Millimetre).unwrap_err().to_string(), &["would be 300.6 mm: --unit inch"]);
    says(&read(1e-6, Unit::Millimetre).unwrap_err().to_string(), &["is this the scan of a tube?"]);
    for (by, unit) in [(1e-3, Unit::Metre), (1.0 / 25.4, Unit::Inch)] {
        assert!(error_mm(&read(by, unit).unwrap().cloud, &sample()) < 2e-5);
    }
}

#[test]
fn the_hash_is_that_of_the_file() {
    let rows = text(&sample(), " ");
    let expected = {
        use sha2::Digest;
        format!("{:x?}", sha2::Sha256::digest(rows.as_bytes()).as_slice())
    };
    let got: Vec<u8> = accepted("s.xyz", rows.as_bytes())
        .sha256
        .as_bytes()
        .chunks(2)
        .map(|c| u8::from_str_radix(std::str::from_utf8(c).unwrap(), 16).unwrap())
        .collect();
    assert_eq!(format!("{got:x?}"), expected);
}

#[test]
fn the_order_in_the_file_does_not_move_a_point() {
    let points = sample();
    let turned: Vec<_> = points.iter().rev().copied().collect();
    let bits = |points: &[Point3<f64>]| {
        let cloud = accepted("s.xyz", text(points, " ").as_bytes()).cloud;
        let mut all: Vec<[u64; 3]> = cloud.iter().map(|p| p.coords.map(f64::to_bits).into()).collect();
        all.sort();
        all
    };
    assert_eq!(bits(&points), bits(&turned));
}

/// Data that is not part of the project; None (said aloud) where it is absent.
fn real_scan() -> Option<PathBuf> {
    let folder = std::env::var_os("BENDERD_DATA").unwrap_or_else(|| "../shared".into());
    let path = PathBuf::from(folder).join("real/coil_scan00.ply");
    if !path.exists() {
        eprintln!("skipped: {} is not there", path.display());
        return None;
    }
    Some(path)
}

#[test]
fn a_real_scan_in_metres() {
    let Some(path) = real_scan() else { return };
    says(&read_scan(&path, Unit::Millimetre).unwrap_err().to_string(), &["--unit m"]);
    let scan = read_scan(&path, Unit::Metre).unwrap();
    assert_eq!(scan.cloud.len() + notes_removed(&scan.notes), 99_519);
    let (min, max) = scan.cloud.bounds().unwrap();
    assert!((max - min).norm() > 300.0 && (max - min).norm() < 3000.0);
}

fn notes_removed(notes: &[String]) -> usize {
    notes.iter().filter_map(|n| n.strip_suffix(" duplicate points removed")?.parse::<usize>().ok()).sum()
}

#[test]
fn every_format_that_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = PointCloud::from_points(&sample());
    let read = |name: &str| read_scan(&folder.path().join(name), Unit::Millimetre).unwrap();
    for name in ["a.ply", "a.e57", "a.stl", "a.xyz", "a.asc", "a.txt", "a.pts", "a.csv"] {
        write_scan(&folder.path().join(name), &cloud).unwrap();
        let scan = read(name);
        assert!(error_mm(&scan.cloud, &sample()) < 5e-5, "{name}");
        assert!(scan.notes.is_empty(), "{name}: {:?}", scan.notes);
    }
    let normals = cloud.clone().with_normals(vec![[0.0, 0.6, 0.8]; 400]).unwrap();
    for form in PlyForm::ALL {
        write_ply_as(&folder.path().join("a.ply"), &normals, form).unwrap();
        let scan = read("a.ply");
        assert!(error_mm(&scan.cloud, &sample()) < 5e-5, "{form:?}");
        assert!((scan.cloud.normal(3).unwrap().norm() - 1.0).abs() < 1e-6 && scan.notes.is_empty());
    }
    let refused = write_scan(Path::new("a.step"), &cloud).unwrap_err().to_string();
    says(&refused, &["only .ply", ".csv are written"]);
}
