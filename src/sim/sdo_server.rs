//! The simulated bender's SDO server: expedited, segmented and block transfer both ways. Pure; written from CiA 301, not from the
//! client: the two check each other.

use super::station::{Controller, Station};
use crate::bender::TableId;
use crate::bender::can::{Frame, FrameId};
use crate::bender::{CanopenSettings, SdoObject};

/// Segments of a block that it takes at once.
const BLOCK: u8 = 32;

/// Program cycles without a good segment after which it says how far a block came; after five times as many it gives up.
const STOPPED: u32 = 20;

/// First byte of an abort.
const ABORT: u8 = 0x80;

/// What comes instead of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum No {
    /// An abort code of CiA 301.
    Abort(u32),
    /// Nothing: the controller keeps it to itself.
    Silence,
}

const BAD_TOGGLE: No = No::Abort(0x0503_0000);
const TIMED_OUT: No = No::Abort(0x0504_0000);
const BAD_COMMAND: No = No::Abort(0x0504_0001);
const BAD_BLOCK_SIZE: No = No::Abort(0x0504_0002);
const BAD_SEQUENCE: No = No::Abort(0x0504_0003);
const BAD_CRC: No = No::Abort(0x0504_0004);
const WRITE_ONLY: No = No::Abort(0x0601_0001);
const READ_ONLY: No = No::Abort(0x0601_0002);
const NO_OBJECT: No = No::Abort(0x0602_0000);
const BAD_LENGTH: No = No::Abort(0x0607_0010);
const TOO_LONG: No = No::Abort(0x0607_0012);
const NO_SUBINDEX: No = No::Abort(0x0609_0011);
const NOT_NOW: No = No::Abort(0x0800_0022);

/// Index and subindex as they stand in a frame.
type Multiplexer = [u8; 3];

/// What is being written.
#[derive(Debug)]
struct Written {
    object: Multiplexer,
    bytes: Vec<u8>,
    announced: Option<usize>,
}

/// What is going on.
#[derive(Debug)]
enum Transfer {
    Nothing,
    Writing {
        what: Written,
        toggle: u8,
    },
    Reading {
        bytes: Vec<u8>,
        toggle: u8,
    },
    /// The last good segment of the block, whether it was the last of all, cycles since.
    WritingBlock {
        what: Written,
        crc: bool,
        good: u8,
        last: bool,
        idle: u32,
    },
    WritingEnd {
        what: Written,
        crc: bool,
    },
    /// What is not acknowledged yet begins at `from`; `sent` segments of it are under way.
    ReadingBlock {
        bytes: Vec<u8>,
        from: usize,
        sent: u8,
        size: u8,
    },
    ReadingEnd,
}

/// A node's SDO server.
#[derive(Debug)]
pub struct SdoServer {
    settings: CanopenSettings,
    knows_blocks: bool,
    transfer: Transfer,
    /// What it is about; aborts name it.
    object: Multiplexer,
}

impl SdoServer {
    /// A node with the objects of these settings.
    pub fn new(settings: CanopenSettings) -> SdoServer {
        SdoServer { settings, knows_blocks: true, transfer: Transfer::Nothing, object: [0; 3] }
    }

    /// The same without block transfer, as small devices are.
    pub fn without_blocks(settings: CanopenSettings) -> SdoServer {
        SdoServer { knows_blocks: false, ..SdoServer::new(settings) }
    }

    /// Answers a request; nothing where that is right.
    fn serve(&mut self, request: [u8; 8], controller: &mut Controller<'_>) -> Vec<[u8; 8]> {
        let transfer = std::mem::replace(&mut self.transfer, Transfer::Nothing);
        if let Transfer::WritingBlock { .. } = transfer
            && request[0] & 0x7F <= BLOCK // else a request: no block has so many segments
            && request[0] != ABORT
        {
            return self.block_segment(transfer, request);
        }
        if matches!(request[0] >> 5, 1 | 2) || request[0] & 0xE3 == 0xA0 || request[0] & 0xE1 == 0xC0 {
            self.object = [request[1], request[2], request[3]];
        }
        let object = self.object;
        let answer = match (request[0] >> 5, transfer) {
            // The client aborts.
            (4, _) => return Vec::new(),
            (1, _) => self.begin_writing(object, request, controller),
            (2, _) => self.begin_reading(object, controller),
            (6, _) if self.knows_blocks && request[0] & 1 == 0 => {
                self.begin_writing_block(object, request, controller)
            }
            (5, transfer) if self.knows_blocks => return self.reading_block(transfer, request, controller),
            (0, Transfer::Writing { what, toggle }) => {
                self.segment_written(what, toggle, request, controller)
            }
            (3, Transfer::Reading { bytes, toggle }) => self.segment_read(bytes, toggle, request),
            (6, Transfer::WritingEnd { what, crc }) if request[0] & 1 == 1 => {
                end_of_block(what, crc, request, &self.settings, controller)
            }
            _ => Err(BAD_COMMAND),
        };
        match answer {
            Ok(answer) => vec![answer],
            Err(no) => abort(object, no),
        }
    }

    fn begin_writing(
        &mut self,
        object: Multiplexer,
        request: [u8; 8],
        controller: &mut Controller<'_>,
    ) -> Result<[u8; 8], No> {
        may_write(object, &self.settings, controller)?;
        let sized = request[0] & 1 == 1;
        if request[0] & 2 == 2 {
            let unused = if sized { usize::from(request[0] >> 2 & 3) } else { 0 };
            write(object, &request[4..8 - unused], &self.settings, controller)?;
        } else {
            let announced = sized.then(|| low_first(&request[4..]));
            self.transfer =
                Transfer::Writing { what: Written { object, bytes: Vec::new(), announced }, toggle: 0 };
        }
        Ok(response(0x60, object))
    }

    fn segment_written(
        &mut self,
        mut what: Written,
        toggle: u8,
        request: [u8; 8],
        controller: &mut Controller<'_>,
    ) -> Result<[u8; 8], No> {
        if request[0] & 0x10 != toggle {
            return Err(BAD_TOGGLE);
        }
        let unused = usize::from(request[0] >> 1 & 7);
        what.bytes.extend(&request[1..8 - unused]);
        if request[0] & 1 == 1 {
            what.check_whole()?;
            write(what.object, &what.bytes, &self.settings, controller)?;
        } else {
            self.transfer = Transfer::Writing { what, toggle: toggle ^ 0x10 };
        }
        Ok([0x20 | toggle, 0, 0, 0, 0, 0, 0, 0])
    }

    fn begin_reading(&mut self, object: Multiplexer, controller: &Controller<'_>) -> Result<[u8; 8], No> {
        let bytes = read(object, &self.settings, controller)?;
        let size = (bytes.len() as u32).to_le_bytes();
        let mut answer = response(0x41, object);
        if (1..=4).contains(&bytes.len()) {
            answer[0] = 0x43 | ((4 - bytes.len()) as u8) << 2;
            answer[4..4 + bytes.len()].copy_from_slice(&bytes);
        } else {
            answer[4..].copy_from_slice(&size);
            self.transfer = Transfer::Reading { bytes, toggle: 0 };
        }
        Ok(answer)
    }

    fn segment_read(&mut self, mut bytes: Vec<u8>, toggle: u8, request: [u8; 8]) -> Result<[u8; 8], No> {
        if request[0] & 0x10 != toggle {
            return Err(BAD_TOGGLE);
        }
        let rest = bytes.split_off(bytes.len().min(7));
        let mut answer = [0; 8];
        answer[0] = toggle | ((7 - bytes.len()) as u8) << 1 | u8::from(rest.is_empty());
        answer[1..=bytes.len()].copy_from_slice(&bytes);
        if !rest.is_empty() {
            self.transfer = Transfer::Reading { bytes: rest, toggle: toggle ^ 0x10 };
        }
        Ok(answer)
    }

    fn begin_writing_block(
        &mut self,
        object: Multiplexer,
        request: [u8; 8],
        controller: &mut Controller<'_>,
    ) -> Result<[u8; 8], No> {
        may_write(object, &self.settings, controller)?;
        let announced = (request[0] & 2 == 2).then(|| low_first(&request[4..]));
        let crc = request[0] & 4 == 4;
        let what = Written { object, bytes: Vec::new(), announced };
        self.transfer = Transfer::WritingBlock { what, crc, good: 0, last: false, idle: 0 };
        let mut answer = response(0xA4, object);
        answer[4] = BLOCK;
        Ok(answer)
    }

    /// A segment of a block that is written: taken if it is the next.
    fn block_segment(&mut self, transfer: Transfer, request: [u8; 8]) -> Vec<[u8; 8]> {
        let Transfer::WritingBlock { mut what, crc, mut good, mut last, mut idle } = transfer else {
            return Vec::new();
        };
        let (number, is_last) = (request[0] & 0x7F, request[0] & 0x80 != 0);
        if number == good + 1 {
            what.bytes.extend(&request[1..]);
            (good, last, idle) = (number, is_last, 0);
        }
        self.transfer = Transfer::WritingBlock { what, crc, good, last, idle };
        if number == BLOCK || is_last { self.block_ends() } else { Vec::new() }
    }

    /// Says how far the block came.
    fn block_ends(&mut self) -> Vec<[u8; 8]> {
        match std::mem::replace(&mut self.transfer, Transfer::Nothing) {
            Transfer::WritingBlock { what, crc, good, last, idle } => {
                self.transfer = if last {
                    Transfer::WritingEnd { what, crc }
                } else {
                    Transfer::WritingBlock { what, crc, good: 0, last, idle }
                };
                vec![[0xA2, good, BLOCK, 0, 0, 0, 0, 0]]
            }
            other => {
                self.transfer = other;
                Vec::new()
            }
        }
    }

    /// All that a client says in a block transfer that it reads.
    fn reading_block(
        &mut self,
        transfer: Transfer,
        request: [u8; 8],
        controller: &Controller<'_>,
    ) -> Vec<[u8; 8]> {
        let object = self.object;
        match (request[0] & 3, transfer) {
            (0, _) => match self.begin_reading_block(object, request[4], controller) {
                Ok(answer) => vec![answer],
                Err(no) => abort(object, no),
            },
            (3, Transfer::ReadingBlock { bytes, from, size, .. }) => self.send_block(bytes, from, size),
            (2, Transfer::ReadingBlock { bytes, from, sent, .. }) => {
                if request[1] > sent {
                    return abort(object, BAD_SEQUENCE);
                }
                if !(1..=127).contains(&request[2]) {
                    return abort(object, BAD_BLOCK_SIZE);
                }
                self.send_block(bytes, from + 7 * usize::from(request[1]), request[2])
            }
            // The client has it all, or says so again.
            (1, Transfer::ReadingEnd) => Vec::new(),
            (2, Transfer::ReadingEnd) => {
                self.transfer = Transfer::ReadingEnd;
                Vec::new()
            }
            _ => abort(object, BAD_COMMAND),
        }
    }

    fn begin_reading_block(
        &mut self,
        object: Multiplexer,
        size: u8,
        controller: &Controller<'_>,
    ) -> Result<[u8; 8], No> {
        if !(1..=127).contains(&size) {
            return Err(BAD_BLOCK_SIZE);
        }
        let bytes = read(object, &self.settings, controller)?;
        let mut answer = response(0xC6, object);
        answer[4..].copy_from_slice(&(bytes.len() as u32).to_le_bytes());
        self.transfer = Transfer::ReadingBlock { bytes, from: 0, sent: 0, size };
        Ok(answer)
    }

    /// The segments from a byte on, or the end.
    fn send_block(&mut self, bytes: Vec<u8>, from: usize, size: u8) -> Vec<[u8; 8]> {
        let total = bytes.len().div_ceil(7).max(1);
        let first = from / 7;
        if first >= total {
            let unused = (total * 7 - bytes.len()) as u8;
            let crc = checksum(&bytes).to_le_bytes();
            self.transfer = Transfer::ReadingEnd;
            return vec![[0xC1 | unused << 2, crc[0], crc[1], 0, 0, 0, 0, 0]];
        }
        let until = total.min(first + usize::from(size));
        let mut frames = Vec::new();
        for segment in first..until {
            let mut frame = [0; 8];
            frame[0] = (segment - first + 1) as u8 | if segment + 1 == total { 0x80 } else { 0 };
            for (place, byte) in frame[1..].iter_mut().zip(bytes.iter().skip(7 * segment)) {
                *place = *byte;
            }
            frames.push(frame);
        }
        self.transfer = Transfer::ReadingBlock { bytes, from, sent: (until - first) as u8, size };
        frames
    }

    fn frames(&self, answers: Vec<[u8; 8]>) -> Vec<Frame> {
        let id = FrameId::Standard(0x580 + u16::from(self.settings.node));
        answers.into_iter().map(|answer| Frame::new(id, answer)).collect()
    }
}

impl Station for SdoServer {
    type Piece = Frame;

    fn hear(&mut self, frame: Frame, controller: &mut Controller<'_>) -> Vec<Frame> {
        let asked = frame.id == FrameId::Standard(0x600 + u16::from(self.settings.node));
        match <[u8; 8]>::try_from(&frame.data[..]) {
            Ok(request) if asked && !controller.is_deaf() => {
                let answers = self.serve(request, controller);
                self.frames(answers)
            }
            _ => Vec::new(),
        }
    }

    fn cycle(&mut self, controller: &mut Controller<'_>) -> Vec<Frame> {
        let Transfer::WritingBlock { idle, what, .. } = &mut self.transfer else { return Vec::new() };
        *idle += 1;
        let (idle, object) = (*idle, what.object);
        let answers = match idle {
            _ if controller.is_deaf() => Vec::new(),
            idle if idle >= 5 * STOPPED => {
                self.transfer = Transfer::Nothing;
                abort(object, TIMED_OUT)
            }
            idle if idle % STOPPED == 0 => self.block_ends(),
            _ => Vec::new(),
        };
        self.frames(answers)
    }
}

impl Written {
    fn check_whole(&self) -> Result<(), No> {
        if self.announced.is_some_and(|size| size != self.bytes.len()) { Err(BAD_LENGTH) } else { Ok(()) }
    }
}

fn response(command: u8, [low, high, subindex]: Multiplexer) -> [u8; 8] {
    [command, low, high, subindex, 0, 0, 0, 0]
}

fn abort(object: Multiplexer, no: No) -> Vec<[u8; 8]> {
    let No::Abort(code) = no else { return Vec::new() };
    let mut answer = response(ABORT, object);
    answer[4..].copy_from_slice(&code.to_le_bytes());
    vec![answer]
}

fn low_first(bytes: &[u8]) -> usize {
    u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as usize
}

/// The end of a block transfer: its checksum, then the object.
fn end_of_block(
    mut what: Written,
    crc: bool,
    request: [u8; 8],
    settings: &CanopenSettings,
    controller: &mut Controller<'_>,
) -> Result<[u8; 8], No> {
    let unused = usize::from(request[0] >> 2 & 7);
    what.bytes.truncate(what.bytes.len().saturating_sub(unused));
    if crc && checksum(&what.bytes).to_le_bytes() != request[1..3] {
        return Err(BAD_CRC);
    }
    what.check_whole()?;
    write(what.object, &what.bytes, settings, controller)?;
    Ok([0xA1, 0, 0, 0, 0, 0, 0, 0])
}

fn is(object: Multiplexer, of: SdoObject) -> bool {
    let [low, high] = of.index.to_le_bytes();
    object == [low, high, of.subindex]
}

/// Why an object is not there.
fn unknown(object: Multiplexer, settings: &CanopenSettings) -> No {
    let known = [settings.status, settings.staging, settings.commit, settings.active];
    let index = u16::from_le_bytes([object[0], object[1]]);
    if known.iter().any(|o| o.index == index) { NO_SUBINDEX } else { NO_OBJECT }
}

fn read(object: Multiplexer, settings: &CanopenSettings, controller: &Controller<'_>) -> Result<Vec<u8>, No> {
    if controller.is_busy() {
        return Err(NOT_NOW);
    }
    let model = &controller.model;
    match object {
        o if is(o, settings.status) => Ok(model.status_image()),
        o if is(o, settings.staging) => Ok(model.staging().to_vec()),
        o if is(o, settings.active) => Ok(model.active_payload()),
        o if is(o, settings.commit) => Err(WRITE_ONLY),
        o => Err(unknown(o, settings)),
    }
}

fn may_write(object: Multiplexer, settings: &CanopenSettings, controller: &Controller<'_>) -> Result<(), No> {
    if controller.is_busy() {
        return Err(NOT_NOW);
    }
    match object {
        o if is(o, settings.staging) || is(o, settings.commit) => Ok(()),
        o if is(o, settings.status) || is(o, settings.active) => Err(READ_ONLY),
        o => Err(unknown(o, settings)),
    }
}

fn write(
    object: Multiplexer,
    bytes: &[u8],
    settings: &CanopenSettings,
    controller: &mut Controller<'_>,
) -> Result<(), No> {
    may_write(object, settings, controller)?;
    if is(object, settings.staging) {
        return if controller.model.write_staging(0, bytes) { Ok(()) } else { Err(TOO_LONG) };
    }
    let [a, b, c, d, e, f, g, h] = <[u8; 8]>::try_from(bytes).map_err(|_| BAD_LENGTH)?;
    let id = TableId { revision: u32::from_be_bytes([a, b, c, d]), crc: u32::from_be_bytes([e, f, g, h]) };
    if controller.write_commit(id) { Ok(()) } else { Err(No::Silence) }
}

/// CRC-16 of CiA 301 by the shortcut for polynomial 1021h, a byte at a time.
fn checksum(bytes: &[u8]) -> u16 {
    let mut crc = 0_u16;
    for byte in bytes {
        let mut x = (crc >> 8) as u8 ^ byte;
        x ^= x >> 4;
        let x = u16::from(x);
        crc = crc << 8 ^ x << 12 ^ x << 5 ^ x;
    }
    crc
}
