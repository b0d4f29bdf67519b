//! `benderd demo`: the whole chain on simulated hardware, as a newcomer runs it.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::path::Path;
use std::process::{Command, Output};

/// Runs the demo with a temporary folder of its own.
fn demo(temp: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_benderd"));
    command.arg("demo").args(args).env("TMPDIR", temp).current_dir(temp).output().unwrap()
}

/// What it printed, without the port that the system chose.
fn story(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    text.lines().filter(|l| !l.contains("127.0.0.1:")).collect::<Vec<_>>().join("\n")
}

#[test]
fn it_reaches_tolerance_by_part_three_and_leaves_nothing_behind() {
    let temp = tempfile::tempdir().unwrap();
    let output = demo(temp.path(), &[]);
    let text = story(&output);
    assert_eq!(output.status.code(), Some(0), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("Part 1, bent with table revision 1"), "{text}");
    let last = text.lines().last().unwrap();
    let part = last.strip_prefix("In tolerance on part ").and_then(|l| l.chars().next());
    assert!(part.is_some_and(|p| ('1'..='3').contains(&p)), "{last}");
    assert_eq!(std::fs::read_dir(temp.path()).unwrap().count(), 0);
}

#[test]
fn the_same_seed_tells_the_same_story_and_draws_the_same_picture() {
    let temp = tempfile::tempdir().unwrap();
    let runs = ["a.svg", "b.svg"].map(|name| {
        let output = demo(temp.path(), &["--seed", "2", "--picture", name]);
        (story(&output), std::fs::read_to_string(temp.path().join(name)).unwrap())
    });
    assert_eq!(runs[0], runs[1]);
    let svg = &runs[0].1;
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>") && !svg.contains("NaN"), "{svg}");
    let other = story(&demo(temp.path(), &["--seed", "3"]));
    assert_ne!(runs[0].0, other);
}

#[test]
fn other_materials_spring_back_and_are_mastered_as_well() {
    let temp = tempfile::tempdir().unwrap();
    for material in ["6061-t6", "ti-3al-2.5v"] {
        let output = demo(temp.path(), &["--material", material]);
        let text = story(&output);
        assert_eq!(output.status.code(), Some(0), "{material}:\n{text}");
    }
}

#[test]
fn unusable_arguments_end_with_2_and_say_what_is_known() {
    let temp = tempfile::tempdir().unwrap();
    for (args, expected) in [
        (["--material", "cheese"], "known are 304, 316l"),
        (["--part", "missing.toml"], "missing.toml: cannot be read"),
    ] {
        let output = demo(temp.path(), &args);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(text.contains(expected), "{text}");
    }
}
