//! Frames of the serial table protocol (protocols/serial-table.md): bytes of a line to frames and back. Pure.
//!
//! ```text
//! :  unit  sequence  kind  length  payload         CRC-32    CR LF
//!    2     2         1     4       2 for each byte  8
//! ```
//!
//! All hexadecimal digits, so the colon is nowhere but at a beginning: after whatever garbage, the next frame is found there.

use super::wire::crc_of;

/// Bytes of payload, at most.
pub const MOST_PAYLOAD: usize = 128;

/// Characters between the colon and the payload.
const HEAD: usize = 9;

/// Characters behind the payload: the CRC.
const TAIL: usize = 8;

/// One frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// The machine on the line.
    pub unit: u8,
    /// Which request it is, or is the answer to.
    pub sequence: u8,
    /// A letter: what for.
    pub kind: u8,
    /// What the kind says, at most [`MOST_PAYLOAD`] bytes.
    pub payload: Vec<u8>,
}

impl Frame {
    /// As characters.
    pub fn encode(&self) -> Vec<u8> {
        let mut text = format!(
            "{:02X}{:02X}{}{:04X}",
            self.unit,
            self.sequence,
            char::from(self.kind),
            self.payload.len()
        );
        for byte in &self.payload {
            text.push_str(&format!("{byte:02X}"));
        }
        let crc = crc_of(text.as_bytes());
        format!(":{text}{crc:08X}\r\n").into_bytes()
    }

    /// From the characters between colon and carriage return.
    fn decode(text: &[u8]) -> Option<Frame> {
        let (body, crc) = text.split_at_checked(text.len().checked_sub(TAIL)?)?;
        if number(crc)? != crc_of(body) || body.len() < HEAD {
            return None;
        }
        let (head, digits) = body.split_at(HEAD);
        let payload: Vec<u8> =
            digits.chunks(2).map(|pair| number(pair).map(|value| value as u8)).collect::<Option<_>>()?;
        let kind = head[4];
        let fits = digits.len() % 2 == 0 && number(&head[5..])? as usize == payload.len();
        (fits && kind.is_ascii_uppercase() && payload.len() <= MOST_PAYLOAD).then_some(Frame {
            unit: number(&head[..2])? as u8,
            sequence: number(&head[2..4])? as u8,
            kind,
            payload,
        })
    }
}

/// Capital hexadecimal digits, at most eight.
fn number(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0_u32, |value, digit| {
        let digit = match digit {
            b'0'..=b'9' => digit - b'0',
            b'A'..=b'F' => digit - b'A' + 10,
            _ => return None,
        };
        Some(value << 4 | u32::from(digit))
    })
}

/// Finds frames in what arrives.
#[derive(Debug, Default)]
pub struct Decoder {
    /// Since the last colon.
    text: Option<Vec<u8>>,
}

impl Decoder {
    /// Takes what arrived; the frames that it completes. What is no frame is skipped.
    pub fn take(&mut self, bytes: &[u8]) -> Vec<Frame> {
        let mut frames = Vec::new();
        for byte in bytes {
            match (byte, &mut self.text) {
                (b':', text) => *text = Some(Vec::new()),
                (b'\r', Some(text)) => {
                    frames.extend(Frame::decode(text));
                    self.text = None;
                }
                (byte, Some(text)) if text.len() < HEAD + 2 * MOST_PAYLOAD + TAIL => text.push(*byte),
                (_, text) => *text = None, // outside of a frame, or longer than any
            }
        }
        frames
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_frame_written_out_by_hand() {
        let frame = Frame { unit: 1, sequence: 0x2A, kind: b'R', payload: vec![0, 126, 0, 64] };
        // CRC-32 of "012AR0004007E0040", by zlib's crc32.
        assert_eq!(frame.encode(), b":012AR0004007E0040B430AC22\r\n");
        assert_eq!(Decoder::default().take(b":012AR0004007E0040B430AC22\r\n"), [frame]);
    }

    #[test]
    fn after_garbage_half_frames_and_damage_the_next_frame_is_found() {
        let frame = Frame { unit: 1, sequence: 7, kind: b'S', payload: vec![] };
        let whole = frame.encode();
        let mut damaged = whole.clone();
        damaged[4] ^= 1;
        for before in [&b"\x00\xFFnoise\r\n"[..], &whole[..8], &damaged, b":::", &[b'A'; 1000]] {
            let mut decoder = Decoder::default();
            let mut frames = decoder.take(before);
            frames.extend(decoder.take(&whole));
            assert_eq!(frames, std::slice::from_ref(&frame), "{before:?}");
        }
    }

    proptest! {
        #[test]
        fn a_frame_arrives_in_whatever_pieces(
            unit: u8, sequence: u8, kind in b'A'..=b'Z',
            payload in prop::collection::vec(any::<u8>(), 0..=MOST_PAYLOAD), cut in 1..30_usize,
        ) {
            let frame = Frame { unit, sequence, kind, payload };
            let mut decoder = Decoder::default();
            let found: Vec<Frame> = frame.encode().chunks(cut).flat_map(|piece| decoder.take(piece)).collect();
            prop_assert_eq!(found, [frame]);
        }

        #[test]
        fn any_bytes_do_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
            let mut decoder = Decoder::default();
            decoder.take(&bytes);
            prop_assert!(decoder.text.is_none_or(|text| text.len() <= HEAD + 2 * MOST_PAYLOAD + TAIL));
        }

        #[test]
        fn one_flipped_bit_is_never_another_frame(at in 0..40_usize, bit in 0..8_u8) {
            let frame = Frame { unit: 1, sequence: 9, kind: b'W', payload: vec![1, 2, 3, 4, 5, 6] };
            let mut bytes = frame.encode();
            let at = at % bytes.len();
            bytes[at] ^= 1 << bit;
            let found = Decoder::default().take(&bytes);
            prop_assert!(found.is_empty() || found == [frame], "{found:?}"); // the line feed counts for nothing
        }
    }
}
