//! `benderd knowledge` as a user meets it: list, show and picture, pairs out and in, merging, and files that are refused.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use benderd::config::{Document, Materials, parse_part};
use benderd::correct::knowledge::Key;
use benderd::correct::learned::Learned;
use benderd::correct::{History, Knowledge, Limits, Part, SetUp, learn, step, store};
use benderd::tube::Nominal;
use common::measured;

const PART: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/config/parts/bracket-17.toml");

fn bracket() -> Nominal {
    let text = fs::read_to_string(PART).unwrap();
    parse_part(&Document::new("bracket-17.toml", text), &Materials::shipped().unwrap()).unwrap()
}

/// A folder with a knowledge file in it, and the program.
struct Shop {
    dir: tempfile::TempDir,
}

impl Shop {
    fn new() -> Shop {
        Shop { dir: tempfile::tempdir().unwrap() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn file(&self, name: &str, text: &str) -> PathBuf {
        fs::write(self.path(name), text).unwrap();
        self.path(name)
    }

    /// Runs `benderd knowledge` on a file of the shop: exit status, stdout, stderr.
    fn run(&self, file: &str, words: &[&str]) -> (i32, String, String) {
        let mut command = Command::cargo_bin("benderd").unwrap();
        command.current_dir(self.dir.path()).arg("knowledge").args(words).args(["--knowledge", file]);
        let out = command.output().unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (out.status.code().unwrap(), text(out.stdout), text(out.stderr))
    }

    fn good(&self, file: &str, words: &[&str]) -> String {
        let (code, out, err) = self.run(file, words);
        assert_eq!((code, err.as_str()), (0, ""), "{words:?}: {out}");
        out
    }

    fn json(&self, file: &str, words: &[&str]) -> serde_json::Value {
        serde_json::from_str(&self.good(file, words)).unwrap()
    }

    /// Refused with status 2, nothing said on stdout, the file as it was.
    fn refused(&self, file: &str, words: &[&str]) -> String {
        let before = fs::read(self.path(file)).ok();
        let (code, out, err) = self.run(file, words);
        assert_eq!((code, out.as_str()), (2, ""), "{words:?}: {err}");
        assert_eq!(fs::read(self.path(file)).ok(), before, "{words:?}");
        err
    }

    fn known(&self, file: &str) -> Knowledge {
        store::load(&self.path(file)).unwrap()
    }
}

/// Jobs of tubes of the bracket whose bends all spring back by this much at any angle, on a bender.
fn job(known: &Knowledge, bender: &str, batch: &str, tubes: usize, springback_deg: f64) -> Knowledge {
    let nominal = bracket();
    let key = SetUp { bender: bender.to_owned(), lubrication: "std".to_owned() };
    let mut history = History { key, batch: Some(batch.to_owned()), parts: Vec::new() };
    let commanded = step(&nominal, &history, &Knowledge::default(), &Limits::default()).commanded;
    for tube in 0..tubes {
        let mut formed = nominal.lra.clone();
        for (bend, row) in formed.bends.iter_mut().zip(&commanded.bends) {
            bend.angle_rad = row.angle_rad - springback_deg.to_radians();
        }
        let scan_id = Some(format!("{bender} {batch} {tube}"));
        history.parts.push(Part { scan_id, ..Part::new(commanded.clone(), measured(&formed, 0.03)) });
    }
    learn(&nominal, &history, known, &Limits::default())
}

/// Two batches on b1, one on b2.
fn shop() -> Shop {
    let shop = Shop::new();
    let known = job(&Knowledge::default(), "b1", "h77", 2, 2.0);
    let known = job(&job(&known, "b1", "h78", 1, 2.2), "b2", "h78", 1, 1.5);
    store::save(&shop.path("k.json"), &known).unwrap();
    shop
}

const TO_BRACKET: [&str; 6] = ["--nominal", PART, "--bender", "b1", "--lubrication", "std"];

fn import<'a>(file: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    [&["import", file], more].concat()
}

// ---- list and show

#[test]
fn the_list_has_a_line_for_every_key() {
    let shop = shop();
    let text = shop.good("k.json", &["list"]);
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 4, "{text}");
    assert!(lines[0].starts_with("no  material  OD x wall mm"), "{text}");
    let cells: Vec<&str> = lines[1].split_whitespace().collect();
    assert_eq!(
        cells[..11],
        ["1", "304", "25.4", "x", "1.65", "50.8", "b1", "std", "2", "3", "h77,"],
        "{text}"
    );
    let all = shop.json("k.json", &["list", "--json"]);
    let key = &all["keys"][0];
    assert_eq!(all["keys"].as_array().unwrap().len(), 2);
    assert_eq!((&key["jobs"], &key["tubes"], &key["number"]), (&2.into(), &3.into(), &1.into()));
    assert_eq!(key["batches"], serde_json::json!(["h77", "h78"]));
    assert_eq!((key["batch"].as_str(), key["key"]["material"].as_str()), (Some("h78"), Some("304")));
    let at: Vec<f64> =
        key["springback"].as_array().unwrap().iter().map(|a| a["commanded_deg"].as_f64().unwrap()).collect();
    assert_eq!(at, [20.0, 90.0, 120.0]);
    for at in key["springback"].as_array().unwrap() {
        let of = |name: &str| at[name].as_f64().unwrap();
        assert!(of("sigma_deg") > 0.0 && of("sigma_deg") < of("next_sigma_deg"), "{at}");
    }
    assert!((key["springback"][1]["springback_deg"].as_f64().unwrap() - 2.1).abs() < 0.2, "{key}");
}

#[test]
fn a_material_that_is_not_in_the_file_is_said_not_guessed() {
    let shop = shop();
    let text = fs::read_to_string(shop.path("k.json")).unwrap().replacen("\"304\"", "\"unobtainium\"", 1);
    shop.file("k.json", &text);
    let out = shop.good("k.json", &["list"]);
    assert!(out.contains("unobtainium") && out.contains("name one by --materials"), "{out}");
    let err = shop.refused("k.json", &["show", "1"]);
    assert!(err.contains("material \"unobtainium\"") && err.contains("304"), "{err}");
}

#[test]
fn a_key_is_shown_with_law_band_and_measurements() {
    let shop = shop();
    let text = shop.good("k.json", &["show", "1", "--picture", "p.svg"]);
    for part in [
        "key 1: 304, OD 25.4 x 1.65 mm, CLR 50.8 mm, bender b1, lubrication std",
        "from 2 jobs, 3 tubes; parts bracket-17; batches h77, h78",
        "x1 + x2 c/90 + x3 sqrt(c/90)",
        "tubes of batch h78",
        "tubes of a new batch",
        "opens the arc",
        "backlash",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let points = text.lines().filter(|l| l.starts_with("bracket-17")).count();
    assert_eq!(points, 8, "four bends of two jobs: {text}");
    let svg = fs::read_to_string(shop.path("p.svg")).unwrap();
    for part in [
        "Spring-back of 304, 25.4 x 1.65 mm, CLR 50.8 mm",
        "commanded angle, degrees",
        "batch h77",
        "3 tubes",
    ] {
        assert!(svg.contains(part), "{part}: {svg}");
    }
    let shown = shop.json("k.json", &["show", "1", "--json"]);
    assert_eq!(shown["measurements"].as_array().unwrap().len(), 8);
    assert_eq!(shown["law"].as_array().unwrap().len(), 18);
    assert_eq!(shown["coefficients"].as_array().unwrap().len(), 3);
    let other = |i: usize| shown["new_batch"][i]["sigma_deg"].as_f64().unwrap();
    assert!(other(1) > shown["law"][8]["sigma_deg"].as_f64().unwrap(), "a new batch is known less: {shown}");
    let radius = shown["formed_radius_mm"].as_f64().unwrap();
    assert!((51.0..53.0).contains(&radius), "{radius}");
}

#[test]
fn the_key_is_named_by_its_number_where_there_are_several() {
    let shop = shop();
    let err = shop.refused("k.json", &["show"]);
    assert!(err.contains("which of the 2 keys? Say its number in `list`"), "{err}");
    let err = shop.refused("k.json", &["show", "3"]);
    assert!(err.contains("there is no key 3: allowed is 1 to 2"), "{err}");
    let err = shop.refused("k.json", &["show", "1", "--picture", "k.json"]);
    assert!(err.contains("has to end in .svg"), "{err}");
    let err = shop.refused("none.json", &["list"]);
    assert!(err.contains("none.json"), "{err}");
    let only = shop.good("k.json", &["export", "2"]);
    shop.file("one.json", &only);
    assert!(shop.good("one.json", &["show"]).contains("bender b2"));
    shop.file("empty.json", r#"{"version": 2, "keys": []}"#);
    assert_eq!(shop.good("empty.json", &["list"]), "nothing was learned yet\n");
    assert!(shop.refused("empty.json", &["show"]).contains("nothing was learned yet"));
}

// ---- knowledge files out and in

#[test]
fn what_is_exported_is_imported_the_same_and_once() {
    let shop = shop();
    let all = shop.good("k.json", &["export"]);
    shop.file("all.json", &all);
    let out = shop.good("new.json", &["import", "all.json"]);
    assert!(out.contains("3 jobs new, 0 with more tubes than before, 0 known already"), "{out}");
    assert_eq!(fs::read_to_string(shop.path("new.json")).unwrap(), all);
    let before = fs::read(shop.path("new.json")).unwrap();
    assert!(shop.good("new.json", &["import", "all.json"]).contains("nothing new in all.json"));
    assert_eq!(fs::read(shop.path("new.json")).unwrap(), before);
}

#[test]
fn of_the_same_job_the_record_with_more_tubes_stays() {
    let shop = Shop::new();
    let short = job(&Knowledge::default(), "b1", "h77", 1, 2.0);
    let long = job(&Knowledge::default(), "b1", "h77", 3, 2.0);
    store::save(&shop.path("short.json"), &short).unwrap();
    store::save(&shop.path("long.json"), &long).unwrap();
    let out = shop.good("short.json", &["import", "long.json"]);
    assert!(out.contains("0 jobs new, 1 with more tubes than before"), "{out}");
    assert_eq!(shop.known("short.json").keys[0].jobs[0].parts, 3);
    store::save(&shop.path("short.json"), &short).unwrap();
    assert!(shop.good("long.json", &["import", "short.json"]).contains("nothing new"));
}

// ---- pairs

#[test]
fn the_pair_is_the_law_at_either_angle() {
    let shop = shop();
    let pair = shop.json("k.json", &["export", "1", "--pair", "--json"]);
    let known = shop.known("k.json");
    let materials = Materials::shipped().unwrap();
    let learned = Learned::of(&known.keys[0], materials.get("304").unwrap(), Some("h78"));
    let of = |which: &str, field: &str| pair[which][field].as_f64().unwrap();
    let law = |deg: f64| learned.law(deg.to_radians()).value.to_degrees();
    for (angle, field) in [(20.0, "springback_at_20_deg"), (120.0, "springback_at_120_deg")] {
        assert!((of("commanded", field) - law(angle)).abs() < 1e-8);
        // What is commanded beyond the drawing's angle springs back by just that.
        let over = of("designed", field);
        assert!((over - law(angle + over)).abs() < 1e-8, "{over}");
    }
    for which in ["designed", "commanded"] {
        let line = |deg: f64| of(which, "constant_deg") + of(which, "per_degree") * deg;
        assert!((line(20.0) - of(which, "springback_at_20_deg")).abs() < 1e-8);
        assert!((line(120.0) - of(which, "springback_at_120_deg")).abs() < 1e-8);
    }
    let text = shop.good("k.json", &["export", "1", "--pair"]);
    assert!(text.contains("designed: for a controller into which the drawing's angle is typed"), "{text}");
}

/// s = 0.8 + 0.015 c: by the drawing's angle S = (0.8 + 0.015 d) / 0.985, so 1.116751 at 20 and 2.639594 at 120.
#[test]
fn both_kinds_of_pair_put_the_same_line_in() {
    let shop = Shop::new();
    let by_hand = [
        ("commanded_deg,springback_deg\n20,1.1\n120,2.6\n", [20.0, 120.0]),
        ("designed_deg,springback_deg\n20,1.116751269\n120,2.639593909\n", [21.116_751_269, 122.639_593_909]),
    ];
    for (text, commanded) in by_hand {
        shop.file("pair.csv", text);
        let out = shop.good("k.json", &import("pair.csv", &TO_BRACKET));
        assert!(out.contains("controller's pair with 2 angles put in for 304, OD 25.4 x 1.65 mm"), "{out}");
        let known = shop.known("k.json");
        assert_eq!(
            (known.keys.len(), known.keys[0].jobs.len()),
            (1, 1),
            "the newer pair stands for the older"
        );
        let job = &known.keys[0].jobs[0];
        assert_eq!((job.parts, job.bends.len()), (0, 2));
        for (point, angle) in job.bends.iter().zip(commanded) {
            let (c, s) = (point.commanded_rad.to_degrees(), point.springback_rad.to_degrees());
            assert!((c - angle).abs() < 1e-8 && (s - 0.8 - 0.015 * c).abs() < 1e-8, "{c} {s}");
            assert!((point.sigma_rad.to_degrees() - 0.3).abs() < 1e-9);
        }
        let before = fs::read(shop.path("k.json")).unwrap();
        assert!(shop.good("k.json", &import("pair.csv", &TO_BRACKET)).contains("nothing new"));
        assert_eq!(fs::read(shop.path("k.json")).unwrap(), before);
    }
}

#[test]
fn what_was_told_moves_the_first_piece_but_weighs_less_than_tubes() {
    let shop = Shop::new();
    let nominal = bracket();
    let history = History {
        key: SetUp { bender: "b1".to_owned(), lubrication: "std".to_owned() },
        ..History::default()
    };
    let over = |known: &Knowledge| {
        let table = step(&nominal, &history, known, &Limits::default()).commanded;
        (table.bends[0].angle_rad - nominal.lra.bends[0].angle_rad).to_degrees()
    };
    let untold = over(&Knowledge::default());
    shop.file("list.csv", "angle_deg,overbend_deg\n15,2\n30,2.5\n45,3\n60,3.5\n90,4.5\n120,5.5\n");
    shop.good("k.json", &import("list.csv", &TO_BRACKET));
    let told = shop.known("k.json");
    assert!((4.0..4.6).contains(&over(&told)) && untold < 2.5, "{} {untold}", over(&told));
    let sigma = told.keys[0].jobs[0].bends[0].sigma_rad.to_degrees();
    assert!((sigma - 0.3 * 3.0_f64.sqrt()).abs() < 1e-9, "six rows count as two: {sigma}");
    // Three measured tubes that spring back by 2 degrees outweigh the list.
    let measured = over(&job(&told, "b1", "h77", 3, 2.0));
    assert!((measured - 2.0).abs() < (measured - 4.5).abs(), "{measured}");
}

#[test]
fn a_bent_test_is_a_tube_of_its_batch() {
    let shop = Shop::new();
    shop.file("test.csv", "commanded_deg,measured_deg\n45,43.6\n105,102.5\n");
    let words = [&TO_BRACKET[..], &["--batch", "h79"]].concat();
    shop.good("k.json", &import("test.csv", &words));
    shop.good("k.json", &import("test.csv", &words));
    shop.file("test.csv", "commanded_deg,measured_deg\n45,43.5\n105,102.6\n");
    shop.good("k.json", &import("test.csv", &words));
    let known = shop.known("k.json");
    let nominal = bracket();
    let set_up = SetUp { bender: "b1".to_owned(), lubrication: "std".to_owned() };
    assert_eq!(known.keys[0].key, Key::of(&nominal, &set_up));
    let jobs = &known.keys[0].jobs;
    assert_eq!(jobs.len(), 2, "the same test once, another beside it");
    assert_eq!((jobs[0].parts, jobs[0].batch.as_deref()), (1, Some("h79")));
    assert!((jobs[0].bends[1].springback_rad.to_degrees() - 2.5).abs() < 1e-9);
    let shown = shop.json("k.json", &["show", "--json"]);
    assert!((shown["law"][8]["springback_deg"].as_f64().unwrap() - 2.3).abs() < 0.3, "{shown}");
}

// ---- refusals

#[test]
fn files_that_cannot_be_used_are_refused_with_the_place() {
    let shop = shop();
    for (text, wanted) in [
        ("angle_deg,overbend_deg\n30,0.9\n90,two\n", "in.csv, line 3: overbend_deg = \"two\", allowed is"),
        ("angle_deg,bend_deg\n30,0.9\n90,2\n", "in.csv, line 1: header = \"angle_deg,bend_deg\", allowed is"),
        ("angle_deg,overbend_deg\n30,0.9\n", "in.csv, line 1: number of rows = 1, allowed is 2 to 400"),
        ("commanded_deg,measured_deg\n45,46\n105,102\n", "in.csv, line 2: measured_deg = \"46\""),
        ("{\"version\": 2, \"keys\": [}", "in.csv: not a knowledge file: expected value at line 1"),
        ("{\"version\": 1, \"keys\": []}", "version = 1, allowed is 2"),
    ] {
        shop.file("in.csv", text);
        let err = shop.refused("k.json", &import("in.csv", &TO_BRACKET[2..]));
        let csv = !text.starts_with('{');
        let err = if csv { shop.refused("k.json", &import("in.csv", &TO_BRACKET)) } else { err };
        assert!(err.contains(wanted), "{err}");
    }
    shop.file("in.csv", "angle_deg,overbend_deg\n30,0.9\n90,2\n");
    let err = shop.refused("k.json", &["import", "in.csv"]);
    assert!(err.contains("in.csv: a CSV does not say what it is of: name the part by --nominal"), "{err}");
    shop.file("in.json", "{\"version\": 2, \"keys\": []}");
    let err = shop.refused("k.json", &import("in.json", &TO_BRACKET));
    assert!(err.contains("leave --nominal and --batch out"), "{err}");
    assert!(shop.refused("k.json", &["import", "none.json"]).contains("none.json"));
}

#[test]
fn values_that_cannot_be_are_refused_with_key_job_and_field() {
    let shop = shop();
    let good = fs::read_to_string(shop.path("k.json")).unwrap();
    let value: serde_json::Value = serde_json::from_str(&good).unwrap();
    let id = value["keys"][0]["jobs"][1]["id"].as_str().unwrap().to_owned();
    let case = |change: &dyn Fn(&mut serde_json::Value)| {
        let mut bad = value.clone();
        change(&mut bad);
        shop.file("bad.json", &bad.to_string());
        let err = shop.refused("k.json", &["import", "bad.json"]);
        assert!(shop.refused("bad.json", &["list"]).contains("bad.json: not a knowledge file"));
        err
    };
    let err = case(&|v| v["keys"][0]["jobs"][1]["bends"][2]["sigma_deg"] = (-1).into());
    let wanted = format!("key 1, job 2 ({id:?}), bend 3.sigma_deg = -1, allowed is");
    assert!(err.contains("bad.json") && err.contains(&wanted), "{err}");
    let err = case(&|v| v["keys"][1]["key"]["wall_mm"] = 20.into());
    assert!(err.contains("key 2.wall_mm = 20, allowed is 0.05 to 12.7"), "{err}");
    let err = case(&|v| v["keys"][1]["key"]["bender"] = "b1".into());
    assert!(err.contains("key 2: the same key stands there before"), "{err}");
    let err = case(&|v| v["keys"][0]["jobs"][1]["straights"][0]["sigma_mm"] = 0.into());
    assert!(err.contains("straight 1.sigma_mm = 0"), "{err}");
    let err = case(&|v| v["keys"][0]["jobs"][1]["turns"][0]["per_backlash"] = 7.into());
    assert!(err.contains("turn 1.per_backlash = 7"), "{err}");
    let err = case(&|v| v["keys"][0]["jobs"][0]["id"] = id.clone().into());
    assert!(err.contains("a job with the same id stands before it"), "{err}");
    // `correct` refuses it as well, before it is written over.
    shop.file("h.json", r#"{"parts": []}"#);
    let mut command = Command::cargo_bin("benderd").unwrap();
    command.current_dir(Path::new(shop.dir.path()));
    let args = ["correct", "--nominal", PART, "--history", "h.json", "--knowledge", "bad.json"];
    assert_eq!(command.args(args).output().unwrap().status.code(), Some(2));
}

#[test]
fn help_says_what_can_be_imported() {
    let shop = Shop::new();
    let mut command = Command::cargo_bin("benderd").unwrap();
    let out = command.current_dir(shop.dir.path()).args(["knowledge", "import", "--help"]).output().unwrap();
    let text = String::from_utf8(out.stdout).unwrap();
    for part in
        ["designed_deg,springback_deg", "angle_deg,overbend_deg", "commanded_deg,measured_deg", "0.3 degrees"]
    {
        assert!(text.contains(part), "{text}");
    }
}
