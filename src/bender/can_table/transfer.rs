//! A table over CAN, item by item: each is asked for or written by one frame and echoed by the machine; a frame or echo that is lost is
//! sent again. What does not fit the item that is out is an old echo, and nothing.

use std::collections::VecDeque;
use std::sync::Arc;

use super::contract::{Contract, ROW};
use crate::bender::caller::millis;
use crate::bender::can::Frame;
use crate::bender::dbc::{DbcError, Message, Presence};
use crate::bender::exchange::{Action, Event, Exchange, Failure};
use crate::bender::profile::Profile;

/// How often an item is sent again.
const REPEATS: u32 = 2;

/// The item that is a whole row.
const WHOLE_ROW: i64 = 8;

/// Bytes before the payload in a staging area: revision and CRC.
const STAGING_HEAD: usize = 8;

/// What is done with items; the number that the frames have for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Operation {
    ReadStaging = 0,
    WriteStaging = 1,
    ReadActive = 2,
}

/// One item: its signals with their places in the image, and its row.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Item {
    signals: Vec<(&'static str, usize)>,
    row: usize,
    whole_row: bool,
}

impl Item {
    fn one(name: &'static str, row: usize, at: usize) -> Item {
        Item { signals: vec![(name, at)], row, whole_row: false }
    }

    fn name(&self) -> &'static str {
        if self.whole_row { "the row" } else { self.signals.first().map_or("", |(name, _)| name) }
    }
}

/// A table on its way.
pub struct Transfer {
    contract: Arc<Contract>,
    operation: Operation,
    /// Of what is written, or of what has been read.
    image: Vec<u8>,
    /// So much of it is the answer, at most.
    bytes: usize,
    /// Where the payload begins in it, and the program's length.
    head: usize,
    program_bytes: usize,
    /// Rows are asked for when their number is known.
    most_rows: usize,
    items: VecDeque<Item>,
    sent: u32,
    request_ms: u64,
    until_ms: u64,
}

impl Transfer {
    fn new(contract: Arc<Contract>, profile: &Profile, operation: Operation, head: usize) -> Transfer {
        let program_bytes = profile.table.program_bytes;
        let mut items = VecDeque::new();
        if head > 0 {
            items.extend([Item::one("Revision", 0, 0), Item::one("Crc", 0, 4)]);
        }
        // First of all the bend count: where there is no table there is none.
        items.push_back(Item::one("BendCount", 0, head + program_bytes));
        items.extend((0..program_bytes / 4).map(|four| Item::one("Program", four, head + 4 * four)));
        items.push_back(Item::one("LastLength", 0, head + program_bytes + 4));
        Transfer {
            contract,
            operation,
            image: vec![0; head + profile.payload_header_bytes()],
            bytes: usize::MAX,
            head,
            program_bytes,
            most_rows: profile.limits.max_bends,
            items,
            sent: 0,
            request_ms: millis(profile.deadlines.request),
            until_ms: 0,
        }
    }

    /// Writes a staging image.
    pub fn write(contract: Arc<Contract>, profile: &Profile, image: Vec<u8>) -> Transfer {
        let mut transfer = Transfer::new(contract, profile, Operation::WriteStaging, STAGING_HEAD);
        let rows = image.len().saturating_sub(transfer.image.len()) / Profile::ROW_BYTES;
        let least = transfer.image.len();
        transfer.image = image;
        transfer.image.resize(transfer.image.len().max(least), 0);
        transfer.add_rows(rows);
        transfer
    }

    /// Reads as many bytes of the staging area.
    pub fn read_back(contract: Arc<Contract>, profile: &Profile, bytes: usize) -> Transfer {
        let mut transfer = Transfer::new(contract, profile, Operation::ReadStaging, STAGING_HEAD);
        let rows = bytes.saturating_sub(transfer.image.len()).div_ceil(Profile::ROW_BYTES);
        transfer.add_rows(rows);
        transfer.bytes = bytes;
        transfer
    }

    /// Reads the payload in force.
    pub fn recall(contract: Arc<Contract>, profile: &Profile) -> Transfer {
        Transfer::new(contract, profile, Operation::ReadActive, 0)
    }

    fn add_rows(&mut self, rows: usize) {
        let first = self.head + self.program_bytes + 8;
        let whole_row = self.contract.row.is_some();
        for row in 0..rows {
            let at = first + row * Profile::ROW_BYTES;
            let signals = ROW.into_iter().zip([at, at + 4, at + 8]);
            if whole_row {
                self.items.push_back(Item { signals: signals.collect(), row, whole_row });
            } else {
                self.items.extend(signals.map(|(name, at)| Item::one(name, row, at)));
            }
        }
        self.image.resize(self.image.len().max(first + rows * Profile::ROW_BYTES), 0);
    }

    /// The next item, or the end.
    fn next(&mut self, now_ms: u64) -> Action<Frame> {
        let Some(item) = self.items.front() else {
            let mut image = std::mem::take(&mut self.image);
            image.truncate(if self.operation == Operation::WriteStaging { 0 } else { self.bytes });
            return Action::Done(image);
        };
        match self.request(item) {
            Ok(frame) => {
                self.sent += 1;
                self.until_ms = now_ms + self.request_ms;
                Action::Send { pieces: vec![frame], until_ms: self.until_ms }
            }
            Err(error) => Action::Failed(Failure::Broken(error.to_string())),
        }
    }

    fn messages(&self, item: &Item) -> &(Message, Message) {
        self.contract.row.as_ref().filter(|_| item.whole_row).unwrap_or(&self.contract.item)
    }

    fn request(&self, item: &Item) -> Result<Frame, DbcError> {
        let message = &self.messages(item).0;
        let mut values = vec![
            ("Item", number(message, item)),
            ("Operation", self.operation as i64),
            ("Row", item.row as i64),
        ];
        if self.operation == Operation::WriteStaging {
            values.extend(item.signals.iter().map(|(name, at)| (*name, self.value(name, *at))));
        }
        message.pack(&values)
    }

    /// The value of a signal in the image.
    fn value(&self, name: &str, at: usize) -> i64 {
        let bytes = [0, 1, 2, 3].map(|i| self.image.get(at + i).copied().unwrap_or(0));
        match name {
            // The first character is the lowest byte.
            "Program" => u32::from_le_bytes(bytes).into(),
            // The spare behind it is not sent.
            "BendCount" => u16::from_be_bytes([bytes[0], bytes[1]]).into(),
            "Revision" | "Crc" => u32::from_be_bytes(bytes).into(),
            _ => i32::from_be_bytes(bytes).into(),
        }
    }

    fn put(&mut self, name: &str, at: usize, value: i64) {
        let bytes = match name {
            "Program" => (value as u32).to_le_bytes(),
            "BendCount" => ((value as u32) << 16).to_be_bytes(),
            _ => (value as u32).to_be_bytes(),
        };
        if let Some(place) = self.image.get_mut(at..at + 4) {
            place.copy_from_slice(&bytes);
        }
    }

    /// What a frame says of the item that is out: its values and the result, if it is its echo.
    fn echo(&self, item: &Item, frame: &Frame) -> Option<(Vec<i64>, i64)> {
        let echo = &self.messages(item).1;
        let [number_found, operation, row, result] =
            ["Item", "Operation", "Row", "Result"].map(|name| echo.unpack(frame, name));
        let values: Vec<i64> =
            item.signals.iter().map(|(name, _)| echo.unpack(frame, name)).collect::<Option<_>>()?;
        let fits = number_found == Some(number(echo, item))
            && operation == Some(self.operation as i64)
            && row == Some(item.row as i64);
        let written = self.operation != Operation::WriteStaging
            || item.signals.iter().zip(&values).all(|((name, at), value)| self.value(name, *at) == *value);
        (fits && written).then_some((values, result?))
    }

    fn hear(&mut self, frame: &Frame, now_ms: u64) -> Action<Frame> {
        let waiting = Action::Send { pieces: Vec::new(), until_ms: self.until_ms };
        let Some(item) = self.items.front().cloned() else { return self.next(now_ms) };
        let Some((values, result)) = self.echo(&item, frame) else { return waiting };
        match result {
            0 => {}
            1 => return Action::Failed(Failure::Busy),
            2 if self.operation == Operation::ReadActive && item.name() == "BendCount" => {
                return Action::Done(Vec::new());
            }
            result => {
                let what = if result == 2 {
                    "there is no such item or row"
                } else {
                    "a result that the contract does not name"
                };
                let why = format!("{} {}: {what} (result {result})", item.name(), item.row);
                return Action::Failed(Failure::Refused(why));
            }
        }
        self.items.pop_front();
        self.sent = 0;
        if self.operation != Operation::WriteStaging {
            item.signals.iter().zip(&values).for_each(|((name, at), value)| self.put(name, *at, *value));
        }
        if self.operation == Operation::ReadActive && item.name() == "BendCount" {
            let rows = usize::try_from(values.first().copied().unwrap_or(0)).unwrap_or(usize::MAX);
            if rows > self.most_rows {
                let why = format!(
                    "the active table has {rows} bends, the machine takes {} at most",
                    self.most_rows
                );
                return Action::Failed(Failure::Broken(why));
            }
            self.add_rows(rows);
        }
        self.next(now_ms)
    }
}

/// The number of an item: the multiplexer's value where there is one.
fn number(message: &Message, item: &Item) -> i64 {
    match item.signals.first().and_then(|(name, _)| message.signal(name).ok()).map(|signal| signal.presence) {
        Some(Presence::When(number)) if !item.whole_row => number,
        _ => WHOLE_ROW,
    }
}

impl Exchange for Transfer {
    type Piece = Frame;

    fn on(&mut self, event: Event<Frame>, now_ms: u64) -> Action<Frame> {
        match event {
            Event::Begun => self.next(now_ms),
            Event::Received(frame) => self.hear(&frame, now_ms),
            Event::Timeout if self.sent <= REPEATS => self.next(now_ms),
            Event::Timeout => {
                let (name, row) = self.items.front().map_or(("", 0), |item| (item.name(), item.row));
                let why = format!(
                    "{name} {row} was sent {} times and not echoed within {} ms",
                    self.sent, self.request_ms
                );
                Action::Failed(Failure::Broken(why))
            }
        }
    }
}
