//! benderd.toml: which cells this daemon runs and where everything of theirs is.
//!
//! Paths are relative to the folder of the file, so that a configuration can be moved as a whole. What the
//! paths name is read by `cell`, which knows the rooms that it is for.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use toml::Spanned;

use super::{ConfigError, Document};

/// The whole file.
#[derive(Debug, Clone, PartialEq)]
pub struct DaemonConfig {
    /// Where the journal is kept.
    pub state_dir: PathBuf,
    /// Another materials file than the one that is built in.
    pub materials: Option<PathBuf>,
    /// At least one, with different names, machines and scan folders.
    pub cells: Vec<CellConfig>,
}

/// One bending cell.
#[derive(Debug, Clone, PartialEq)]
pub struct CellConfig {
    /// Its name in logs and journal.
    pub name: String,
    /// What the daemon may do there.
    pub mode: Mode,
    /// Part file.
    pub part: PathBuf,
    /// Machine profile: the name of one that is built in, or a path.
    pub profile: String,
    /// Machine as `host:port`.
    pub address: String,
    /// Folder that the scan program exports into.
    pub scan_folder: PathBuf,
    /// Unit of the coordinates in scan files.
    pub scan_unit: ScanUnit,
    /// A scan file written in place is complete when unchanged for this long.
    pub settle_ms: u64,
}

/// What the daemon may do at a machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// Measures, decides and records; never writes to the machine.
    Observe,
    /// Delivers tables within the limits once armed.
    Automatic,
}

/// Unit of a scan file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScanUnit {
    /// Metres.
    M,
    /// Millimetres.
    Mm,
    /// Inches.
    Inch,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFile {
    version: Spanned<u32>,
    state_dir: PathBuf,
    materials: Option<PathBuf>,
    cell: Spanned<Vec<RawCell>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawCell {
    name: Spanned<String>,
    mode: Mode,
    part: PathBuf,
    profile: String,
    address: Spanned<String>,
    scan: RawScan,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawScan {
    folder: Spanned<PathBuf>,
    #[serde(default = "millimetres")]
    unit: ScanUnit,
    settle_s: Option<Spanned<f64>>,
}

fn millimetres() -> ScanUnit {
    ScanUnit::Mm
}

/// Reads a daemon configuration.
pub fn load_daemon(path: &Path) -> Result<DaemonConfig, ConfigError> {
    let base = path.parent().unwrap_or(Path::new(""));
    parse_daemon(&Document::read(path)?, base)
}

/// Validates a daemon configuration whose relative paths start at `base`.
pub fn parse_daemon(doc: &Document, base: &Path) -> Result<DaemonConfig, ConfigError> {
    let raw: RawFile = doc.parse()?;
    if *raw.version.get_ref() != 1 {
        return Err(doc.value_error(raw.version.span(), "version", raw.version.get_ref(), "1"));
    }
    if raw.cell.get_ref().is_empty() {
        return Err(doc.value_error(raw.cell.span(), "cell", "none", "at least one [[cell]]"));
    }
    let mut cells: Vec<CellConfig> = Vec::new();
    for raw_cell in raw.cell.get_ref() {
        let cell = parse_cell(doc, raw_cell, base)?;
        refuse_sharing(doc, raw_cell, &cell, &cells)?;
        cells.push(cell);
    }
    Ok(DaemonConfig {
        state_dir: base.join(raw.state_dir),
        materials: raw.materials.map(|m| base.join(m)),
        cells,
    })
}

fn parse_cell(doc: &Document, raw: &RawCell, base: &Path) -> Result<CellConfig, ConfigError> {
    let name = raw.name.get_ref();
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    if name.is_empty() || name.len() > 32 || !name.chars().all(plain) {
        let allowed = "1 to 32 of a-z, A-Z, 0-9, - and _";
        return Err(doc.value_error(raw.name.span(), "cell.name", format!("{name:?}"), allowed));
    }
    let address = raw.address.get_ref();
    // Which of them the machine's profile asks for is seen when that is read.
    if !is_host_port(address) && !is_device(address) && !is_interface(address) {
        let key = format!("cell {name} address");
        let allowed = format!("{HOST_PORT}, the path of a serial port, or the name of a CAN interface");
        return Err(doc.value_error(raw.address.span(), &key, format!("{address:?}"), allowed));
    }
    let settle_s = match &raw.scan.settle_s {
        Some(value) => doc.in_range(value, &format!("cell {name} scan.settle_s"), 0.2..=600.0)?,
        None => 1.0,
    };
    Ok(CellConfig {
        name: name.clone(),
        mode: raw.mode,
        part: base.join(&raw.part),
        profile: profile(&raw.profile, base),
        address: address.clone(),
        scan_folder: base.join(raw.scan.folder.get_ref()),
        scan_unit: raw.scan.unit,
        settle_ms: (settle_s * 1000.0) as u64,
    })
}

/// The form of a network address in words.
pub const HOST_PORT: &str = "host:port with a port of 1 to 65535, for instance \"192.168.1.20:502\"";

/// Whether a text has the form `host:port` with a port of 1 to 65535; the host is not looked up.
pub fn is_host_port(text: &str) -> bool {
    text.rsplit_once(':')
        .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok_and(|p| p > 0))
}

/// Whether a text has the form of a device's path; the device is not looked up.
pub fn is_device(text: &str) -> bool {
    text.starts_with('/') && text.len() > 1 && !text.chars().any(char::is_control)
}

/// Whether a text has the form of a CAN interface's name: up to 15 letters and digits after a letter; it is not looked up.
pub fn is_interface(text: &str) -> bool {
    let usual = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'-' | b'.');
    text.len() <= 15 && text.starts_with(|c: char| c.is_ascii_alphabetic()) && text.bytes().all(usual)
}

/// What looks like a file is one; any other word is a built-in profile's name.
fn profile(text: &str, base: &Path) -> String {
    let is_file = text.contains('/') || text.ends_with(".toml");
    if is_file { base.join(text).display().to_string() } else { text.to_owned() }
}

/// Two cells on one folder would take each other's scans. Whether they are at one machine their profiles say: `cell` looks.
fn refuse_sharing(
    doc: &Document,
    raw: &RawCell,
    cell: &CellConfig,
    others: &[CellConfig],
) -> Result<(), ConfigError> {
    for other in others {
        let theirs = |what: &str| format!("a {what} of its own; cell {} has this one", other.name);
        let key = |what: &str| format!("cell {} {what}", cell.name);
        if cell.name == other.name {
            return Err(doc.value_error(raw.name.span(), "cell.name", &cell.name, theirs("name")));
        }
        if cell.scan_folder == other.scan_folder {
            let span = raw.scan.folder.span();
            let found = cell.scan_folder.display();
            return Err(doc.value_error(span, &key("scan.folder"), found, theirs("scan folder")));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const CELL: &str = "[[cell]]\nname = \"b1\"\nmode = \"automatic\"\npart = \"p.toml\"\nprofile = \"m.toml\"\n\
                        address = \"10.0.0.5:502\"\n[cell.scan]\nfolder = \"scans\"\n";

    fn parse(text: &str) -> Result<DaemonConfig, String> {
        parse_daemon(&Document::new("t.toml", text), Path::new("/etc/benderd")).map_err(|e| e.to_string())
    }

    fn file(cells: &str) -> String {
        format!("version = 1\nstate_dir = \"/var/lib/benderd\"\n{cells}")
    }

    #[test]
    fn paths_start_at_the_folder_of_the_file() {
        let config = parse(&file(CELL)).unwrap();
        assert_eq!(config.state_dir, Path::new("/var/lib/benderd"));
        assert_eq!(config.cells[0].part, Path::new("/etc/benderd/p.toml"));
        assert_eq!(config.cells[0].profile, "/etc/benderd/m.toml");
        let named = parse(&file(&CELL.replace("m.toml", "reference-modbus"))).unwrap();
        assert_eq!(named.cells[0].profile, "reference-modbus");
        assert_eq!((config.cells[0].scan_unit, config.cells[0].settle_ms), (ScanUnit::Mm, 1000));
    }

    #[test]
    fn errors_name_line_key_what_was_found_and_what_is_allowed() {
        for (from, to, expected) in [
            ("version = 1", "version = 2", "t.toml, line 1: version = 2, allowed is 1"),
            ("\"b1\"", "\"b 1\"", "line 4: cell.name = \"b 1\", allowed is 1 to 32"),
            ("10.0.0.5:502", "10.0.0.5", "line 8: cell b1 address = \"10.0.0.5\", allowed is host:port"),
            ("10.0.0.5:502", "10.0.0.5:0", "line 8: cell b1 address"),
            ("10.0.0.5:502", ":502", "line 8: cell b1 address"),
            ("\"automatic\"", "\"auto\"", "unknown variant `auto`, expected `observe` or `automatic`"),
            ("folder", "folders", "unknown field `folders`"),
            ("\"scans\"", "\"scans\"\nsettle_s = 0.1", "cell b1 scan.settle_s = 0.1, allowed is 0.2 to 600"),
            ("\"scans\"", "\"scans\"\nunit = \"cm\"", "unknown variant `cm`"),
        ] {
            let error = parse(&file(CELL).replacen(from, to, 1)).unwrap_err();
            assert!(error.contains(expected), "{error}\nshould contain {expected}");
        }
        let error = parse(&file("cell = []")).unwrap_err();
        assert!(error.contains("line 3: cell = none, allowed is at least one"), "{error}");
    }

    #[test]
    fn cells_share_neither_name_nor_folder() {
        let other = CELL.replace("b1", "b2").replace("0.5", "0.6").replace("scans", "scans2");
        assert_eq!(parse(&file(&format!("{CELL}{other}"))).unwrap().cells.len(), 2);
        for (own, taken, key) in [("b2", "b1", "cell.name"), ("scans2", "scans", "b2 scan.folder")] {
            let error = parse(&file(&format!("{CELL}{}", other.replace(own, taken)))).unwrap_err();
            assert!(error.contains(key) && error.contains("cell b1 has this one"), "{error}");
        }
    }
}
