//! The status on CAN: nothing is asked; what the machine sends in one of its cycles, all of it, is one look at it.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::contract::{Contract, STATUS_LONGS, program_signal};
use crate::bender::can::Frame;
use crate::bender::exchange::{Action, Event, Exchange, Failure};
use crate::bender::profile::Profile;
use crate::bender::status_image::{PROGRAM, status_bytes};

/// Collects the messages of one cycle.
pub struct Listening {
    contract: Arc<Contract>,
    request_ms: u64,
    until_ms: u64,
    /// Signals of STATUS_ITEM, and their places in the image.
    wanted: Vec<(String, usize)>,
    bytes: usize,
    /// The cycle that is collected, and what of it has come: place and bytes.
    cycle: Option<i64>,
    found: BTreeMap<usize, Vec<u8>>,
}

impl Listening {
    pub fn new(contract: Arc<Contract>, profile: &Profile, request_ms: u64) -> Listening {
        let programs =
            (0..profile.table.program_bytes / 4).map(|four| (program_signal(four), PROGRAM + 4 * four));
        let wanted =
            STATUS_LONGS.iter().map(|(name, at)| ((*name).to_owned(), *at)).chain(programs).collect();
        let (cycle, found) = (None, BTreeMap::new());
        Listening { contract, request_ms, until_ms: 0, wanted, bytes: status_bytes(profile), cycle, found }
    }

    /// Takes a frame, if it belongs to the status.
    fn take(&mut self, frame: &Frame) {
        let Contract { state, status, .. } = &*self.contract;
        let message = if frame.id == state.id { state } else { status };
        let Some(cycle) = message.unpack(frame, "Cycle") else { return };
        if self.cycle != Some(cycle) {
            self.found.clear();
            self.cycle = Some(cycle);
        }
        if frame.id == state.id {
            let words = ["Layout", "Heartbeat", "State", "BendCount"].map(|name| state.unpack(frame, name));
            let words = words.into_iter().flatten().flat_map(|word| (word as u16).to_be_bytes());
            self.found.insert(4, words.collect());
        }
        for (name, at) in &self.wanted {
            let Some(value) = status.unpack(frame, name) else { continue };
            let value = value as u32;
            let bytes = match name.as_str() {
                // The image has 16 bits for it, and two spare bytes.
                "AckCode" => u32::from(value as u16) << 16,
                // The first character is the lowest byte.
                _ if *at >= PROGRAM => value.swap_bytes(),
                _ => value,
            };
            self.found.insert(*at, bytes.to_be_bytes().to_vec());
        }
    }

    /// The whole image, if it is.
    fn image(&self) -> Option<Vec<u8>> {
        (self.found.len() > self.wanted.len()).then(|| {
            let mut image: Vec<u8> = self.found.values().flatten().copied().collect();
            image.resize(self.bytes, 0);
            image
        })
    }

    fn missing(&self) -> String {
        let missing =
            self.wanted.iter().filter(|(_, at)| !self.found.contains_key(at)).map(|(name, _)| name.as_str());
        let state = if self.found.contains_key(&4) { None } else { Some(self.contract.state.name.as_str()) };
        state.into_iter().chain(missing).collect::<Vec<_>>().join(", ")
    }
}

impl Exchange for Listening {
    type Piece = Frame;

    fn on(&mut self, event: Event<Frame>, now_ms: u64) -> Action<Frame> {
        match event {
            Event::Begun => self.until_ms = now_ms + self.request_ms,
            Event::Received(frame) => {
                self.take(&frame);
                if let Some(image) = self.image() {
                    return Action::Done(image);
                }
            }
            Event::Timeout => {
                let ms = self.request_ms;
                let why = match self.cycle {
                    None => format!(
                        "no status message ({}, {}) was heard within {ms} ms; check that the machine is on, its bit rate, and that \
                         the database is the machine's",
                        self.contract.state.id, self.contract.status.id
                    ),
                    Some(cycle) => format!(
                        "no whole status was heard within {ms} ms; in cycle {cycle}, the last, there was no {}",
                        self.missing()
                    ),
                };
                return Action::Failed(Failure::Broken(why));
            }
        }
        Action::Send { pieces: Vec::new(), until_ms: self.until_ms }
    }
}
