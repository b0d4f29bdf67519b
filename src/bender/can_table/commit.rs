//! The commit on CAN: one frame, once, and its echo.

use std::sync::Arc;

use super::contract::Contract;
use crate::bender::can::Frame;
use crate::bender::exchange::{Action, Event, Exchange, Failure};
use crate::bender::wire::TableId;

/// Sends the commit and waits for its echo.
pub struct Commit {
    contract: Arc<Contract>,
    id: TableId,
    request_ms: u64,
    until_ms: u64,
}

impl Commit {
    pub fn new(contract: Arc<Contract>, id: TableId, request_ms: u64) -> Commit {
        Commit { contract, id, request_ms, until_ms: 0 }
    }

    fn is_echo(&self, frame: &Frame) -> bool {
        let echo = &self.contract.commit.1;
        let [revision, crc] = ["Revision", "Crc"].map(|name| echo.unpack(frame, name));
        revision == Some(self.id.revision.into()) && crc == Some(self.id.crc.into())
    }
}

impl Exchange for Commit {
    type Piece = Frame;

    fn on(&mut self, event: Event<Frame>, now_ms: u64) -> Action<Frame> {
        match event {
            Event::Begun => {
                self.until_ms = now_ms + self.request_ms;
                let values = [("Revision", self.id.revision.into()), ("Crc", self.id.crc.into())];
                match self.contract.commit.0.pack(&values) {
                    Ok(frame) => Action::Send { pieces: vec![frame], until_ms: self.until_ms },
                    Err(error) => Action::Failed(Failure::Broken(error.to_string())),
                }
            }
            Event::Received(frame) if self.is_echo(&frame) => Action::Done(Vec::new()),
            Event::Received(_) => Action::Send { pieces: Vec::new(), until_ms: self.until_ms },
            Event::Timeout => {
                let why =
                    format!("{} did not come within {} ms", self.contract.commit.1.name, self.request_ms);
                Action::Failed(Failure::Broken(why))
            }
        }
    }
}
