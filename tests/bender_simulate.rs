//! `benderd simulate bender` as a user starts and stops it.

use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};

use benderd::bender::Profile;
use benderd::sim::bender::MachineModel;
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;

fn benderd() -> Command {
    Command::new(assert_cmd::cargo::cargo_bin!("benderd"))
}

#[test]
fn it_says_where_it_listens_logs_commits_and_stops_on_sigterm() {
    let folder = tempfile::tempdir().unwrap();
    let table = folder.path().join("p1.csv");
    std::fs::write(&table, "y_mm,b_deg,c_deg,radius_mm\n100,0,90,50\n50,0,0,\n").unwrap();
    let mut bender = benderd()
        .args(["simulate", "bender", "--on", "127.0.0.1:0", "--program", "p1", "--bends", "1"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(bender.stdout.take().unwrap()).lines().map(Result::unwrap);
    let first = said.next().unwrap();
    let address = first.split("listens on ").nth(1).unwrap().split(';').next().unwrap();
    let push = benderd()
        .args(["push", table.to_str().unwrap(), "--bender", "reference-modbus", "--on", address, "--journal"])
        .arg(folder.path().join("journal.db"))
        .output()
        .unwrap();
    assert!(push.status.success(), "{}", String::from_utf8_lossy(&push.stderr));
    let commit = said.next().unwrap();
    assert!(commit.starts_with("table taken over: revision 1, CRC "), "{commit}");
    assert!(commit.ends_with("program \"p1\", 1 bends"), "{commit}");
    let killed = Command::new("kill").arg(bender.id().to_string()).status().unwrap();
    assert!(killed.success());
    assert_eq!(said.next().unwrap(), "stopped");
    assert!(bender.wait().unwrap().success());
}

/// It said "cannot listen: No such file or directory" and "invalid port value", and nothing of what there may be instead.
#[test]
fn where_it_cannot_listen_it_says_what_is_allowed() {
    let folder = tempfile::tempdir().unwrap();
    for (profile, on, said) in [
        ("reference-rtu", "/no/such/folder/line", "--on ./line"),
        ("reference-serial", "/no/such/folder/line", "--on ./line"),
        ("reference-modbus", "127.0.0.1:99999", "a port of 0 (a free one is taken) to 65535"),
        ("reference-folder", "nowhere", "a folder that is there"),
        ("reference-can", "nocan7", "a CAN interface that is up"),
    ] {
        let args = ["simulate", "bender", "--profile", profile, "--on", on];
        let output = benderd().current_dir(folder.path()).args(args).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{profile}: {text}");
        assert!(text.contains(&format!("--on {on}: cannot listen: ")) && text.contains(said), "{text}");
    }
}

#[test]
fn what_a_script_says_is_printed_when_it_happens() {
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("faults.toml");
    let event = |text: &str| format!("[[event]]\n{text}\n");
    let events = event("at_answer = 1\nwhat = \"late\"\nlate_ms = 5") + &event("at_ms = 0\nwhat = \"edit\"");
    std::fs::write(&script, format!("version = 1\n{events}")).unwrap();
    let mut bender = benderd()
        .args(["simulate", "bender", "--on", "127.0.0.1:0", "--script", script.to_str().unwrap()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(bender.stdout.take().unwrap()).lines().map(Result::unwrap);
    // The first may come before the machine has said where it listens.
    let (two, edited): (Vec<String>, _) =
        (said.by_ref().take(2).collect(), "trouble at 0 ms: another table entered");
    assert!(two.iter().any(|line| line.starts_with(edited)), "{two:?}");
    let listens = two.iter().find(|line| line.contains("listens on")).unwrap();
    let address = listens.split("listens on ").nth(1).unwrap().split(';').next().unwrap();
    let test =
        benderd().args(["selftest", "--bender", "reference-modbus", "--on", address]).output().unwrap();
    assert!(test.status.success(), "{}", String::from_utf8_lossy(&test.stdout));
    assert_eq!(said.next().unwrap(), "trouble at answer 1: 5 ms late");
    assert!(Command::new("kill").arg(bender.id().to_string()).status().unwrap().success());
    assert!(bender.wait().unwrap().success());
}

#[test]
fn push_goes_on_when_nobody_reads_what_it_says() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let profile = Profile::load("reference-modbus").unwrap();
    let bender = runtime.block_on(async {
        let (door, _) = Door::open(&profile, "127.0.0.1:0").await.unwrap();
        SimulatedBender::start(door, MachineModel::new(profile, "p1", 1), None, |_| ()).unwrap()
    });
    let folder = tempfile::tempdir().unwrap();
    let table = folder.path().join("p1.csv");
    std::fs::write(&table, "y_mm,b_deg,c_deg,radius_mm\n100,0,90,50\n50,0,0,\n").unwrap();
    let mut push = benderd()
        .args(["push", table.to_str().unwrap(), "--bender", "reference-modbus", "--journal"])
        .arg(folder.path().join("journal.db"))
        .args(["--on", bender.address()])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop((push.stdout.take(), push.stderr.take()));
    assert_eq!(push.wait().unwrap().code(), Some(0));
    assert!(bender.with(|m| m.active_table()).is_some());
}

#[test]
fn what_cannot_be_simulated_is_one_clear_error() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    for (args, said) in [
        (["--on", &address], "cannot listen"),
        (["--fault", "sulking"], "unknown fault \"sulking\", known are silent, late:MS"),
        (["--script", "no-such-file.toml"], "no-such-file.toml: cannot be read"),
        (["--per-mille", "5"], "--seed"),
        (["--fault", "late:soon"], "milliseconds must be a whole number"),
        (["--bends", "41"], "--bends 41: profile reference-modbus has room for 40"),
        (["--program", "Bügel"], "allowed are 1 to 32 ASCII characters"),
        (["--profile", "nothing-like-it"], "shipped: reference-modbus"),
    ] {
        let output = benderd().args(["simulate", "bender"]).args(args).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {stderr}");
        assert!(stderr.contains(said), "{args:?}: {stderr}");
    }
}
