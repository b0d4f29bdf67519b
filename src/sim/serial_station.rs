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

/// Bytes of an area in one request or answer.
const PIECE: usize = 124;

/// Capital hexadecimal digits, nothing else.
fn hex(digits: &str) -> Option<u8> {
    let capital = digits.bytes().all(|digit| matches!(digit, b'0'..=b'9' | b'A'..=b'F'));
    capital.then(|| u8::from_str_radix(digits, 16).ok()).flatten()
}

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
        if hex(body.get(0..2)?)? != self.unit {
            return None;
        }
        let (sequence, kind, digits) = (hex(body.get(2..4)?), body.get(4..5)?, body.get(9..)?);
        let payload: Option<Vec<u8>> =
            (0..digits.len()).step_by(2).map(|at| hex(digits.get(at..at + 2)?)).collect();
        let (Some(sequence), Some(payload)) = (sequence, payload) else { return garbled() };
        if body.get(5..9)? != format!("{:04X}", payload.len()) {
            return garbled();
        }
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
            ("W", 2..=126) => {
                let written = controller.model.write_staging(word(0)?, &payload[2..]);
                if written { Ok(Vec::new()) } else { Err(OUTSIDE) }
            }
            ("R" | "T", 4) if word(2)? > PIECE => Err(OUTSIDE),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::Profile;
    use crate::sim::bender::MachineModel;

    /// Kind, length and payload of the answer to a frame of these characters.
    fn answer(body: &str) -> Option<String> {
        let mut model = MachineModel::new(Profile::load("reference-serial").unwrap(), "P", 1);
        let mut mute = false;
        let mut controller = Controller::new(&mut model, None, &mut mute);
        let frame = format!(":{body}{:08X}\r\n", crc_of(body.as_bytes())).into_bytes();
        let answers = SerialStation::new(1).hear(frame, &mut controller);
        answers.first().map(|text| String::from_utf8_lossy(&text[5..text.len() - 10]).into_owned())
    }

    #[test]
    fn what_is_no_frame_of_the_contract_is_garbled_in_spite_of_its_crc() {
        assert_eq!(answer("0107R000400000002").as_deref(), Some("A00020000"));
        for (body, why) in [
            ("0107R000300000002", "another length than its payload has"),
            ("0107R00040000000", "half a byte"),
            ("0107R0004000000+2", "a sign is no digit"),
            ("01+7R000400000002", "nor in the number"),
            ("0107R00040000000a", "a small letter"),
        ] {
            assert_eq!(answer(body).as_deref(), Some("N000101"), "{why}");
        }
        assert_eq!(answer("0207R000400000002"), None, "another machine's");
    }

    #[test]
    fn no_answer_is_longer_than_a_frame() {
        assert!(answer("0107R00040000007C").unwrap().starts_with("A007C"));
        for kind in ["R", "T"] {
            assert_eq!(answer(&format!("0107{kind}00040000007D")).as_deref(), Some("N000102"));
        }
        assert_eq!(answer(&format!("0107W007F0000{}", "00".repeat(125))).as_deref(), Some("N000104"));
    }
}
