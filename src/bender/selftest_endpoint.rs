//! Whether what a profile's transport leads over can be opened, and what to change when it cannot: `selftest`'s second step.

use std::io::{self, ErrorKind};
use std::path::Path;

use tokio::net::{TcpStream, lookup_host};
use tokio::task::spawn_blocking;
use tokio::time::{Instant, timeout};

use super::can::Socket;
use super::open::serial_port;
use super::profile::Profile;
use super::selftest::Step;
use super::transport::{SerialSettings, Transport};

const STEP: &str = "endpoint";

/// Opens it once, and closes it again.
pub async fn check(profile: &Profile, endpoint: &str) -> Step {
    let begun = Instant::now();
    let limit = profile.deadlines.connect;
    let opening = async {
        match &profile.transport {
            Transport::ModbusTcp(_) | Transport::ModbusRtuOverTcp(..) => socket(endpoint).await,
            Transport::ModbusRtu(.., settings) | Transport::SerialTable(.., settings) => {
                port(endpoint, settings)
            }
            Transport::Folder(_) => apart(folder, endpoint).await,
            Transport::Can(can) => interface(endpoint, can.fd),
            Transport::Canopen(_) => interface(endpoint, false),
        }
    };
    match timeout(limit, opening).await {
        Err(_) => {
            let found = format!("{endpoint}: no answer within {} ms", limit.as_millis());
            let advice = match &profile.transport {
                Transport::Folder(_) => {
                    "the share hangs: is its server on, is the network cable in; `mount` lists what is mounted".to_owned()
                }
                _ => unreachable(endpoint),
            };
            Step::failed(STEP, found, advice)
        }
        Ok(Err((found, advice))) => Step::failed(STEP, format!("{endpoint}: {found}"), advice),
        Ok(Ok(what)) => {
            let ms = begun.elapsed().as_secs_f64() * 1000.0;
            Step::ok(STEP, format!("{endpoint}: {what} in {ms:.1} ms")).with("open_ms", ms)
        }
    }
}

type Opened = Result<&'static str, (String, String)>;

async fn socket(endpoint: &str) -> Opened {
    let found = match lookup_host(endpoint).await {
        Ok(found) => found.collect::<Vec<_>>(),
        Err(error) => {
            let advice = "no computer of this name is known: write the machine's IP address, or enter the name in \
                          /etc/hosts";
            return Err((error.to_string(), advice.into()));
        }
    };
    match TcpStream::connect(&found[..]).await {
        Ok(_) => Ok("connected"),
        Err(error) if error.kind() == ErrorKind::ConnectionRefused => {
            let port = endpoint.rsplit(':').next().unwrap_or_default();
            Err((
                "connection refused".into(),
                format!(
                    "the computer there is on, but nothing listens on port {port}: switch the controller's server on, or \
                     correct the port in `endpoint` (Modbus's own is 502); some controllers take one client only, so stop \
                     others"
                ),
            ))
        }
        Err(error) => Err((error.to_string(), unreachable(endpoint))),
    }
}

fn interface(name: &str, fd: bool) -> Opened {
    match Socket::open(name, fd) {
        Ok(_) => Ok("opened"),
        Err(error) => {
            // What is wrong with it, and the command for that, the error says already.
            let there = can_interfaces();
            let there = if there.is_empty() { "none".to_owned() } else { there.join(", ") };
            let advice = format!(
                "CAN interfaces of this computer: {there}; `endpoint` must name one of them, and that be up"
            );
            Err((error.to_string(), advice))
        }
    }
}

/// The kernel's number for interfaces of this kind (ARPHRD_CAN).
const KIND_CAN: &str = "280";

fn can_interfaces() -> Vec<String> {
    let Ok(entries) = std::fs::read_dir("/sys/class/net") else { return Vec::new() };
    let is_can =
        |path: &Path| std::fs::read_to_string(path.join("type")).is_ok_and(|kind| kind.trim() == KIND_CAN);
    let found = entries.flatten().filter(|entry| is_can(&entry.path()));
    let mut found: Vec<String> =
        found.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    found.sort();
    found
}

fn unreachable(endpoint: &str) -> String {
    let host = endpoint.rsplit_once(':').map_or(endpoint, |(host, _)| host);
    format!(
        "nothing is heard of it: is the machine on, is the network cable in, is this computer in the same network (`ip \
         address`), does `ping {host}` answer, does a firewall stand between"
    )
}

fn port(path: &str, settings: &SerialSettings) -> Opened {
    let error = match serial_port(path, settings) {
        Ok(_) => return Ok("opened"),
        Err(error) => error,
    };
    let found = error.to_string();
    if !Path::new(path).exists() {
        let there = serial_ports();
        let there = if there.is_empty() { "none".to_owned() } else { there.join(", ") };
        let advice = format!(
            "there is no such device: plug the adapter in, or correct `endpoint`; serial ports of this computer: {there}"
        );
        return Err((found, advice));
    }
    let advice = match error.kind() {
        ErrorKind::PermissionDenied => {
            "this user may not open it: add it to the device's group (`sudo usermod -aG dialout $USER`) and log in anew"
                .to_owned()
        }
        ErrorKind::ResourceBusy => match holders(Path::new(path)) {
            names if names.is_empty() => {
                "is it a serial port? If so, stop the program that has it open (`sudo fuser -v` names it)".to_owned()
            }
            names => format!("stop {}", names.join(" and ")),
        },
        _ => "is it a serial port, and can it do the [serial] settings of the profile".to_owned(),
    };
    Err((found, advice))
}

/// By the names that do not change first.
fn serial_ports() -> Vec<String> {
    let of = |folder: &str, begins: &[&str]| -> Vec<String> {
        let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
        let names = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned());
        let names = names.filter(|name| begins.is_empty() || begins.iter().any(|b| name.starts_with(b)));
        names.map(|name| format!("{folder}/{name}")).collect()
    };
    let mut found = of("/dev/serial/by-id", &[]);
    if found.is_empty() {
        found = of("/dev", &["ttyUSB", "ttyACM", "ttyAMA"]);
    }
    found.sort();
    found
}

/// Programs that have a file open, as far as this user may see.
fn holders(path: &Path) -> Vec<String> {
    let (Ok(device), Ok(processes)) = (path.canonicalize(), std::fs::read_dir("/proc")) else {
        return Vec::new();
    };
    let mut found = Vec::new();
    for process in processes.flatten() {
        let (name, folder) = (process.file_name().to_string_lossy().into_owned(), process.path());
        let Ok(open) = std::fs::read_dir(folder.join("fd")) else { continue };
        if open.flatten().any(|file| std::fs::read_link(file.path()).is_ok_and(|to| to == device)) {
            let program = std::fs::read_to_string(folder.join("comm")).unwrap_or_default();
            found.push(format!("{} (process {name})", program.trim()));
        }
    }
    found
}

/// Off the async thread: a share may hang, and the time for it must go on.
async fn apart(look: impl FnOnce(&str) -> Opened + Send + 'static, path: &str) -> Opened {
    let path = path.to_owned();
    match spawn_blocking(move || look(&path)).await {
        Ok(opened) => opened,
        Err(join) => std::panic::resume_unwind(join.into_panic()),
    }
}

fn folder(path: &str) -> Opened {
    if !Path::new(path).is_dir() {
        let advice = "mount the share that the controller writes to (`mount` lists what is mounted), or correct `endpoint`";
        return Err(("there is no such folder".into(), advice.into()));
    }
    // A file without a name: commands are files, so without this right nothing can be asked.
    let tried: io::Result<_> = tempfile::tempfile_in(path);
    match tried {
        Ok(_) => Ok("found, and can be written to"),
        Err(error) => {
            let advice = "give this user the right to write there: commands are files in it (on a share, see its mount's \
                          uid and gid)";
            Err((format!("cannot be written to: {error}"), advice.into()))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The look was taken on the async thread, so that no deadline ended it.
    #[tokio::test]
    async fn a_share_that_hangs_is_waited_for_and_no_longer() {
        let (release, held) = std::sync::mpsc::channel::<()>();
        let look = move |_: &str| -> Opened {
            let _ = held.recv();
            Ok("found")
        };
        let limit = std::time::Duration::from_millis(20);
        assert!(timeout(limit, apart(look, "share")).await.is_err());
        drop(release);
    }
}
