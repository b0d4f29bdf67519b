//! What the targets share: an input read as a script, and the serial table's frames written from its contract, not from the decoder.

pub mod bus;

use benderd::bender::crc_of;

/// An input as a script: its bytes say, one after the other, what happens.
pub struct Script<'a>(&'a [u8]);

impl<'a> Script<'a> {
    pub fn new(input: &'a [u8]) -> Script<'a> {
        Script(input)
    }

    /// The next byte; none at the end.
    pub fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    /// The next byte; 0 behind the end.
    pub fn any(&mut self) -> u8 {
        self.byte().unwrap_or(0)
    }

    /// So many bytes; fewer at the end.
    pub fn take(&mut self, count: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(count.min(self.0.len()));
        self.0 = rest;
        taken
    }

    /// A length in one byte, then so many.
    pub fn piece(&mut self) -> &'a [u8] {
        let count = self.any();
        self.take(usize::from(count))
    }

    /// Two bytes, high one first.
    pub fn word(&mut self) -> u16 {
        u16::from_be_bytes([self.any(), self.any()])
    }

    /// Four bytes, high one first.
    pub fn long(&mut self) -> u32 {
        u32::from(self.word()) << 16 | u32::from(self.word())
    }

    /// All that is left.
    pub fn rest(&mut self) -> &'a [u8] {
        std::mem::take(&mut self.0)
    }
}

/// A frame of the serial table protocol.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    pub unit: u8,
    pub sequence: u8,
    pub kind: u8,
    pub payload: Vec<u8>,
}

impl Frame {
    /// With its CRC.
    pub fn encode(&self) -> Vec<u8> {
        let digits: String = self.payload.iter().map(|byte| format!("{byte:02X}")).collect();
        let (kind, length) = (char::from(self.kind), self.payload.len());
        sealed(format!("{:02X}{:02X}{kind}{length:04X}{digits}", self.unit, self.sequence).as_bytes())
    }

    /// Exactly one frame as the contract has it, from colon to carriage return.
    pub fn parse(bytes: &[u8]) -> Option<Frame> {
        let text = std::str::from_utf8(bytes).ok().filter(|text| text.is_ascii())?.strip_prefix(':')?;
        let text = text.strip_suffix("\r\n").or(text.strip_suffix('\r'))?;
        let (body, crc) = text.split_at_checked(text.len().checked_sub(8)?)?;
        let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit() || (b'A'..=b'F').contains(&b));
        let number = |text: &str| digits(text).then(|| u32::from_str_radix(text, 16).ok()).flatten();
        let payload = body.get(9..)?;
        let kind = *body.as_bytes().get(4)?;
        let fits = payload.len() == 2 * number(&body[5..9])? as usize && payload.len() <= 2 * 128;
        if number(crc)? != crc_of(body.as_bytes()) || !fits || !kind.is_ascii_uppercase() {
            return None;
        }
        Some(Frame {
            unit: number(&body[..2])? as u8,
            sequence: number(&body[2..4])? as u8,
            kind,
            payload: (0..payload.len() / 2)
                .map(|at| number(&payload[2 * at..2 * at + 2]).map(|byte| byte as u8))
                .collect::<Option<_>>()?,
        })
    }
}

/// A frame of these characters, with their CRC.
pub fn sealed(body: &[u8]) -> Vec<u8> {
    [b":", body, format!("{:08X}\r\n", crc_of(body)).as_bytes()].concat()
}
