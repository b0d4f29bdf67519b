//! A serial line to a simulated machine: a device that is there, or a pseudo terminal under a name of its own.

use std::fs::File;
use std::io;
use std::os::unix::fs::{OpenOptionsExt as _, symlink};
use std::path::{Path, PathBuf};

use tokio_serial::{SerialPort as _, SerialStream};

use crate::bender::{SerialSettings, serial_port};

/// The machine's end of a line, open, and what must live as long as it.
pub struct MachineEnd {
    /// What the machine reads and writes.
    pub wire: SerialStream,
    /// Of a pseudo terminal.
    pub kept: Option<Kept>,
}

/// A pseudo terminal's name, taken away when dropped.
pub struct Kept {
    name: PathBuf,
    /// Without it the machine's end would be closed between two clients.
    _other_end: File,
}

impl Drop for Kept {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.name); // somebody else's work, then
    }
}

/// Opens the device of this path; where there is none, makes a pseudo terminal whose other end is named so. Must be called inside
/// a tokio runtime.
pub fn machine_end(path: &Path, settings: &SerialSettings) -> io::Result<MachineEnd> {
    // A name that a killed simulator left behind leads nowhere.
    if path.is_symlink() && !path.exists() {
        std::fs::remove_file(path)?;
    }
    if path.exists() {
        let wire = serial_port(&path.display().to_string(), settings)?;
        return Ok(MachineEnd { wire, kept: None });
    }
    let (wire, mut other_end) = SerialStream::pair()?;
    let device = other_end.name().ok_or_else(|| io::Error::other("the pseudo terminal has no name"))?;
    // The port itself would keep other programs away from it.
    let open = File::options().read(true).write(true).custom_flags(libc::O_NOCTTY).open(&device)?;
    other_end.set_exclusive(false)?;
    symlink(device, path)?;
    Ok(MachineEnd { wire, kept: Some(Kept { name: path.to_owned(), _other_end: open }) })
}
