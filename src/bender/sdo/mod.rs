//! Tables over CANopen: the machine's object dictionary holds status, staging area, commit and active table as objects of bytes, moved
//! by SDO as CiA 301 has it. The contract is `protocols/reference-can.md`.
//!
//! Under `table_link`, over a [`CanPort`].

mod codes;
mod dialogue;
mod download;
#[cfg(test)]
mod tests;
mod upload;

use std::io;

use super::caller::millis;
use super::can::{BusOpener, CanPort, Frame, FrameId, open_port};
use super::exchange::{Ask, Exchange, Protocol};
use super::profile::Profile;
use super::recording::Frames;
use super::wire::{commit_image, payload_bytes};
use dialogue::{Client, Finish};
use download::Download;
use upload::Upload;

/// One object of a dictionary.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Object {
    /// Index.
    pub index: u16,
    /// Subindex.
    pub subindex: u8,
}

impl std::fmt::Display for Object {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "object {:04X}:{:02X}", self.index, self.subindex)
    }
}

impl std::str::FromStr for Object {
    type Err = ();

    fn from_str(text: &str) -> Result<Object, ()> {
        let (index, subindex) = text.split_once(':').ok_or(())?;
        let hex = |text: &str, digits| {
            let fits = text.len() == digits && text.bytes().all(|b| b.is_ascii_hexdigit());
            u16::from_str_radix(text, 16).ok().filter(|_| fits).ok_or(())
        };
        Ok(Object { index: hex(index, 4)?, subindex: hex(subindex, 2)? as u8 })
    }
}

/// What a profile says of a machine on CANopen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CanopenSettings {
    /// Its node number, 1 to 127.
    pub node: u8,
    /// Whether bytes go in blocks where the machine can.
    pub block: bool,
    /// The status image, read only.
    pub status: Object,
    /// The staging area.
    pub staging: Object,
    /// The commit, revision and CRC, write only.
    pub commit: Object,
    /// The payload in force, read only.
    pub active: Object,
}

/// Identifiers of what a node's SDO server hears and says (the predefined connection set).
pub fn cob_ids(node: u8) -> (FrameId, FrameId) {
    (FrameId::Standard(0x600 + u16::from(node)), FrameId::Standard(0x580 + u16::from(node)))
}

/// The protocol.
pub struct Canopen {
    profile: Profile,
    settings: CanopenSettings,
    opener: Option<BusOpener>,
    frames: Frames,
}

impl Canopen {
    /// For a machine of this profile, on an interface or where `opener` says.
    pub fn new(profile: &Profile, settings: &CanopenSettings, opener: Option<BusOpener>) -> Canopen {
        Canopen { profile: profile.clone(), settings: settings.clone(), opener, frames: Frames::default() }
    }

    fn upload(&self, object: Object, finish: Finish) -> Box<dyn Exchange<Piece = Frame>> {
        let (settings, request_ms) = (&self.settings, millis(self.profile.deadlines.request));
        Box::new(Client::new(settings.node, object, request_ms, Upload::new(settings.block), finish))
    }

    fn download(&self, object: Object, data: Vec<u8>, block: bool) -> Box<dyn Exchange<Piece = Frame>> {
        let (settings, request_ms) = (&self.settings, millis(self.profile.deadlines.request));
        Box::new(Client::new(settings.node, object, request_ms, Download::new(data, block), Box::new(Ok)))
    }
}

/// The first bytes of an object, which may be longer.
fn cut(mut object: Vec<u8>, bytes: usize) -> Result<Vec<u8>, String> {
    if object.len() < bytes {
        return Err(format!("it has {} bytes, {bytes} were asked for", object.len()));
    }
    object.truncate(bytes);
    Ok(object)
}

/// A payload of an object that may be longer: as long as its bend count says.
fn cut_payload(profile: &Profile, object: Vec<u8>) -> Result<Vec<u8>, String> {
    let at = profile.table.program_bytes;
    match object.get(at..at + 2) {
        Some(count) => {
            let bends = usize::from(u16::from_be_bytes([count[0], count[1]]));
            cut(object, payload_bytes(profile, bends))
        }
        None if object.is_empty() => Ok(object),
        None => cut(object, profile.payload_header_bytes()),
    }
}

impl Protocol for Canopen {
    type Port = CanPort;

    fn begin(&mut self, ask: &Ask) -> Box<dyn Exchange<Piece = Frame>> {
        let objects = &self.settings;
        match ask {
            Ask::Status => self.upload(objects.status, Box::new(Ok)),
            Ask::Stage(image) => self.download(objects.staging, image.clone(), objects.block),
            Ask::ReadBack { bytes } => {
                let bytes = *bytes;
                self.upload(objects.staging, Box::new(move |object| cut(object, bytes)))
            }
            // Eight bytes; in blocks nothing would be gained.
            Ask::Commit(id) => self.download(objects.commit, commit_image(&self.profile, *id), false),
            Ask::Recall => {
                let profile = self.profile.clone();
                self.upload(objects.active, Box::new(move |object| cut_payload(&profile, object)))
            }
        }
    }

    fn frames(&self) -> &Frames {
        &self.frames
    }

    async fn open(&mut self, endpoint: &str) -> io::Result<CanPort> {
        let port = open_port(endpoint, self.opener.as_mut(), false, self.profile.deadlines.request)?;
        Ok(port.recorded(self.frames.clone()))
    }
}
