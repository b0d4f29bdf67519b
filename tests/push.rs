//! `benderd push` as a user meets it, against a simulated bender on a real socket: exit status, what is said,
//! and what the machine holds afterwards.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::path::{Path, PathBuf};
use std::process::Output;

use assert_cmd::Command;
use benderd::bender::Profile;
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;
use benderd::sim::faults::Fault;
use benderd::sim::frames::Framing;
use serde_json::Value;
use tempfile::TempDir;
use tokio::net::TcpListener;

const LRA: &str =
    "length_mm,rotation_deg,angle_deg,radius_mm\n120,0,92.1,50.8\n150,90,46.35,50.8\n100,0,0,\n";

/// A folder with a table, a profile whose deadlines suit a test, and a machine with that program loaded.
struct Shop {
    folder: TempDir,
    bender: SimulatedBender,
}

impl Shop {
    async fn open(fault: Option<Fault>) -> Shop {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("bracket.csv"), LRA).unwrap();
        let text = include_str!("../protocols/reference-modbus.toml")
            .replace("request_ms = 1000", "request_ms = 300")
            .replace("confirm_ms = 5000", "confirm_ms = 600")
            .replace("settle_ms = 500", "settle_ms = 100");
        let profile_file = folder.path().join("quick.toml");
        std::fs::write(&profile_file, text).unwrap();
        let profile = Profile::load(profile_file.to_str().unwrap()).unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let model = MachineModel::new(profile, "bracket", 2);
        let bender =
            SimulatedBender::start(Door::Socket(Framing::Tcp, listener), model, fault, |_| ()).unwrap();
        Shop { folder, bender }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).unwrap();
    }

    /// `benderd push TABLE --bender quick.toml --on (the simulated bender) --journal journal.db ...`
    async fn push(&self, table: &str, more: &[&str]) -> Output {
        let address = self.bender.address().to_string();
        let mut args = vec!["push", table, "--bender", "quick.toml", "--on", &address];
        if !more.contains(&"--dry-run") {
            args.extend(["--journal", "journal.db"]);
        }
        args.extend(more);
        run(self.folder.path(), &args).await
    }

    fn active(&self) -> Option<benderd::tube::CommandTable> {
        self.bender.with(|m| m.active_table())
    }

    fn untouched(&self) -> bool {
        self.bender.with(|m| m.staging_is_empty() && m.active_table().is_none())
    }
}

async fn run(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::cargo_bin("benderd").unwrap();
    command.current_dir(folder).args(args).env("XDG_STATE_HOME", folder).env_remove("STATE_DIRECTORY");
    tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap()
}

fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

fn kinds(journal: &Path) -> Vec<String> {
    let journal = benderd::journal::Journal::open(journal).unwrap();
    journal.verify().unwrap();
    journal.list(0, 100).unwrap().into_iter().map(|r| r.kind).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_table_is_applied_once_and_recognised_the_second_time() {
    let shop = Shop::open(None).await;
    let first = shop.push("bracket.csv", &[]).await;
    assert_eq!(code(&first), 0, "{}", stderr(&first));
    assert!(stdout(&first).contains("applied and read back: revision 1"), "{}", stdout(&first));
    let active = shop.active().unwrap();
    assert!((active.bends[0].angle_rad.to_degrees() - 92.1).abs() < 1e-9);
    assert!((active.last_length_mm - 100.0).abs() < 1e-9);

    let second = shop.push("bracket.csv", &[]).await;
    assert_eq!(code(&second), 0);
    assert!(stdout(&second).contains("nothing was sent: revision 1"), "{}", stdout(&second));
    assert_eq!(kinds(&shop.path("journal.db")), ["intent", "outcome", "outcome"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn every_form_of_table_gives_the_same_rows() {
    let shop = Shop::open(None).await;
    // The same tube three times: two bends of 90 degrees, CLR 50.
    shop.write("a.csv", "length_mm,rotation_deg,angle_deg,radius_mm\n100,0,90,50\n60,180,90,50\n80,0,0,\n");
    shop.write("b.csv", "y_mm,b_deg,c_deg,radius_mm\n100,0,90,50\n60,180,90,50\n80,0,0,\n");
    shop.write("c.csv", "x_mm,y_mm,z_mm,radius_mm\n0,0,0,\n150,0,0,50\n150,160,0,50\n280,160,0,\n");
    shop.write(
        "d.json",
        r#"{"verdict": "correct", "commanded": {"bends": [
            {"length_mm": 100, "rotation_deg": 0, "angle_deg": 90},
            {"length_mm": 60, "rotation_deg": 180, "angle_deg": 90}], "last_length_mm": 80},
            "springback_deg": [1, 1], "springback_sigma_deg": [1, 1], "reasons": []}"#,
    );
    let mut crcs = Vec::new();
    for table in ["a.csv", "b.csv", "c.csv", "d.json"] {
        let output = shop.push(table, &["--program", "bracket", "--json"]).await;
        assert_eq!(code(&output), 0, "{table}: {}", stderr(&output));
        let report: Value = serde_json::from_str(&stdout(&output)).unwrap();
        crcs.push((report["outcome"].as_str().unwrap().to_owned(), report["crc"].clone()));
    }
    assert_eq!(crcs[0].0, "applied");
    assert!(crcs[1..].iter().all(|c| *c == ("already_active".into(), crcs[0].1.clone())), "{crcs:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dry_run_shows_both_tables_and_writes_nothing() {
    let shop = Shop::open(None).await;
    assert_eq!(code(&shop.push("bracket.csv", &[]).await), 0);
    shop.bender.with(MachineModel::power_cycle);
    shop.write("bracket.csv", &LRA.replace("92.1", "93.25"));
    let output = shop.push("bracket.csv", &["--dry-run"]).await;
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let text = stdout(&output);
    assert!(
        text.contains("92.100") && text.contains("93.250") && text.contains("nothing was written"),
        "{text}"
    );
    assert!(shop.bender.with(|m| m.staging_is_empty()));
    assert!((shop.active().unwrap().bends[0].angle_rad.to_degrees() - 92.1).abs() < 1e-9);
    assert_eq!(kinds(&shop.path("journal.db")).len(), 2, "a dry run leaves no record");

    shop.bender.with(|m| m.set_between_parts(false));
    let refused = shop.push("bracket.csv", &["--dry-run"]).await;
    assert_eq!(code(&refused), 1);
    assert!(stderr(&refused).contains("between parts"), "{}", stderr(&refused));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bender_that_must_not_get_the_table_does_not() {
    for (fault, said) in [
        (Fault::Silent, "no answer within 300 ms"),
        (Fault::Late { ms: 600 }, "no answer within 300 ms"),
        (Fault::OtherProgram, "the machine has \"SOMETHING-ELSE\" loaded"),
        (Fault::OtherBends, "the table's bend count is 2, the loaded program's 3"),
        (Fault::Running, "\"between parts\" (bit 1) is off"),
        (Fault::Busy, "exception 6"),
    ] {
        let shop = Shop::open(Some(fault)).await;
        for more in [&[][..], &["--dry-run"]] {
            let output = shop.push("bracket.csv", more).await;
            assert_eq!(code(&output), 1, "{fault:?} {more:?}: {}", stdout(&output));
            assert!(stderr(&output).contains(said), "{fault:?} {more:?}: {}", stderr(&output));
            assert!(!stderr(&output).contains("panicked"), "{fault:?}: {}", stderr(&output));
            assert!(shop.untouched(), "{fault:?} {more:?}");
        }
        assert_eq!(kinds(&shop.path("journal.db")), ["outcome"], "{fault:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn damage_and_standstill_are_found_before_the_commit() {
    for (fault, said) in [
        (Fault::CorruptStaging, "does not read back as written"),
        (Fault::Frozen, "the heartbeat stands still"),
    ] {
        let shop = Shop::open(Some(fault)).await;
        let output = shop.push("bracket.csv", &[]).await;
        assert_eq!(code(&output), 1);
        assert!(stderr(&output).contains(said), "{fault:?}: {}", stderr(&output));
        assert_eq!(shop.active(), None);
        assert_eq!(kinds(&shop.path("journal.db")), ["outcome"]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unknown_outcome_is_said_and_decided_at_the_next_contact() {
    let shop = Shop::open(Some(Fault::SilentAfterCommit)).await;
    let output = shop.push("bracket.csv", &[]).await;
    assert_eq!(code(&output), 3, "{}", stderr(&output));
    assert!(stderr(&output).contains("not known whether it is active"), "{}", stderr(&output));
    assert!(shop.active().is_some(), "the machine had taken it");

    shop.bender.unmute();
    let again = shop.push("bracket.csv", &[]).await;
    assert_eq!(code(&again), 0, "{}", stderr(&again));
    assert!(
        stdout(&again).contains("is decided now: applied and read back: revision 1"),
        "{}",
        stdout(&again)
    );
    assert!(stdout(&again).contains("nothing was sent"), "{}", stdout(&again));
    assert_eq!(kinds(&shop.path("journal.db")), ["intent", "outcome", "resolved", "outcome"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_breaks_a_limit_is_refused_without_a_connection() {
    let shop = Shop::open(None).await;
    shop.write("bracket.csv", &LRA.replace("120,0,92.1", "9.99,0,190.001"));
    let nobody = ["push", "bracket.csv", "--bender", "quick.toml", "--on", "127.0.0.1:1"];
    let output = run(shop.folder.path(), &nobody).await;
    assert_eq!(code(&output), 1);
    let said = stderr(&output);
    assert!(said.contains("bend 1: length 9.99 mm, the machine takes 10.00 to 6000.00"), "{said}");
    assert!(said.contains("bend 1: angle 190.001 deg, the machine takes 0.000 to 190.000"), "{said}");
    assert!(shop.untouched());
}

/// An answer of `benderd correct` with one reason.

#[tokio::test(flavor = "multi_thread")]
async fn a_correction_applies_to_what_was_committed_last_or_not_at_all() {
    let shop = Shop::open(None).await;
    let first = shop.push("bracket.csv", &["--correct"]).await;
    assert_eq!(code(&first), 2);
    assert!(stderr(&first).contains("nothing that was committed"), "{}", stderr(&first));
    assert_eq!(code(&shop.push("bracket.csv", &[]).await), 0);
    shop.write("better.csv", &LRA.replace("92.1", "92.6"));
    let corrected = shop.push("better.csv", &["--correct", "--program", "bracket"]).await;
    assert_eq!(code(&corrected), 0, "{}", stderr(&corrected));
    // Somebody changes the second bend at the machine's screen.
    shop.bender.with(|m| {
        let mut payload = m.active_payload();
        let at = payload.len() - 4;
        payload[at..].copy_from_slice(&47_000_i32.to_be_bytes());
        m.edit_at_screen(payload);
    });
    shop.write("best.csv", &LRA.replace("92.1", "92.7"));
    for more in [
        &["--correct", "--program", "bracket", "--dry-run", "--journal", "journal.db"][..],
        &["--correct", "--program", "bracket"],
    ] {
        let refused = shop.push("best.csv", more).await;
        assert_eq!(code(&refused), 1, "{}", stderr(&refused));
        assert!(
            stderr(&refused).contains("bend 2: angle 46.350 deg was committed, the machine holds 47.000"),
            "{}",
            stderr(&refused)
        );
    }
    assert_eq!(code(&shop.push("best.csv", &["--program", "bracket"]).await), 0, "made anew");
}

fn answer(verdict: &str) -> String {
    format!(
        r#"{{{verdict} "commanded": {{"bends": [
            {{"length_mm": 120, "rotation_deg": 0, "angle_deg": 92.1}},
            {{"length_mm": 150, "rotation_deg": 90, "angle_deg": 46.35}}], "last_length_mm": 100}},
            "reasons": [{{"code": "outlier", "text": "bend 2 came out 3.1 deg off"}}]}}"#
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn the_verdict_of_a_correction_decides_whether_its_table_may_go() {
    let shop = Shop::open(None).await;
    for verdict in ["hold", "rescan"] {
        shop.write("bracket.json", &answer(&format!("\"verdict\": {verdict:?},")));
        for more in [&[][..], &["--dry-run"]] {
            let output = shop.push("bracket.json", more).await;
            assert_eq!(code(&output), 1, "{verdict} {more:?}: {}", stderr(&output));
            let said = stderr(&output);
            let expected =
                [&format!("the correction's verdict is {verdict}:"), "bend 2 came out 3.1 deg off"];
            assert!(expected.iter().all(|e| said.contains(*e)), "{said}");
            assert_eq!(stdout(&output), "", "nobody was asked");
        }
        let output = shop.push("bracket.json", &["--json"]).await;
        let report: Value = serde_json::from_str(&stdout(&output)).unwrap();
        assert_eq!((code(&output), report["outcome"].as_str()), (1, Some("rejected")), "{report}");
        assert_eq!(report["notes"][0], "bend 2 came out 3.1 deg off");
    }
    for verdict in ["\"verdict\": \"perhaps\",", "\"verdict\": null,", ""] {
        shop.write("bracket.json", &answer(verdict));
        let output = shop.push("bracket.json", &[]).await;
        assert_eq!(code(&output), 2, "{verdict}: {}", stderr(&output));
        assert!(stderr(&output).contains("bracket.json: not the JSON of `benderd correct"), "{verdict}");
    }
    assert!(shop.untouched() && !shop.path("journal.db").exists());

    for verdict in ["first_piece", "correct", "in_tolerance"] {
        shop.write("bracket.json", &answer(&format!("\"verdict\": {verdict:?},")));
        let output = shop.push("bracket.json", &["--json"]).await;
        assert_eq!(code(&output), 0, "{verdict}: {}", stderr(&output));
        let report: Value = serde_json::from_str(&stdout(&output)).unwrap();
        assert_eq!(report["notes"], serde_json::json!(["bend 2 came out 3.1 deg off"]));
    }
    assert!(shop.active().is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn unusable_arguments_are_exit_2_and_reach_nobody() {
    let shop = Shop::open(None).await;
    for on in ["127.0.0.1", "127.0.0.1:0", "127.0.0.1:65536", ":502", "127.0.0.1:abc", ""] {
        let output =
            run(shop.folder.path(), &["push", "bracket.csv", "--bender", "quick.toml", "--on", on]).await;
        assert_eq!(code(&output), 2, "{on}: {}", stderr(&output));
        assert!(stderr(&output).contains("host:port with a port of 1 to 65535"), "{}", stderr(&output));
    }
    for program in ["", "  ", &"x".repeat(33), "B\u{fc}gel"] {
        let output = shop.push("bracket.csv", &["--program", program]).await;
        assert_eq!(code(&output), 2, "{program}: {}", stderr(&output));
        assert!(stderr(&output).contains("allowed are 1 to 32 ASCII characters"), "{}", stderr(&output));
    }
    assert!(shop.untouched() && !shop.path("journal.db").exists());
    let longest = shop.push("bracket.csv", &["--program", &"x".repeat(32)]).await;
    assert_eq!(code(&longest), 1, "usable, but not what is loaded: {}", stderr(&longest));
}

#[tokio::test(flavor = "multi_thread")]
async fn unusable_input_is_exit_2_and_reaches_nobody() {
    let shop = Shop::open(None).await;
    shop.write("empty.csv", "");
    shop.write("text.csv", &LRA.replace("150", "abc"));
    shop.write("nan.csv", &LRA.replace("150", "NaN"));
    shop.write("wide.csv", &LRA.replace("46.35", "400"));
    shop.write("fold.csv", "x_mm,y_mm,z_mm,radius_mm\n0,0,0,\n100,0,0,50\n0,0,0,\n");
    shop.write("broken.json", "{\"commanded\": {\"bends\": [");
    shop.write("other.json", "{\"verdict\": \"correct\"}");
    shop.write("angle.json", r#"{"verdict": "correct", "commanded": {"bends": [{"length_mm": 1, "rotation_deg": 0, "angle_deg": 400}], "last_length_mm": 1}}"#);
    for (table, said) in [
        ("missing.csv", "missing.csv: cannot be read: No such file"),
        ("empty.csv", "empty.csv, line 1: header"),
        ("text.csv", "text.csv, line 3: length_mm = \"abc\""),
        ("nan.csv", "nan.csv, line 3: length_mm = \"NaN\""),
        ("wide.csv", "wide.csv, line 3: angle_deg = \"400\""),
        ("fold.csv", "fold.csv: corner 2"),
        ("broken.json", "broken.json: not the JSON of `benderd correct --json`"),
        ("other.json", "missing field `commanded`"),
        ("angle.json", "angle.json: row 1: angle_deg is 400"),
    ] {
        let output = shop.push(table, &["--program", "bracket"]).await;
        assert_eq!(code(&output), 2, "{table}: {}", stderr(&output));
        assert!(stderr(&output).contains(said), "{table}: {}", stderr(&output));
        assert_eq!(stderr(&output).matches("cannot be read").count(), usize::from(table == "missing.csv"));
    }
    assert!(shop.untouched());
}

#[tokio::test(flavor = "multi_thread")]
async fn profile_and_journal_must_be_usable_before_anything_is_sent() {
    let shop = Shop::open(None).await;
    let address = shop.bender.address().to_string();
    let push = async |profile: &str, journal: &str| {
        let args = ["push", "bracket.csv", "--bender", profile, "--on", &address, "--journal", journal];
        run(shop.folder.path(), &args).await
    };
    let output = push("quick", "journal.db").await;
    assert_eq!(code(&output), 2);
    assert!(stderr(&output).contains("shipped: reference-modbus"), "{}", stderr(&output));

    shop.write(
        "bad.toml",
        &std::fs::read_to_string(shop.path("quick.toml")).unwrap().replace("unit_id = 1", "unit_id = 999"),
    );
    let output = push("bad.toml", "journal.db").await;
    assert_eq!(code(&output), 2);
    assert!(stderr(&output).contains("bad.toml, line"), "{}", stderr(&output));

    shop.write("notes.txt", "these are notes and not a database, long enough to look like something else");
    for journal in ["notes.txt", "no/such/folder/journal.db"] {
        let output = push("quick.toml", journal).await;
        assert_eq!(code(&output), 2, "{journal}");
        assert!(stderr(&output).contains(journal), "{}", stderr(&output));
    }
    assert!(shop.untouched());
}

/// As the contracts print it: `--on ./line`.
#[tokio::test(flavor = "multi_thread")]
async fn a_path_begins_where_the_command_is_given() {
    for (bender, on) in
        [("reference-rtu", "./line"), ("reference-serial", "line"), ("reference-folder", "folder")]
    {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("folder")).unwrap();
        std::fs::write(folder.path().join("bracket.csv"), LRA).unwrap();
        let profile = Profile::load(bender).unwrap();
        let place = folder.path().join(on).display().to_string();
        let (door, _kept) = Door::open(&profile, &place).await.unwrap();
        let _machine =
            SimulatedBender::start(door, MachineModel::new(profile, "bracket", 2), None, |_| ()).unwrap();
        let args = ["push", "bracket.csv", "--bender", bender, "--on", on, "--journal", "journal.db"];
        let output = run(folder.path(), &args).await;
        assert_eq!(code(&output), 0, "{bender}: {}", stderr(&output));
        assert!(stdout(&output).contains("applied"), "{bender}: {}", stdout(&output));
    }
    // What is no path stays as it is.
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("bracket.csv"), LRA).unwrap();
    for (bender, on) in [("reference-can", "./can0"), ("reference-modbus", "./line")] {
        let output = run(folder.path(), &["push", "bracket.csv", "--bender", bender, "--on", on]).await;
        assert_eq!(code(&output), 2);
        assert!(stderr(&output).contains(&format!("--on {on}: allowed is ")), "{}", stderr(&output));
    }
}

/// A read that never ends in one of its threads kept the program for ever, after it had said all.
#[test]
fn a_share_that_hangs_does_not_keep_it_from_ending() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("bracket.csv"), LRA).unwrap();
    let text = include_str!("../protocols/reference-folder.toml")
        .replace("transfer_ms = 10000", "transfer_ms = 3000")
        .replace("connect_ms = 2000", "connect_ms = 500");
    std::fs::write(at("quick.toml"), text).unwrap();
    let share = at("share");
    std::fs::create_dir(&share).unwrap();
    let (command, answer) = (share.join("bender1.cmd"), share.join("bender1.ans"));
    let over = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let told = over.clone();
    // The answer is a pipe that nobody writes to.
    let machine = std::thread::spawn(move || {
        while !command.exists() && !told.load(std::sync::atomic::Ordering::Relaxed) {
            std::thread::yield_now();
        }
        std::process::Command::new("mkfifo").arg(&answer).status().unwrap().success()
    });
    let output = Command::cargo_bin("benderd")
        .unwrap()
        .current_dir(folder.path())
        .args(["push", "bracket.csv", "--bender", "quick.toml", "--on", "share", "--journal", "journal.db"])
        .timeout(std::time::Duration::from_secs(60))
        .output()
        .unwrap();
    over.store(true, std::sync::atomic::Ordering::Relaxed);
    assert!(machine.join().unwrap());
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert!(stderr(&output).contains("no answer"), "{}", stderr(&output));
    assert_eq!(kinds(&at("journal.db")), ["outcome"], "the record is whole");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_journal_has_its_place_without_being_told() {
    let shop = Shop::open(None).await;
    let address = shop.bender.address().to_string();
    let args = ["push", "bracket.csv", "--bender", "quick.toml", "--on", &address];
    assert_eq!(code(&run(shop.folder.path(), &args).await), 0);
    assert_eq!(kinds(&shop.path("benderd/journal.db")), ["intent", "outcome"]);
}
