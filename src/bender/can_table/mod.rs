//! Tables over CAN, by the messages of a database: the status is listened to, a table goes item by item and each is echoed, the
//! commit is sent once. The contract is `protocols/reference-can.md`.
//!
//! Under `table_link`, over a [`CanPort`].

mod commit;
mod contract;
mod status;
#[cfg(test)]
mod tests;
mod transfer;

use std::io;
use std::sync::Arc;

use super::caller::millis;
use super::can::{BusOpener, CanPort, Frame, open_port};
use super::exchange::{Ask, Exchange, Protocol};
use super::profile::Profile;
use super::recording::Frames;
use commit::Commit;
pub use contract::{Contract, PROGRAM_BYTES, ROWS};
use status::Listening;
use transfer::Transfer;

/// What a profile says of a machine on CAN.
#[derive(Debug, Clone, PartialEq)]
pub struct CanSettings {
    /// Its messages.
    pub contract: Arc<Contract>,
    /// Whether whole rows go in CAN FD frames.
    pub fd: bool,
}

/// The protocol.
pub struct CanTable {
    profile: Profile,
    settings: CanSettings,
    opener: Option<BusOpener>,
    frames: Frames,
}

impl CanTable {
    /// For a machine of this profile, on an interface or where `opener` says.
    pub fn new(profile: &Profile, settings: &CanSettings, opener: Option<BusOpener>) -> CanTable {
        CanTable { profile: profile.clone(), settings: settings.clone(), opener, frames: Frames::default() }
    }
}

impl Protocol for CanTable {
    type Port = CanPort;

    fn begin(&mut self, ask: &Ask) -> Box<dyn Exchange<Piece = Frame>> {
        let contract = Arc::clone(&self.settings.contract);
        let request_ms = millis(self.profile.deadlines.request);
        match ask {
            Ask::Status => Box::new(Listening::new(contract, &self.profile, request_ms)),
            Ask::Stage(image) => Box::new(Transfer::write(contract, &self.profile, image.clone())),
            Ask::ReadBack { bytes } => Box::new(Transfer::read_back(contract, &self.profile, *bytes)),
            Ask::Recall => Box::new(Transfer::recall(contract, &self.profile)),
            Ask::Commit(id) => Box::new(Commit::new(contract, *id, request_ms)),
        }
    }

    fn frames(&self) -> &Frames {
        &self.frames
    }

    async fn open(&mut self, endpoint: &str) -> io::Result<CanPort> {
        let port =
            open_port(endpoint, self.opener.as_mut(), self.settings.fd, self.profile.deadlines.request)?;
        Ok(port.recorded(self.frames.clone()))
    }
}
