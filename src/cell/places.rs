//! Where the cells of one configuration are: no two at one machine or in one folder, however either is written,
//! and no folder that the daemon could not use.
//!
//! `config` compares what is written and does no I/O; here names are looked up and links followed. Nothing is
//! made and nothing left behind, so that `benderd check` may do it.

use std::collections::BTreeSet;
use std::net::ToSocketAddrs;
use std::path::{Component, Path, PathBuf};

use super::setup::SetupError;
use crate::bender::Transport;
use crate::config::{CellConfig, DaemonConfig, is_device, is_interface};

/// Refuses cells in each other's way, and folders that cannot be used by whoever asks. `machines` are the cells' own, in their order.
pub fn check(config: &DaemonConfig, machines: &[&Transport]) -> Result<(), SetupError> {
    let cells: Vec<_> = config.cells.iter().zip(machines.iter().copied()).collect();
    for (i, (cell, machine)) in cells.iter().enumerate() {
        cells[..i].iter().try_for_each(|other| refuse_sharing((cell, machine), *other))?;
        refuse_journal_among_scans(cell, &config.state_dir)?;
    }
    usable("state_dir", &config.state_dir)?;
    for cell in &config.cells {
        let what = format!("cell {} scan.folder", cell.name);
        let folder = &cell.scan_folder;
        [folder.clone(), folder.join("done"), folder.join("failed")]
            .iter()
            .try_for_each(|f| usable(&what, f))?;
    }
    Ok(())
}

fn refuse_sharing(
    (cell, machine): (&CellConfig, &Transport),
    (other, their_machine): (&CellConfig, &Transport),
) -> Result<(), SetupError> {
    let refuse = |key, found: String, theirs: String| {
        let clash = format!("cell {} has {theirs}", other.name);
        Err(SetupError::Shared { cell: cell.name.clone(), key, found, clash })
    };
    if !machines(&cell.address).is_disjoint(&machines(&other.address)) && clash(machine, their_machine) {
        let by = if machine.claims().is_some() { ", by its number, node or identifiers" } else { "" };
        let theirs = format!("the same machine as {:?}{by}", other.address);
        return refuse("address", format!("{:?}", cell.address), theirs);
    }
    let (ours, theirs) = (real_path(&cell.scan_folder), real_path(&other.scan_folder));
    if ours.starts_with(&theirs) || theirs.starts_with(&ours) {
        return refuse("scan.folder", ours.display().to_string(), theirs.display().to_string());
    }
    Ok(())
}

/// Whether two at one address may be one machine, or hear each other's answers.
fn clash(one: &Transport, other: &Transport) -> bool {
    match (one.claims(), other.claims()) {
        (Some(ours), Some(theirs)) => !ours.is_disjoint(&theirs),
        _ => true,
    }
}

/// The journal would be taken for a scan and moved away. Scan folders within the state folder are usual: the
/// systemd unit lets the daemon write nowhere else.
fn refuse_journal_among_scans(cell: &CellConfig, state_dir: &Path) -> Result<(), SetupError> {
    let (scans, state) = (real_path(&cell.scan_folder), real_path(state_dir));
    if !state.starts_with(&scans) {
        return Ok(());
    }
    Err(SetupError::Shared {
        cell: cell.name.clone(),
        key: "scan.folder",
        found: scans.display().to_string(),
        clash: format!("state_dir {} is in it", state.display()),
    })
}

/// Every place that an address may mean (a serial port or folder, whatever links lead to it), and the address itself: a name may be
/// unknown while the network is down.
fn machines(address: &str) -> BTreeSet<String> {
    if is_device(address) {
        return BTreeSet::from([real_path(Path::new(address)).display().to_string()]);
    }
    if is_interface(address) {
        return BTreeSet::from([address.to_owned()]);
    }
    let mut all = BTreeSet::new();
    if let Some((host, port)) = address.rsplit_once(':') {
        let host = host.to_ascii_lowercase();
        let port = port.parse().unwrap_or(0_u16);
        all.insert(format!("{}:{port}", host.trim_end_matches('.')));
    }
    let found = address.to_socket_addrs().into_iter().flatten();
    all.extend(found.map(|a| format!("{}:{}", a.ip().to_canonical(), a.port())));
    all
}

/// Absolute, links followed as far as the path exists; the rest as `create_dir_all` would make it.
fn real_path(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let mut real = PathBuf::new();
    for component in absolute.components() {
        if component == Component::ParentDir {
            real.pop();
        } else {
            real.push(component);
            real = real.canonicalize().unwrap_or(real);
        }
    }
    real
}

/// What exists of the folder's path must be a folder that takes a file: one without a name, gone when closed.
fn usable(what: &str, folder: &Path) -> Result<(), SetupError> {
    let real = real_path(folder);
    let existing = real.ancestors().find(|p| p.symlink_metadata().is_ok()).unwrap_or(&real);
    tempfile::tempfile_in(existing).map(drop).map_err(|cause| SetupError::Folder {
        what: what.to_owned(),
        folder: folder.display().to_string(),
        existing: existing.display().to_string(),
        cause,
    })
}
