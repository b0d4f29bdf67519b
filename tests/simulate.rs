//! `benderd simulate scan` and `simulate production` as their user runs them.

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

fn production(more: &[&str]) -> assert_cmd::assert::Assert {
    let mut command = Command::new(env!("CARGO_BIN_EXE_benderd"));
    command
        .args(["simulate", "production", "--part", PART, "--jobs", "100", "--seed", "5"])
        .args(more)
        .assert()
}

#[test]
fn simulated_production_is_good_from_the_second_tube_on_and_meets_every_mix_up() {
    let said = production(&["--faults", "--json"]).success().get_output().stdout.clone();
    let found: serde_json::Value = serde_json::from_slice(&said).unwrap();
    let good = |tube: usize| found["tubes"][tube]["good_percent"].as_f64().unwrap();
    assert!(good(0) < 80.0 && good(1) > 90.0 && good(3) > 95.0, "{found}");
    assert!(found["false_holds_percent"].as_f64().unwrap() < 0.5, "{found}");
    let mix_ups = found["mix_ups"].as_object().unwrap();
    assert!(mix_ups.len() == 7 && mix_ups.values().all(|met| met["missed"] == 0), "{mix_ups:?}");
    let again = production(&["--faults", "--json"]).success().get_output().stdout.clone();
    assert_eq!(said, again, "same seed, same jobs");
}

#[test]
fn simulated_production_is_told_in_words_and_unknown_materials_are_refused() {
    let said = String::from_utf8(production(&[]).success().get_output().stdout.clone()).unwrap();
    assert!(
        said.contains("100 jobs of bracket-17 in 304, seed 5") && said.contains("scrap before it"),
        "{said}"
    );
    let error = production(&["--material", "cheese"]).code(2).get_output().stderr.clone();
    let error = String::from_utf8(error).unwrap();
    assert!(error.contains("cheese") && error.contains("ti-3al-2.5v"), "{error}");
}
