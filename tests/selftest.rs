//! `benderd selftest` as a fitter runs it, against a simulated bender: healthy, and wrong in several ways, each with its advice.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::path::Path;
use std::process::Output;

use assert_cmd::Command;
use benderd::bender::Profile;
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;
use benderd::sim::faults::Fault;
use benderd::sim::pty::Kept;
use serde_json::Value;

const REFERENCE: &str = include_str!("../protocols/reference-modbus.toml");

/// A machine of a shipped profile with a table in force; what must live as long as it.
async fn machine(profile: &str, on: &str, fault: Option<Fault>) -> (SimulatedBender, Option<Kept>) {
    let profile = Profile::load(profile).unwrap();
    let (door, kept) = Door::open(&profile, on).await.unwrap();
    let mut model = MachineModel::new(profile, "P1", 3);
    model.operator_edits();
    (SimulatedBender::start(door, model, fault, |_| ()).unwrap(), kept)
}

async fn on_socket(fault: Option<Fault>) -> SimulatedBender {
    machine("reference-modbus", "127.0.0.1:0", fault).await.0
}

async fn selftest(bender: &str, on: &str, more: &[&str]) -> Output {
    let mut command = Command::cargo_bin("benderd").unwrap();
    command.args(["selftest", "--bender", bender, "--on", on]).args(more);
    tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap()
}

fn said(output: &Output, code: i32) -> String {
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    let err = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{text}{err}");
    text
}

/// The reference profile, changed, as a file.
fn changed(folder: &Path, changes: &[(&str, &str)]) -> String {
    let mut text = REFERENCE.to_owned();
    for (from, to) in changes {
        assert!(text.contains(from), "the shipped profile no longer contains {from:?}");
        text = text.replacen(from, to, 1);
    }
    let file = folder.join("changed.toml");
    std::fs::write(&file, text).unwrap();
    file.display().to_string()
}

/// The reference profile with all addresses moved, as a file.
fn moved(folder: &Path, by: u16) -> String {
    let (before, rest) = REFERENCE.split_once("[registers]").unwrap();
    let (registers, after) = rest.split_once("[constants]").unwrap();
    let line = |line: &str| match line.split_once(" = ") {
        Some((key, value)) => {
            let number: u16 = value.split_whitespace().next().unwrap().parse().unwrap();
            format!("{key} = {}\n", number + by)
        }
        None => format!("{line}\n"),
    };
    let registers: String = registers.lines().map(line).collect();
    let file = folder.join("moved.toml");
    std::fs::write(&file, format!("{before}[registers]{registers}[constants]{after}")).unwrap();
    file.display().to_string()
}

/// The lines of a step and its advice.
fn step(text: &str, name: &str) -> String {
    let mut lines = text.lines().skip_while(|line| line.get(9..).is_none_or(|rest| !rest.starts_with(name)));
    let first = lines.next().unwrap_or_else(|| panic!("no step {name:?} in {text}"));
    let more = lines.take_while(|line| line.starts_with(' '));
    [first].into_iter().chain(more).collect::<Vec<_>>().join("\n")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_healthy_machine_passes_and_nothing_is_written() {
    let bender = on_socket(None).await;
    let text = said(&selftest("reference-modbus", bender.address(), &[]).await, 0);
    assert!(!text.contains("FAILED"), "{text}");
    for (name, found) in [
        ("profile", "status in one read of 36 registers"),
        ("first answer", "20 more: median"),
        ("identification", "0x42454E44 and layout 1"),
        ("heartbeat", "beats in"),
        ("state bit", "\"automatic mode\" (bit 0) is on, must be on"),
        ("program", "\"P1\" with 3 bends is loaded"),
        ("active table", "3 bends for program \"P1\", CRC is right, within the profile's limits"),
        ("largest request", "124 registers in one read"),
        ("staging area", "528 bytes read"),
        ("write staging", "not asked for"),
        ("times", "a delivery of 40 bends will take about"),
    ] {
        assert!(step(&text, name).contains(found), "{name}: {text}");
    }
    assert!(bender.with(|m| m.staging_is_empty() && m.active().revision == 1));
}

#[tokio::test(flavor = "multi_thread")]
async fn staging_is_written_read_back_and_cleared_over_every_transport() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line").display().to_string();
    for (profile, on) in [
        ("reference-modbus", "127.0.0.1:0"),
        ("reference-rtu-over-tcp", "127.0.0.1:0"),
        ("reference-rtu", line.as_str()),
        ("reference-serial", line.as_str()),
        ("reference-folder", folder.path().to_str().unwrap()),
    ] {
        let (bender, _kept) = machine(profile, on, None).await;
        let output = selftest(profile, bender.address(), &["--write-staging", "--json", "--frames"]).await;
        let report: Value = serde_json::from_str(&said(&output, 0)).unwrap();
        assert_eq!(report["passed"], true, "{profile}");
        let steps = report["steps"].as_array().unwrap();
        let of = |name: &str| steps.iter().find(|s| s["step"] == name).unwrap();
        assert!(of("write staging")["found"].as_str().unwrap().contains("cleared to zeros"), "{profile}");
        assert!(of("times")["figures"]["delivery_ms"].as_f64().unwrap() > 0.0, "{profile}");
        let frames = report["frames"].as_array().unwrap();
        let goes = |way: &str| frames.iter().any(|line| line.as_str().unwrap().contains(way));
        assert!(goes(" s > ") && goes(" s < "), "{profile}: {frames:?}");
        assert!(bender.with(|m| m.staging_is_empty() && m.active().revision == 1), "{profile}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_word_order_address_base_or_unit_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let bender = on_socket(None).await;
    let advice = async |profile: String| {
        let text = said(&selftest(&profile, bender.address(), &["--frames"]).await, 1);
        assert!(step(&text, "times").contains("skipped"), "{text}");
        assert!(text.contains("last frames"), "{text}");
        step(&text, "identification")
    };
    let order = advice(changed(folder.path(), &[("\"abcd\"", "\"cdab\"")])).await;
    assert!(order.contains("register 0 holds 0x4E444245"), "{order}");
    assert!(order.contains("set word_order = \"abcd\" in [modbus]"), "{order}");
    let base = advice(moved(folder.path(), 1)).await;
    assert!(base.contains("Illegal data address"), "{base}");
    assert!(base.contains("counted from 1 in this profile: subtract 1 from every address"), "{base}");
    let unit = advice(changed(folder.path(), &[("unit_id = 1", "unit_id = 7")])).await;
    assert!(unit.contains("answers as unit 1: set unit_id = 1"), "{unit}");
    let foreign = advice(changed(folder.path(), &[("0x42454E44", "0x12345678")])).await;
    assert!(foreign.contains("registers.identification = 0"), "{foreign}");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_at_the_machine_says_what_to_do() {
    let frozen = on_socket(Some(Fault::Frozen)).await;
    let text = said(&selftest("reference-modbus", frozen.address(), &[]).await, 1);
    let beat = step(&text, "heartbeat");
    assert!(beat.contains("stands still") && beat.contains("start the controller's program (RUN)"), "{text}");

    let running = on_socket(Some(Fault::Running)).await;
    let text = said(&selftest("reference-modbus", running.address(), &[]).await, 1);
    assert!(text.contains("\"between parts\" (bit 1) is off, must be on"), "{text}");
    assert!(text.contains("bring the machine to where \"between parts\" is on"), "{text}");

    let corrupt = on_socket(Some(Fault::CorruptStaging)).await;
    let text = said(&selftest("reference-modbus", corrupt.address(), &["--write-staging"]).await, 1);
    let write = step(&text, "write staging");
    assert!(write.contains("written was 0x") && write.contains("something else writes there"), "{text}");

    let silent = on_socket(Some(Fault::Silent)).await;
    let folder = tempfile::tempdir().unwrap();
    let hasty = changed(folder.path(), &[("request_ms = 1000", "request_ms = 50")]);
    let text = said(&selftest(&hasty, silent.address(), &[]).await, 1);
    let first = step(&text, "first answer");
    assert!(
        first.contains("no answer within 50 ms") && first.contains("is unit_id = 1 its number"),
        "{text}"
    );

    let late = on_socket(Some(Fault::Late { ms: 150 })).await;
    let hasty = changed(folder.path(), &[("request_ms = 1000", "request_ms = 250")]);
    let text = said(&selftest(&hasty, late.address(), &[]).await, 1);
    let times = step(&text, "times");
    assert!(times.contains("too near to the limit: set deadlines.request_ms = "), "{text}");
}

/// It advised another word order and to compare the registers.
#[tokio::test(flavor = "multi_thread")]
async fn a_busy_machine_is_waited_for_over_every_transport() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line").display().to_string();
    for (profile, on) in [
        ("reference-modbus", "127.0.0.1:0"),
        ("ten-row", "127.0.0.1:0"),
        ("reference-serial", line.as_str()),
        ("reference-folder", folder.path().to_str().unwrap()),
    ] {
        let (busy, _kept) = machine(profile, on, Some(Fault::Busy)).await;
        let text = said(&selftest(profile, busy.address(), &[]).await, 1);
        let first = step(&text, "first answer");
        assert!(first.contains("was busy at") && first.contains("wait and try again"), "{profile}: {text}");
        assert!(step(&text, "identification").starts_with("skipped"), "{profile}: {text}");
        assert!(!text.contains("word order") && !text.contains("unit_id"), "{profile}: {text}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_opened_says_why() {
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let text = said(&selftest("reference-modbus", &free, &[]).await, 1);
    let refused = step(&text, "endpoint");
    assert!(refused.contains("connection refused") && refused.contains("nothing listens on port"), "{text}");
    let text = said(&selftest("reference-rtu", "/dev/no-such-port", &[]).await, 1);
    assert!(step(&text, "endpoint").contains("plug the adapter in, or correct `endpoint`"), "{text}");
    let text = said(&selftest("reference-folder", "/no/such/folder", &[]).await, 1);
    assert!(step(&text, "endpoint").contains("mount the share"), "{text}");
    // It advised to set a bit rate on an interface of Ethernet.
    let text = said(&selftest("reference-can", "lo", &[]).await, 1);
    let endpoint = step(&text, "endpoint");
    assert!(endpoint.contains("CAN interfaces of this computer: "), "{text}");
    assert!(endpoint.contains("no CAN interface") || endpoint.contains("modprobe can_raw"), "{text}");
    assert!(!endpoint.contains("bitrate"), "{text}");

    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line").display().to_string();
    let (_bender, _kept) = machine("reference-rtu", &line, None).await;
    let profile = Profile::load("reference-rtu").unwrap();
    let _other = benderd::bender::serial_port(&line, profile.transport.serial().unwrap()).unwrap();
    let text = said(&selftest("reference-rtu", &line, &[]).await, 1);
    let busy = step(&text, "endpoint");
    assert!(busy.contains("another program has it open"), "{text}");
    assert!(busy.contains(&format!("(process {})", std::process::id())), "{text}");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_used_is_status_2() {
    let output = selftest("no-such-bender", "127.0.0.1:502", &[]).await;
    assert_eq!(output.status.code(), Some(2));
    let output = selftest("reference-modbus", "/dev/ttyS0", &[]).await;
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("allowed is host:port"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_machine_without_a_staging_area_is_only_read() {
    let profile = Profile::load("ten-row").unwrap();
    let (door, _) = Door::open(&profile, "127.0.0.1:0").await.unwrap();
    let bender = SimulatedBender::start(door, MachineModel::new(profile, "", 0), None, |_| ()).unwrap();
    let text = said(&selftest("ten-row", bender.address(), &["--write-staging"]).await, 0);
    assert!(step(&text, "heartbeat").starts_with("skipped"), "{text}");
    assert!(step(&text, "write staging").contains("what is written is in force"), "{text}");
    assert!(step(&text, "active table").contains("its rows are all 0"), "{text}");
    assert!(bender.with(|m| m.active_payload()).is_empty(), "nothing was written");
}

/// It read the rows first and failed at 3523, with "compare identification and layout".
#[tokio::test(flavor = "multi_thread")]
async fn a_machine_with_a_staging_area_where_none_is_expected_says_which_registers_to_compare() {
    let bender = on_socket(None).await;
    let text = said(&selftest("ten-row", bender.address(), &[]).await, 1);
    let found = step(&text, "identification");
    assert!(found.contains("refused reading registers 2520 to 2520: Illegal data address"), "{text}");
    assert!(found.contains("identification = 2520, length = 3523 to 3532"), "{text}");
    assert!(found.contains("state_coils = 3073 to 3074") && found.contains("another profile"), "{text}");

    let other_die = changed_ten_row("identification = 60", "identification = 76").await;
    assert!(other_die.contains("register 2520 holds 60") && other_die.contains("another die"), "{other_die}");
    assert!(other_die.contains("compare constants.identification = 76"), "{other_die}");
}

/// What the self-test says of the identification with a changed profile.
async fn changed_ten_row(from: &str, to: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("changed.toml").display().to_string();
    let text = include_str!("../protocols/ten-row.toml");
    assert!(text.contains(from), "the shipped profile no longer contains {from:?}");
    std::fs::write(&file, text.replacen(from, to, 1)).unwrap();
    let profile = Profile::load("ten-row").unwrap();
    let (door, _) = Door::open(&profile, "127.0.0.1:0").await.unwrap();
    let bender = SimulatedBender::start(door, MachineModel::new(profile, "", 0), None, |_| ()).unwrap();
    step(&said(&selftest(&file, bender.address(), &[]).await, 1), "identification")
}
