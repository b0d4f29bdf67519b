//! The unit files as systemd itself sees them. Skipped, saying so, where systemd's tools are missing.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // clippy does not count the helpers of an integration test as test code

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn unit_file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(name)
}

/// Runs one of systemd's tools; None when it is not installed.
fn tool(name: &str, args: &[&str]) -> Option<Output> {
    match Command::new(name).args(args).env("SYSTEMD_COLORS", "0").output() {
        Ok(output) => Some(output),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            println!("skipped: {name} is not installed here");
            None
        }
        Err(error) => panic!("{name}: {error}"),
    }
}

fn printed(output: &Output) -> String {
    let text = [&output.stdout[..], &output.stderr[..]].concat();
    String::from_utf8_lossy(&text).trim().to_owned()
}

/// The unit in a folder of its own, with this build's binary in place of the installed one: `verify` wants to see
/// that the program exists.
fn unit_for_this_build(dir: &Path) -> String {
    let text = std::fs::read_to_string(unit_file("benderd.service")).unwrap();
    let text = text.replace("/usr/bin/benderd", env!("CARGO_BIN_EXE_benderd"));
    let path = dir.join("benderd.service");
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn the_unit_verifies_without_a_word() {
    let dir = tempfile::tempdir().unwrap();
    let unit = unit_for_this_build(dir.path());
    // Its exit status is 0 even for a key it does not know: only silence counts.
    let Some(output) = tool("systemd-analyze", &["verify", "--man=no", &unit]) else { return };
    assert_eq!((printed(&output), output.status.code()), (String::new(), Some(0)));
}

/// The drop-in for serial ports beside it.
fn with_serial_ports(dir: &Path) {
    let folder = dir.join("benderd.service.d");
    std::fs::create_dir(&folder).unwrap();
    std::fs::copy(unit_file("serial.conf"), folder.join("serial.conf")).unwrap();
}

#[test]
fn with_serial_ports_the_unit_verifies_without_a_word_too() {
    let dir = tempfile::tempdir().unwrap();
    let unit = unit_for_this_build(dir.path());
    with_serial_ports(dir.path());
    let Some(output) = tool("systemd-analyze", &["verify", "--man=no", &unit]) else { return };
    assert_eq!((printed(&output), output.status.code()), (String::new(), Some(0)));
    // The drop-in is read: nonsense in it is complained about.
    let drop_in = dir.path().join("benderd.service.d/serial.conf");
    std::fs::write(&drop_in, "[Service]\nDeviceAlow=char-ttyUSB rw\n").unwrap();
    let output = tool("systemd-analyze", &["verify", "--man=no", &unit]).unwrap();
    assert!(printed(&output).contains("DeviceAlow"), "{}", printed(&output));
}

#[test]
fn the_rule_gives_one_port_to_the_daemon() {
    let text = std::fs::read_to_string(unit_file("60-benderd.rules")).unwrap();
    let rules: Vec<&str> = text.lines().filter(|l| !l.starts_with('#') && !l.is_empty()).collect();
    assert_eq!(rules.len(), 1);
    let profile = benderd::bender::Profile::load("reference-rtu").unwrap();
    let name = profile.endpoint.strip_prefix("/dev/").unwrap();
    assert!(rules[0].contains(&format!("SYMLINK+=\"{name}\"")), "the shipped profile's name: {name}");
    assert!(rules[0].contains("GROUP=\"benderd\""), "the unit's group");
}

#[test]
fn the_unit_is_exposed_by_one_and_a_half_at_most() {
    let unit = unit_file("benderd.service").display().to_string();
    let args = ["security", "--offline=yes", "--no-pager", "--threshold=15", &unit];
    let Some(output) = tool("systemd-analyze", &args) else { return };
    assert!(output.status.success(), "{}", printed(&output));
}

#[test]
fn the_user_file_is_understood() {
    let root = tempfile::tempdir().unwrap();
    std::fs::create_dir(root.path().join("etc")).unwrap();
    let file = unit_file("benderd.sysusers").display().to_string();
    let root = format!("--root={}", root.path().display());
    let Some(output) = tool("systemd-sysusers", &["--dry-run", &root, &file]) else { return };
    let text = printed(&output);
    assert!(output.status.success() && text.contains("benderd"), "{text}");
}

#[test]
fn what_the_unit_starts_ends_with_2_when_its_config_is_unusable() {
    // RestartPreventExitStatus=2 relies on it.
    let unit = std::fs::read_to_string(unit_file("benderd.service")).unwrap();
    let start = unit.lines().find_map(|l| l.strip_prefix("ExecStart=/usr/bin/benderd ")).unwrap();
    let args: Vec<&str> =
        start.split(' ').map(|a| if a.starts_with('/') { "/nowhere/benderd.toml" } else { a }).collect();
    let output = Command::new(env!("CARGO_BIN_EXE_benderd")).args(&args).output().unwrap();
    let text = printed(&output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("/nowhere/benderd.toml: cannot be read"), "{text}");
    assert!(unit.contains("\nRestartPreventExitStatus=2\n"));
}
