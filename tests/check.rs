//! `benderd check` says no where `benderd run` would, and leaves nothing behind.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::path::Path;

use assert_cmd::Command;

/// A configuration in `dir` of one cell per (address, scan folder).
fn write_config(dir: &Path, state_dir: &str, cells: &[(&str, &str)]) {
    let part = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/parts/bracket-17.toml");
    let mut text = format!("version = 1\nstate_dir = {state_dir:?}\n");
    for (i, (address, folder)) in cells.iter().enumerate() {
        let profile = if address.starts_with('/') { "reference-rtu" } else { "reference-modbus" };
        text += &format!(
            "[[cell]]\nname = \"b{}\"\nmode = \"observe\"\npart = {part:?}\nprofile = {profile:?}\n\
             address = {address:?}\n[cell.scan]\nfolder = {folder:?}\n",
            i + 1
        );
    }
    std::fs::write(dir.join("benderd.toml"), text).unwrap();
}

fn benderd(dir: &Path, args: &[&str]) -> (i32, String) {
    let output = Command::cargo_bin("benderd").unwrap().current_dir(dir).args(args).output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

/// Both refuse, for the same reason.
fn refused(dir: &Path, said: &str) {
    for args in [&["check", "benderd.toml"][..], &["run", "--config", "benderd.toml"]] {
        let (code, err) = benderd(dir, args);
        assert!(code == 2 && err.contains(said), "{args:?}: exit {code}, {err}\nshould say {said}");
    }
}

#[test]
fn one_machine_written_in_two_ways_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    for (one, other) in [
        ("127.0.0.1:502", "127.0.0.1:502"),
        ("127.0.0.1:502", "127.0.0.1:0502"),
        ("no-such-bender.invalid:502", "No-Such-Bender.INVALID:502"),
        ("127.0.0.1:502", "localhost:502"),
        ("127.0.0.1:502", "[::ffff:127.0.0.1]:502"),
    ] {
        write_config(dir.path(), "state", &[(one, "s1"), (other, "s2")]);
        refused(dir.path(), &format!("cell b2 address = {other:?}"));
    }
    write_config(dir.path(), "state", &[("127.0.0.1:502", "s1"), ("127.0.0.1:503", "s2")]);
    assert_eq!(benderd(dir.path(), &["check", "benderd.toml"]), (0, String::new()));
}

#[test]
fn one_folder_written_in_two_ways_and_folders_in_each_other_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(dir.path().join("real")).unwrap();
    std::os::unix::fs::symlink("real", dir.path().join("link")).unwrap();
    for (one, other) in [
        ("real", "link"),
        ("real/new", "link/new"),
        ("real", "missing/../link"),
        ("real", "real/../real/."),
        ("real", "link/done"),
        ("real/b1/deep", "real/b1"),
    ] {
        write_config(dir.path(), "state", &[("127.0.0.1:502", one), ("127.0.0.1:503", other)]);
        refused(dir.path(), "cell b2 scan.folder = ");
    }
    for state_dir in ["link", "real/failed"] {
        write_config(dir.path(), state_dir, &[("127.0.0.1:502", "real")]);
        refused(dir.path(), "cell b1 scan.folder = ");
    }
    // Neighbours whose names begin alike, within the state folder as the shipped configuration has them.
    let cells = [("127.0.0.1:502", "state/s1"), ("127.0.0.1:503", "state/s11")];
    write_config(dir.path(), "state", &cells);
    assert_eq!(benderd(dir.path(), &["check", "benderd.toml"]), (0, String::new()));
    assert!(!dir.path().join("state").exists(), "a check makes nothing");
}

#[test]
fn a_folder_that_cannot_be_used_is_refused_by_the_check_already() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(dir.path().join("scans")).unwrap();
    std::fs::write(dir.path().join("file"), "").unwrap();
    std::fs::write(dir.path().join("scans/done"), "").unwrap();
    std::os::unix::fs::symlink("nowhere", dir.path().join("dangling")).unwrap();
    // Not even root may write to /proc.
    for (state_dir, folder, key) in [
        ("file", "s", "state_dir = file"),
        ("file/state", "s", "state_dir = file/state"),
        ("/proc/benderd", "s", "state_dir = /proc/benderd"),
        ("state", "file", "cell b1 scan.folder = file"),
        ("state", "dangling", "cell b1 scan.folder = dangling"),
        ("state", "scans", "cell b1 scan.folder = scans/done"),
        ("state", "/proc/scans", "cell b1 scan.folder = /proc/scans"),
    ] {
        write_config(dir.path(), state_dir, &[("127.0.0.1:502", folder)]);
        refused(dir.path(), key);
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 4, "three of ours and the configuration");
}

#[test]
fn one_serial_port_under_two_names_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let [port, link, other] = ["port", "by-id", "other"].map(|n| dir.path().join(n).display().to_string());
    std::fs::write(&port, "").unwrap();
    std::os::unix::fs::symlink(&port, &link).unwrap();
    write_config(dir.path(), "state", &[(&port, "s1"), (&link, "s2")]);
    refused(dir.path(), &format!("cell b2 address = {link:?}"));
    write_config(dir.path(), "state", &[(&port, "s1"), (&other, "s2")]);
    assert_eq!(benderd(dir.path(), &["check", "benderd.toml"]), (0, String::new()));
}

#[test]
fn a_bus_and_a_folder_are_shared_by_machines_that_take_nothing_of_each_other() {
    let dir = tempfile::tempdir().unwrap();
    let profiles = Path::new(env!("CARGO_MANIFEST_DIR")).join("protocols");
    let other = |name: &str, from: &str, to: &str| {
        let text = std::fs::read_to_string(profiles.join(name)).unwrap();
        assert!(text.contains(from), "{name} has no {from}");
        let file = dir.path().join(format!("other-{name}"));
        std::fs::write(&file, text.replacen(from, to, 1)).unwrap();
        file.display().to_string()
    };
    let folder = dir.path().join("benders").display().to_string();
    let second = other("reference-folder.toml", "unit_id = 1 ", "unit_id = 2 ");
    let node = other("reference-canopen.toml", "node = 5 ", "node = 6 ");
    // 1440 is 5A0h: what node 32 answers with.
    let dbc = std::fs::read_to_string(profiles.join("bender.dbc")).unwrap();
    std::fs::write(dir.path().join("moved.dbc"), dbc.replace("BO_ 800 ", "BO_ 1440 ")).unwrap();
    let moved = other("reference-can.toml", "dbc = \"bender.dbc\"", "dbc = \"moved.dbc\"");
    let node_32 = other("reference-canopen.toml", "node = 5 ", "node = 32");
    let configure = |cells: [(&str, &str); 2]| {
        write_config(dir.path(), "state", &[(cells[0].0, "s1"), (cells[1].0, "s2")]);
        let file = dir.path().join("benderd.toml");
        let mut text = std::fs::read_to_string(&file).unwrap();
        for (_, profile) in cells {
            let ours = ["profile = \"reference-rtu\"", "profile = \"reference-modbus\""];
            let (at, ours) = ours.iter().filter_map(|p| Some((text.find(p)?, p))).min().unwrap();
            text.replace_range(at..at + ours.len(), &format!("profile={profile:?}"));
        }
        std::fs::write(&file, text).unwrap();
    };
    for cells in [
        [(folder.as_str(), "reference-folder"), (&folder, &second)],
        [("can0", "reference-canopen"), ("can0", &node)],
        [("can0", "reference-canopen"), ("can0", "reference-can")],
        [("can0", "reference-can"), ("can1", "reference-can")],
        [("can0", "reference-can"), ("can0", &node_32)],
    ] {
        configure(cells);
        assert_eq!(benderd(dir.path(), &["check", "benderd.toml"]), (0, String::new()), "{cells:?}");
    }
    for cells in [
        [(folder.as_str(), "reference-folder"), (&folder, "reference-folder")],
        [("can0", "reference-canopen"), ("can0", "reference-canopen")],
        [("can0", "reference-can"), ("can0", "reference-can")],
        [("can0", &moved), ("can0", &node_32)],
    ] {
        configure(cells);
        refused(dir.path(), &format!("cell b2 address = {:?}", cells[1].0));
    }
}

#[test]
fn an_address_that_the_machines_link_has_no_use_for_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    write_config(dir.path(), "state", &[("/dev/ttyUSB0", "s1")]);
    let file = dir.path().join("benderd.toml");
    let text = std::fs::read_to_string(&file).unwrap().replace("reference-rtu", "reference-modbus");
    std::fs::write(&file, text).unwrap();
    refused(
        dir.path(),
        "cell b1 address = \"/dev/ttyUSB0\", allowed for profile reference-modbus is host:port",
    );
}

#[test]
fn a_profiles_requests_are_printed() {
    for profile in ["reference-modbus", "reference-rtu", "ten-row"] {
        let output =
            Command::cargo_bin("benderd").unwrap().args(["check", "--plan", profile]).output().unwrap();
        assert_eq!(output.status.code(), Some(0));
        insta::assert_snapshot!(profile, String::from_utf8(output.stdout).unwrap());
    }
    let dir = tempfile::tempdir().unwrap();
    let (code, err) = benderd(dir.path(), &["check", "--plan", "no-such-machine"]);
    assert!(code == 2 && err.contains("reference-rtu"), "{err}");
    let (code, err) = benderd(dir.path(), &["check"]);
    assert!(code == 2 && err.contains("--plan"), "{err}");
}

#[test]
fn every_shipped_profile_has_a_plan_that_says_how_a_table_gets_there() {
    for profile in benderd::bender::shipped_profiles() {
        let output =
            Command::cargo_bin("benderd").unwrap().args(["check", "--plan", profile]).output().unwrap();
        assert_eq!(output.status.code(), Some(0));
        let text = String::from_utf8(output.stdout).unwrap();
        let says = match profile {
            "ten-row" => "every write needs the operator's approval",
            "reference-can" => "132 times 320 TABLE_ITEM",
            "reference-canopen" => "download of 528 bytes to object 2001:00, in blocks",
            "reference-serial" => "5 frames W",
            "reference-folder" => "bender1.tab, bender1.cmd (stage), bender1.ans",
            _ => "commit, once",
        };
        assert!(text.contains(says), "{profile}: {text}");
    }
}
