//! The house keeps its walls: the table of rooms in ARCHITECTURE.md is the rule, the sources are held to it.
//!
//! Checked: every `crate::room` in `src/` is allowed by the table, no circle among the rooms, the picture
//! says what the table says, every file has a header, and pure rooms stay pure.

#![allow(clippy::unwrap_used, clippy::expect_used)] // clippy does not count the helpers of an integration test as test code

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// What a pure room must not know of, and why. Readers of scan files are the exception, named in the table.
const IMPURE: [(&str, &str); 9] = [
    ("tokio", "async lives in arm, bender, cell"),
    ("async fn", "async lives in arm, bender, cell"),
    ("SystemTime", "the caller brings the time"),
    ("Instant", "the caller brings the time"),
    ("std::fs", "files come in through config, arm and the cloud's readers"),
    ("std::env", "settings come in as arguments"),
    ("std::net", "links live in bender"),
    ("thread_rng", "randomness is seeded by the caller"),
    ("rand::rng", "randomness is seeded by the caller"),
];

#[derive(Debug, Default)]
struct Room {
    may_use: BTreeSet<String>,
    pure: bool,
    /// Files of a pure room that may read scan files.
    readers: BTreeSet<String>,
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Rows `| room | what | may use | pure |` of ARCHITECTURE.md.
fn rooms() -> BTreeMap<String, Room> {
    let text = read(&root().join("ARCHITECTURE.md"));
    let mut rooms = BTreeMap::new();
    let rows =
        text.lines().skip_while(|l| !l.starts_with("## Rooms")).take_while(|l| !l.starts_with("The same"));
    for line in rows.filter(|l| l.starts_with("| `")) {
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        let [name, _, uses, pure] = cells[..] else { panic!("not a row of rooms: {line}") };
        let ticked = |text: &str| -> BTreeSet<String> {
            let names =
                if text == "all" { vec!["all"] } else { text.split('`').skip(1).step_by(2).collect() };
            names.into_iter().map(|s| s.trim_end_matches('/').to_owned()).collect()
        };
        let name = name.trim_matches('`').trim_end_matches('/').to_owned();
        let room = Room { may_use: ticked(uses), pure: pure.starts_with("yes"), readers: ticked(pure) };
        assert!(rooms.insert(name, room).is_none(), "a room twice: {line}");
    }
    rooms
}

/// Every source below `folder`, in order.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let entries = std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    for path in entries.map(|e| e.unwrap().path()) {
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// A test module in a file of its own; every one of them is called so.
fn is_test(file: &Path) -> bool {
    let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let in_folder = file.parent().is_some_and(|folder| folder.ends_with("tests"));
    stem == "tests" || stem.ends_with("_tests") || in_folder
}

/// The code of a source: without comments, which may name any room.
fn code(text: &str) -> String {
    text.lines().map(|l| l.split("//").next().unwrap_or("")).collect::<Vec<_>>().join("\n")
}

/// Without its test module as well (clippy keeps it last in the file): tests may read files, wait, and use the
/// simulators.
fn shipped_code(text: &str) -> String {
    code(text).split("#[cfg(test)]\nmod ").next().unwrap_or("").to_owned()
}

/// Rooms that a source reaches for: `crate::room`, `super::super::room` from a room's own file, and the first
/// names in `use crate::{..}`.
fn reaches(code: &str) -> BTreeSet<String> {
    let word = |s: &str| s.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let mut found = BTreeSet::new();
    let code = code.replace("super::super::", "crate::");
    for rest in code.split("crate::").skip(1) {
        let Some(group) = rest.strip_prefix('{') else {
            found.insert(word(rest));
            continue;
        };
        let (mut depth, mut start) = (0, true);
        for (i, c) in group.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => start = true,
                c if start && c.is_alphanumeric() => {
                    found.insert(word(&group[i..]));
                    start = false;
                }
                _ => {}
            }
        }
    }
    found
}

#[test]
fn the_table_names_every_room_and_no_other() {
    let listed: BTreeSet<String> = rooms().into_keys().collect();
    let src = std::fs::read_dir(root().join("src")).unwrap();
    let built: BTreeSet<String> = src
        .map(|e| e.unwrap().path())
        .filter(|p| p.is_dir())
        .map(|p| p.file_name().unwrap().to_string_lossy().into_owned())
        .collect();
    assert_eq!(listed, built, "left: rooms in ARCHITECTURE.md, right: folders in src/");
}

#[test]
fn no_room_reaches_past_its_walls() {
    let mut broken = Vec::new();
    let names: BTreeSet<String> = rooms().into_keys().collect();
    for (name, room) in rooms() {
        for file in sources(&root().join("src").join(&name)).iter().filter(|f| !is_test(f)) {
            for used in reaches(&shipped_code(&read(file))) {
                if names.contains(&used)
                    && used != name
                    && !room.may_use.contains(&used)
                    && !room.may_use.contains("all")
                {
                    broken.push(format!("{}: {name} may not use {used}", file.display()));
                }
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn there_is_no_circle() {
    let mut left = rooms();
    while !left.is_empty() {
        let names: BTreeSet<String> = left.keys().cloned().collect();
        let ground = |name: &String, room: &Room| {
            let others = names.iter().filter(|n| *n != name);
            if room.may_use.contains("all") { others.count() == 0 } else { room.may_use.is_disjoint(&names) }
        };
        let free: Vec<String> = left.iter().filter(|(n, r)| ground(n, r)).map(|(n, _)| n.clone()).collect();
        assert!(!free.is_empty(), "a circle among {names:?}");
        free.iter().for_each(|name| drop(left.remove(name)));
    }
}

#[test]
fn the_picture_says_what_the_table_says() {
    let text = read(&root().join("ARCHITECTURE.md"));
    let picture =
        text.split("```mermaid").nth(1).and_then(|t| t.split("```").next()).expect("a mermaid graph");
    let mut drawn: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for line in picture.lines().map(str::trim).filter(|l| l.contains("-->")) {
        let (from, to) = line.split_once("-->").unwrap();
        let targets = to.split('&').map(|t| t.trim().to_owned());
        drawn.entry(from.trim().to_owned()).or_default().extend(targets);
    }
    let listed: BTreeMap<String, BTreeSet<String>> =
        rooms().into_iter().filter(|(_, r)| !r.may_use.is_empty()).map(|(n, r)| (n, r.may_use)).collect();
    assert_eq!(drawn, listed, "left: the graph, right: the table of ARCHITECTURE.md");
}

#[test]
fn every_file_says_what_it_is() {
    for folder in ["src", "tests", "benches", "examples", "fuzz/src", "fuzz/fuzz_targets"] {
        let folder = root().join(folder);
        for file in if folder.is_dir() { sources(&folder) } else { Vec::new() } {
            assert!(read(&file).starts_with("//! "), "{} has no //! header", file.display());
        }
    }
}

#[test]
fn pure_rooms_stay_pure() {
    let mut broken = Vec::new();
    for (name, room) in rooms().into_iter().filter(|(_, r)| r.pure) {
        let folder = root().join("src").join(&name);
        for file in sources(&folder).into_iter().filter(|f| !is_test(f)) {
            let code = shipped_code(&read(&file));
            let within = file.strip_prefix(&folder).unwrap().to_string_lossy().into_owned();
            let reader = room.readers.iter().any(|r| within.starts_with(r.as_str()));
            for (word, why) in IMPURE {
                if code.contains(word) && !(reader && word == "std::fs") {
                    broken.push(format!("{}: {word} in a pure room; {why}", file.display()));
                }
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn the_reader_of_imports_sees_them_all() {
    let text = "use crate::tube::{Lra, Bend};\nuse crate::{bender::{Job, x}, cell, journal as j};\n\
                let a = crate::arm::ScanFile; // crate::cli is only spoken of\n\
                #[cfg(test)]\nmod tests { use crate::sim; }";
    let expected = ["arm", "bender", "cell", "journal", "tube"].map(String::from);
    assert_eq!(reaches(&shipped_code(text)), BTreeSet::from(expected));
}
