//! `benderd simulate scan` as its user runs it.

use std::path::Path;

use assert_cmd::Command;
use benderd::cloud::{Unit, read_scan};

const PART: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/config/parts/bracket-17.toml");

fn simulate(out: &Path, more: &[&str]) -> assert_cmd::assert::Assert {
    let mut command = Command::new(env!("CARGO_BIN_EXE_benderd"));
    command.args(["simulate", "scan", "--part", PART, "--seed", "7", "--points", "3000", "--out"]);
    command.arg(out).args(more).assert()
}

#[test]
fn a_simulated_scan_passes_the_door_and_is_the_same_every_time() {
    let folder = tempfile::tempdir().unwrap();
    let (ply, xyz) = (folder.path().join("a.ply"), folder.path().join("a.xyz"));
    let said = String::from_utf8(simulate(&ply, &[]).success().get_output().stdout.clone()).unwrap();
    assert!(said.contains("bracket-17") && said.contains("true tube radius 12.7 mm"), "{said}");
    let first = read_scan(&ply, Unit::Millimetre).unwrap();
    assert!((2000..4000).contains(&first.cloud.len()), "{}", first.cloud.len());
    simulate(&ply, &[]).success();
    assert_eq!(read_scan(&ply, Unit::Millimetre).unwrap(), first);
    simulate(
        &xyz,
        &[
            "--jaws",
            "grip",
            "--drift-mm",
            "0.05",
            "--table",
            "--v-blocks",
            "--patches",
            "2",
            "--ovality",
            "0.05",
            "--views",
            "2",
        ],
    )
    .success();
    assert!(read_scan(&xyz, Unit::Millimetre).unwrap().cloud.len() > first.cloud.len());
}

#[test]
fn unusable_arguments_end_with_status_2_and_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.ply");
    for (out, more, reason) in [
        (folder.path().join("a.step"), &[][..], "only .ply, .e57, .stl"),
        (folder.path().join("no/such/a.ply"), &[], "cannot be written"),
        (file.clone(), &["--noise-mm=-1"], "allowed is 0 to 10"),
        (file.clone(), &["--outliers", "nan"], "allowed is 0 to 1"),
        (file.clone(), &["--jaws", "round"], "allowed is grip or flat"),
        (file, &["--views", "0"], "1..=20"),
    ] {
        let output = simulate(&out, more).code(2).get_output().stderr.clone();
        let said = String::from_utf8(output).unwrap();
        assert!(said.contains(reason), "{reason} is missing in {said}");
        assert!(!out.exists());
    }
}
