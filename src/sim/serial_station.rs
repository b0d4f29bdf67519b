//! The simulated bender on the serial table protocol, written from its contract (protocols/serial-table.md), not from the client.

use super::station::{Controller, Station};
use crate::bender::{TableId, crc_of};

/// Codes of a refusal.
const GARBLED: u8 = 1;
const OUTSIDE: u8 = 2;
const BUSY: u8 = 3;
const UNKNOWN: u8 = 4;

/// The number in an answer to what was garbled.
const NO_NUMBER: u8 = 0xFF;

/// Longest frame in characters, without the colon.
const LONGEST: usize = 9 + 2 * 128 + 8;

/// One machine on one line.
#[derive(Debug)]
pub struct SerialStation {
    unit: u8,
    /// Since the last colon.
    line: String,
}

impl SerialStation {
    /// The machine of this number; nothing heard yet.
    pub fn new(unit: u8) -> SerialStation {
        SerialStation { unit, line: String::new() }
    }

    /// A whole frame's characters, without colon and line end; the answer, if it is for this machine.
    fn frame(&self, text: &str, controller: &mut Controller<'_>) -> Option<Vec<u8>> {
        let garbled = || Some(self.answer(NO_NUMBER, 'N', &[GARBLED]));
        let Some((body, crc)) = text.split_at_checked(text.len().saturating_sub(8)) else { return garbled() };
        if body.len() < 9 || format!("{:08X}", crc_of(body.as_bytes())) != crc {
            return garbled();
        }
        let hex = |digits: &str| u8::from_str_radix(digits, 16).ok();
        let unit = hex(body.get(0..2)?)?;
        if unit != self.unit {
            return None;
        }
        let (sequence, kind) = (hex(body.get(2..4)?)?, body.get(4..5)?);
        let digits = body.get(9..)?;
        let payload: Option<Vec<u8>> =
            (0..digits.len() / 2).map(|at| hex(digits.get(2 * at..2 * at + 2)?)).collect();
        let payload = payload?;
        let reply = self.reply(kind, &payload, controller)?;
        Some(match reply {
            Ok(bytes) => self.answer(sequence, 'A', &bytes),
            Err(code) => self.answer(sequence, 'N', &[code]),
        })
    }

    /// What the machine answers, or the code of its refusal; None: nothing.
    fn reply(
        &self,
        kind: &str,
        payload: &[u8],
        controller: &mut Controller<'_>,
    ) -> Option<Result<Vec<u8>, u8>> {
        if controller.is_busy() {
            return Some(Err(BUSY));
        }
        let word = |at: usize| payload.get(at..at + 2).map(|b| usize::from(u16::from_be_bytes([b[0], b[1]])));
        let long = |at: usize| payload.get(at..at + 4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]));
        Some(match (kind, payload.len()) {
            ("S", 0) => Ok(controller.model.status_image()),
            ("W", 2..) => {
                let written = controller.model.write_staging(word(0)?, &payload[2..]);
                if written { Ok(Vec::new()) } else { Err(OUTSIDE) }
            }
            ("R", 4) => {
                let (offset, count) = (word(0)?, word(2)?);
                controller.model.staging().get(offset..offset + count).map(<[u8]>::to_vec).ok_or(OUTSIDE)
            }
            ("T", 4) => {
                let (offset, count) = (word(0)?, word(2)?);
                let table = controller.model.active_payload();
                let piece = table.get(offset..table.len().min(offset + count)).ok_or(OUTSIDE);
                piece.map(|piece| [&(table.len() as u16).to_be_bytes(), piece].concat())
            }
            ("C", 8) => {
                let id = TableId { revision: long(0)?, crc: long(4)? };
                if !controller.write_commit(id) {
                    return None;
                }
                Ok(Vec::new())
            }
            _ => Err(UNKNOWN),
        })
    }

    fn answer(&self, sequence: u8, kind: char, payload: &[u8]) -> Vec<u8> {
        let digits: String = payload.iter().map(|byte| format!("{byte:02X}")).collect();
        let body = format!("{:02X}{sequence:02X}{kind}{:04X}{digits}", self.unit, payload.len());
        format!(":{body}{:08X}\r\n", crc_of(body.as_bytes())).into_bytes()
    }
}

impl Station for SerialStation {
    type Piece = Vec<u8>;

    fn hear(&mut self, piece: Vec<u8>, controller: &mut Controller<'_>) -> Vec<Vec<u8>> {
        let mut answers = Vec::new();
        for byte in piece {
            match byte {
                b':' => self.line = ":".into(),
                b'\r' if self.line.starts_with(':') => {
                    let text = std::mem::take(&mut self.line);
                    if !controller.is_deaf() {
                        answers.extend(self.frame(&text[1..], controller));
                    }
                }
                byte if byte.is_ascii_graphic() && !self.line.is_empty() && self.line.len() <= LONGEST => {
                    self.line.push(char::from(byte));
                }
                _ => self.line.clear(),
            }
        }
        answers
    }
}
