//! `benderd convert` as a user runs it: all ways, and the ways that cannot be.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::fs;
use std::path::Path;

use assert_cmd::Command;

const MIXED: &str = "length_mm,rotation_deg,angle_deg,radius_mm\n100,0,90,30\n50,90,120,50\n150,0,0,\n";

fn convert(dir: &Path, from: &str, to_file: &str, form: &str) -> std::process::Output {
    let mut command = Command::cargo_bin("benderd").unwrap();
    command.arg("convert").arg(dir.join(from)).arg(dir.join(to_file)).args(["--to", form]).output().unwrap()
}

fn numbers(path: &Path) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(path).unwrap();
    let cell = |c: &str| if c.is_empty() { 0.0 } else { c.parse().unwrap() };
    text.lines().skip(1).map(|l| l.split(',').map(cell).collect()).collect()
}

/// The contracts' "Trying it out" delivers it.
#[test]
fn the_shipped_table_is_the_shipped_part() {
    use benderd::config::{Materials, Table, load_part, read_table};
    let parts = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/parts");
    let Table::Lra(table) = read_table(&parts.join("bracket-17.csv")).unwrap() else { panic!("not LRA") };
    assert_eq!(table, load_part(&parts.join("bracket-17.toml"), &Materials::shipped().unwrap()).unwrap().lra);
}

#[test]
fn all_ways_round_and_back() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    fs::write(at("a.csv"), MIXED).unwrap();
    for (from, to, form) in [
        ("a.csv", "b.csv", "xyz"),
        ("b.csv", "c.csv", "ybc"),
        ("c.csv", "d.csv", "xyz"),
        ("d.csv", "e.csv", "lra"),
    ] {
        let out = convert(dir.path(), from, to, form);
        assert!(out.status.success(), "{from} to {form}: {}", String::from_utf8_lossy(&out.stderr));
    }
    let (wanted, found) = (numbers(&at("a.csv")), numbers(&at("e.csv")));
    assert_eq!(wanted.len(), found.len());
    for (w, f) in wanted.iter().flatten().zip(found.iter().flatten()) {
        assert!((w - f).abs() < 1e-6, "{wanted:?} {found:?}");
    }
    assert!(fs::read_to_string(at("c.csv")).unwrap().starts_with("y_mm,b_deg,c_deg,radius_mm\n"));
}

#[test]
fn xyz_lies_at_the_origin_in_the_plane_of_the_first_bend() {
    let dir = tempfile::tempdir().unwrap();
    // A first rotation is kept in tables; XYZ has no place for it.
    fs::write(dir.path().join("a.csv"), MIXED.replace("100,0,90", "100,77,90")).unwrap();
    assert!(convert(dir.path(), "a.csv", "b.csv", "xyz").status.success());
    let xyz = numbers(&dir.path().join("b.csv"));
    assert_eq!(xyz[0], [0.0, 0.0, 0.0, 0.0]);
    assert_eq!(xyz[1], [130.0, 0.0, 0.0, 30.0]);
    assert!(xyz[2][0] == 130.0 && xyz[2][1] > 100.0 && xyz[2][2] == 0.0, "{xyz:?}");
    assert!(xyz[3][2] > 0.0, "the second bend turns right-handed, towards +z: {xyz:?}");
}

#[test]
fn a_half_turn_has_no_corner_and_the_answer_says_so() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("a.csv"), MIXED.replace("120", "180")).unwrap();
    let out = convert(dir.path(), "a.csv", "b.csv", "xyz");
    assert_eq!(out.status.code(), Some(2));
    let text = String::from_utf8(out.stderr).unwrap();
    for part in ["a.csv", "bend 2", "180.000 degrees", "no corner", "use LRA or YBC"] {
        assert!(text.contains(part), "{part:?} missing in {text}");
    }
    assert!(!dir.path().join("b.csv").exists());
    assert!(convert(dir.path(), "a.csv", "b.csv", "ybc").status.success(), "YBC holds it");
}

#[test]
fn corners_too_close_and_unreadable_files_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("a.csv"), "x_mm,y_mm,z_mm,radius_mm\n0,0,0,\n50,0,0,40\n50,60,0,40\n0,60,0,\n")
        .unwrap();
    let out = convert(dir.path(), "a.csv", "b.csv", "lra");
    assert_eq!(out.status.code(), Some(2));
    let text = String::from_utf8(out.stderr).unwrap();
    assert!(text.contains("a.csv") && text.contains("corner 2 and 3"), "{text}");
    let out = convert(dir.path(), "none.csv", "b.csv", "lra");
    assert_eq!(out.status.code(), Some(2));
    assert!(String::from_utf8(out.stderr).unwrap().contains("none.csv"));
}
