//! `benderd run` and `check` as a person and a service manager see them.

#![allow(clippy::unwrap_used)] // clippy does not count the helpers of an integration test as test code

use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use benderd::bender::Profile;
use benderd::journal::Journal;
use benderd::sim::bender::{MachineEvent, MachineModel};
use benderd::sim::bender_server::SimulatedBender;
use benderd::sim::door::Door;
use benderd::sim::frames::Framing;
use tokio::net::TcpListener;
use tokio::sync::mpsc;

fn benderd(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_benderd")).args(args).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A configuration with one cell for the shipped part.
fn config(dir: &Path, mode: &str, address: &str) -> String {
    let part = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/parts/bracket-17.toml");
    let text = format!(
        "version = 1\nstate_dir = \"state\"\n\n[[cell]]\nname = \"b1\"\nmode = \"{mode}\"\npart = \"{}\"\n\
         profile = \"reference-modbus\"\naddress = \"{address}\"\n[cell.scan]\nfolder = \"scans\"\n",
        part.display()
    );
    let path = dir.join("benderd.toml");
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn the_shipped_example_is_good() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/config/benderd.toml");
    let output = benderd(&["check", path]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("cell bender-1: observe, part bracket-17 with 4 bends"), "{text}");
}

#[test]
fn check_finds_what_run_would_stumble_over_and_names_it() {
    let dir = tempfile::tempdir().unwrap();
    let good = std::fs::read_to_string(config(dir.path(), "observe", "127.0.0.1:502")).unwrap();
    // The same part for a machine that cannot bend as far.
    let profile = Path::new(env!("CARGO_MANIFEST_DIR")).join("protocols/reference-modbus.toml");
    let weak =
        std::fs::read_to_string(profile).unwrap().replace("max_angle_deg = 190.0", "max_angle_deg = 60.0");
    std::fs::write(dir.path().join("weak.toml"), weak).unwrap();
    for (from, to, expected) in [
        ("bracket-17.toml", "missing.toml", "missing.toml: cannot be read"),
        ("\"reference-modbus\"", "\"nothing\"", "no shipped profile of this name"),
        ("\"reference-modbus\"", "\"weak.toml\"", "cannot be made on"),
        ("mode = \"observe\"", "mode = \"observe\"\nspeed = 3", "unknown field `speed`"),
    ] {
        let path = dir.path().join("benderd.toml");
        std::fs::write(&path, good.replace(from, to)).unwrap();
        let path = path.display().to_string();
        for args in [vec!["check", &path], vec!["run", "--config", &path]] {
            let output = benderd(&args);
            assert_eq!(output.status.code(), Some(2), "{args:?}: {}", stderr(&output));
            assert!(stderr(&output).contains(expected), "{args:?}: {}", stderr(&output));
        }
    }
    assert!(!dir.path().join("state").exists(), "nothing is made for an unusable configuration");
}

#[test]
fn a_journal_of_something_else_is_refused_before_anything_starts() {
    let dir = tempfile::tempdir().unwrap();
    let path = config(dir.path(), "observe", "127.0.0.1:502");
    std::fs::create_dir(dir.path().join("state")).unwrap();
    std::fs::write(dir.path().join("state/journal.db"), "not a database, but long enough to look like one")
        .unwrap();
    let output = benderd(&["run", "--config", &path]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("journal.db"), "{}", stderr(&output));
}

/// The service manager's end of the notify socket.
struct Manager(UnixDatagram);

impl Manager {
    fn new(dir: &Path) -> Manager {
        let socket = UnixDatagram::bind(dir.join("notify")).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        Manager(socket)
    }

    fn until(&self, wanted: &str) {
        let mut buffer = [0; 4096];
        loop {
            let length = self.0.recv(&mut buffer).unwrap_or_else(|e| panic!("no {wanted}: {e}"));
            if String::from_utf8_lossy(&buffer[..length]).contains(wanted) {
                return;
            }
        }
    }
}

/// A running daemon that does not outlive a failed test.
struct Daemon(Child);

impl Drop for Daemon {
    fn drop(&mut self) {
        // It has ended already where the test went well.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(dir: &Path, config: &str, arm: bool) -> Daemon {
    let mut command = Command::new(env!("CARGO_BIN_EXE_benderd"));
    command.args(["run", "--config", config]).env("NOTIFY_SOCKET", dir.join("notify"));
    if arm {
        command.arg("--arm");
    }
    Daemon(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
}

fn send(signal: &str, daemon: &Daemon) {
    let status = Command::new("kill").args([signal, &daemon.0.id().to_string()]).status().unwrap();
    assert!(status.success());
}

/// A bender that tells of every table it takes over.
async fn bender() -> (SimulatedBender, mpsc::UnboundedReceiver<MachineEvent>) {
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let profile = Profile::load("reference-modbus").unwrap();
    let model = MachineModel::new(profile, "bracket-17", 4);
    let (tell, told) = mpsc::unbounded_channel();
    let bender = SimulatedBender::start(Door::Socket(Framing::Tcp, listener), model, None, move |event| {
        drop(tell.send(event))
    })
    .unwrap();
    (bender, told)
}

#[tokio::test(flavor = "multi_thread")]
async fn it_comes_up_disarmed_is_armed_by_signal_and_stops_cleanly() {
    let dir = tempfile::tempdir().unwrap();
    let (bender, mut taken) = bender().await;
    let manager = Manager::new(dir.path());
    let path = config(dir.path(), "automatic", bender.address());
    let mut daemon = start(dir.path(), &path, false);
    manager.until("READY=1");
    manager.until("STATUS=b1: disarmed");
    assert_eq!(bender.with(|m| m.active().revision), 0);
    send("-USR1", &daemon);
    let event = tokio::time::timeout(Duration::from_secs(60), taken.recv()).await.unwrap().unwrap();
    assert!(matches!(event, MachineEvent::TakenOver { bends: 4, .. }), "{event:?}");
    manager.until("STATUS=b1: waiting for a scan");
    send("-USR2", &daemon);
    manager.until("STATUS=b1: disarmed");
    send("-TERM", &daemon);
    manager.until("STOPPING=1");
    assert_eq!(daemon.0.wait().unwrap().code(), Some(0));
    let journal = Journal::open(&dir.path().join("state/journal.db")).unwrap();
    journal.verify().unwrap();
    let kinds: Vec<String> = journal.list(0, 100).unwrap().into_iter().map(|r| r.kind).collect();
    assert_eq!(kinds.iter().filter(|k| *k == "intent").count(), 1, "{kinds:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_and_started_again_it_is_disarmed_and_sends_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (bender, mut taken) = bender().await;
    let manager = Manager::new(dir.path());
    let path = config(dir.path(), "automatic", bender.address());
    let mut daemon = start(dir.path(), &path, true);
    tokio::time::timeout(Duration::from_secs(60), taken.recv()).await.unwrap().unwrap();
    send("-KILL", &daemon);
    daemon.0.wait().unwrap();
    let mut daemon = start(dir.path(), &path, false);
    manager.until("STATUS=b1: disarmed");
    assert_eq!(bender.with(|m| m.active().revision), 1);
    send("-TERM", &daemon);
    daemon.0.wait().unwrap();
    Journal::open(&dir.path().join("state/journal.db")).unwrap().verify().unwrap();
}
