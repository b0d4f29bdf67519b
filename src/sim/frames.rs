//! Modbus at the machine's end of a wire, RTU's frames and TCP's: bytes to requests, answers to bytes. Pure; written from the
//! standard (Modbus over serial line 1.02, messaging on TCP/IP 1.0b, application protocol 1.1b3), not from the client's library:
//! the two check each other.

/// Longest frame.
const LONGEST: usize = 256;

/// How a request is wrapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Framing {
    /// Unit, then the request, then a CRC.
    Rtu,
    /// A header of seven bytes with a transaction number and the length.
    Tcp,
}

/// Bytes of TCP's header.
const HEADER: usize = 7;

/// A request on the wire, whosever it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Heard {
    /// The unit that is asked.
    pub unit: u8,
    /// TCP's transaction number, which the answer repeats.
    pub transaction: u16,
    /// What for.
    pub request: Request,
}

/// What is asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// Function 3.
    Read {
        /// First register.
        address: u16,
        /// How many.
        count: u16,
    },
    /// Function 1.
    ReadCoils {
        /// First coil.
        address: u16,
        /// How many.
        count: u16,
    },
    /// Function 16.
    Write {
        /// First register.
        address: u16,
        /// Their values.
        words: Vec<u16>,
    },
    /// Any other function.
    Other {
        /// Its number.
        function: u8,
    },
}

impl Request {
    fn function(&self) -> u8 {
        match self {
            Request::ReadCoils { .. } => 1,
            Request::Read { .. } => 3,
            Request::Write { .. } => 16,
            Request::Other { function } => *function,
        }
    }
}

/// An answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// Registers that were read.
    Words(Vec<u16>),
    /// Coils that were read.
    Coils(Vec<bool>),
    /// A write was done.
    Written,
    /// An exception's number.
    Exception(u8),
}

/// The receiving side of a unit.
#[derive(Debug)]
pub struct Listener {
    framing: Framing,
    buffer: Vec<u8>,
}

impl Listener {
    /// Nothing heard yet.
    pub fn new(framing: Framing) -> Listener {
        Listener { framing, buffer: Vec::new() }
    }

    /// Takes what arrived; the requests that it completes. What is no frame waits for [`Listener::silence`].
    pub fn take(&mut self, bytes: &[u8]) -> Vec<Heard> {
        self.buffer.extend(bytes);
        let mut heard = Vec::new();
        while let Some(frame) = self.frame() {
            heard.extend(self.parse(&frame));
        }
        heard
    }

    /// The next frame, when it is complete.
    fn frame(&mut self) -> Option<Vec<u8>> {
        let length = match self.framing {
            Framing::Rtu => self.rtu_length()?,
            Framing::Tcp => self.tcp_length()?,
        };
        (self.buffer.len() >= length).then(|| self.buffer.drain(..length).collect())
    }

    fn parse(&mut self, frame: &[u8]) -> Option<Heard> {
        match self.framing {
            // Another protocol's number is no Modbus.
            Framing::Tcp if frame[2..4] != [0, 0] => None,
            Framing::Tcp => parse(u16::from_be_bytes([frame[0], frame[1]]), &frame[HEADER - 1..]),
            Framing::Rtu => {
                let (body, crc) = frame.split_at(frame.len() - 2);
                if crc16(body).to_le_bytes() == crc {
                    return parse(0, body);
                }
                self.buffer.clear();
                None
            }
        }
    }

    /// Nothing came for longer than a frame's gap: what is there is no frame, or one cut short. TCP knows no gaps.
    pub fn silence(&mut self) {
        if self.framing == Framing::Rtu {
            self.buffer.clear();
        }
    }

    /// Whether part of a frame is there.
    pub fn is_amid(&self) -> bool {
        !self.buffer.is_empty()
    }

    /// Length of the frame that begins here, as soon as that is known.
    fn rtu_length(&self) -> Option<usize> {
        match self.buffer.get(1)? {
            1 | 3 => Some(8),
            16 => self.buffer.get(6).map(|bytes| 9 + usize::from(*bytes)),
            // Unknown functions end with the silence; up to then nobody can tell.
            _ => (self.buffer.len() >= 4).then(|| self.buffer.len().min(LONGEST)),
        }
    }

    /// The same over TCP; what announces an impossible length is thrown away.
    fn tcp_length(&mut self) -> Option<usize> {
        let announced = usize::from(u16::from_be_bytes([*self.buffer.get(4)?, *self.buffer.get(5)?]));
        if !(2..LONGEST).contains(&announced) {
            self.buffer.clear();
            return None;
        }
        Some(HEADER - 1 + announced)
    }
}

/// Unit and request.
fn parse(transaction: u16, body: &[u8]) -> Option<Heard> {
    let word = |at: usize| Some(u16::from_be_bytes([*body.get(at)?, *body.get(at + 1)?]));
    let request = match *body.get(1)? {
        // What has another length than its function or its counts say is not the request that it seems to be.
        1 | 3 if body.len() != 6 => return None,
        1 => Request::ReadCoils { address: word(2)?, count: word(4)? },
        3 => Request::Read { address: word(2)?, count: word(4)? },
        16 => {
            let bytes = body.get(7..)?;
            let words: Vec<u16> =
                bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect();
            let fits = bytes.len() == usize::from(body[6]) && bytes.len() == 2 * usize::from(word(4)?);
            fits.then_some(Request::Write { address: word(2)?, words })?
        }
        function => Request::Other { function },
    };
    Some(Heard { unit: *body.first()?, transaction, request })
}

/// An answer as bytes.
pub fn encode(framing: Framing, heard: &Heard, answer: &Answer) -> Vec<u8> {
    let function = heard.request.function();
    let mut out = vec![heard.unit];
    match (answer, &heard.request) {
        (Answer::Words(words), _) => {
            out.extend([function, (2 * words.len()) as u8]);
            out.extend(words.iter().flat_map(|word| word.to_be_bytes()));
        }
        (Answer::Coils(coils), _) => {
            let byte =
                |bits: &[bool]| bits.iter().enumerate().map(|(i, bit)| u8::from(*bit) << i).sum::<u8>();
            let bytes: Vec<u8> = coils.chunks(8).map(byte).collect();
            out.extend([function, bytes.len() as u8]);
            out.extend(bytes);
        }
        (Answer::Written, Request::Write { address, words }) => {
            out.push(function);
            out.extend(address.to_be_bytes());
            out.extend((words.len() as u16).to_be_bytes());
        }
        (Answer::Written, _) => out.extend([function | 0x80, 4]),
        (Answer::Exception(code), _) => out.extend([function | 0x80, *code]),
    }
    match framing {
        Framing::Rtu => {
            let crc = crc16(&out);
            out.extend(crc.to_le_bytes());
            out
        }
        Framing::Tcp => {
            let [high, low] = (out.len() as u16).to_be_bytes();
            let [first, second] = heard.transaction.to_be_bytes();
            [&[first, second, 0, 0, high, low], &out[..]].concat()
        }
    }
}

/// CRC-16 of Modbus: reflected polynomial 0xA001, start 0xFFFF.
pub fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Unit 17 is asked for registers 107 to 109.
    const READ: [u8; 8] = [0x11, 0x03, 0x00, 0x6B, 0x00, 0x03, 0x76, 0x87];

    #[test]
    fn frames_written_out_by_hand() {
        assert_eq!(crc16(b"123456789"), 0x4B37, "the check value of CRC-16/MODBUS");
        let heard = Listener::new(Framing::Rtu).take(&READ).remove(0);
        assert_eq!(
            heard,
            Heard { unit: 17, transaction: 0, request: Request::Read { address: 107, count: 3 } }
        );
        let answer = encode(Framing::Rtu, &heard, &Answer::Words(vec![0xAE41, 0x5652, 0x4340]));
        assert_eq!(answer, [0x11, 0x03, 0x06, 0xAE, 0x41, 0x56, 0x52, 0x43, 0x40, 0x49, 0xAD]);
        assert_eq!(encode(Framing::Rtu, &heard, &Answer::Exception(2))[..3], [0x11, 0x83, 2]);
    }

    #[test]
    fn the_same_over_tcp() {
        let request = [0x12, 0x34, 0, 0, 0, 6, 0x11, 0x03, 0x00, 0x6B, 0x00, 0x03];
        let mut listener = Listener::new(Framing::Tcp);
        assert_eq!(listener.take(&request[..9]), []);
        listener.silence();
        let heard = listener.take(&request[9..]).remove(0);
        assert_eq!(
            heard,
            Heard { unit: 17, transaction: 0x1234, request: Request::Read { address: 107, count: 3 } }
        );
        let answer = encode(Framing::Tcp, &heard, &Answer::Words(vec![0xAE41]));
        assert_eq!(answer, [0x12, 0x34, 0, 0, 0, 5, 0x11, 0x03, 0x02, 0xAE, 0x41]);
    }

    #[test]
    fn a_broken_frame_is_not_answered_and_the_next_one_is() {
        let mut listener = Listener::new(Framing::Rtu);
        let mut broken = READ;
        broken[3] ^= 1;
        assert_eq!(listener.take(&broken), []);
        assert_eq!(listener.take(&READ).len(), 1);
        assert_eq!(listener.take(&READ[..5]), []);
        listener.silence();
        assert_eq!(listener.take(&READ).len(), 1);
    }

    #[test]
    fn two_requests_in_one_piece_are_both_heard() {
        let one = |transaction| [0, transaction, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1];
        let heard = Listener::new(Framing::Tcp).take(&[one(1), one(2)].concat());
        assert_eq!(heard.iter().map(|heard| heard.transaction).collect::<Vec<_>>(), [1, 2]);
    }

    #[test]
    fn counts_and_lengths_that_disagree_are_no_request() {
        let tcp = |protocol: u8, body: &[u8]| {
            let frame = [&[0, 7, 0, protocol, 0, body.len() as u8], body].concat();
            Listener::new(Framing::Tcp).take(&frame).len()
        };
        let write = [1, 16, 0, 0, 0, 1, 2, 0xAB, 0xCD];
        assert_eq!((tcp(0, &write), tcp(1, &write)), (1, 0), "another protocol");
        assert_eq!(tcp(0, &[1, 16, 0, 0, 0, 1, 4, 0xAB, 0xCD]), 0, "more bytes announced");
        assert_eq!(tcp(0, &[1, 16, 0, 0, 0, 1, 3, 0xAB, 0xCD, 0xEF]), 0, "half a register");
        assert_eq!(tcp(0, &[1, 3, 0, 0, 0, 1, 0]), 0, "a read with more behind it");
        let mut odd = vec![1, 16, 0, 0, 0, 1, 3, 0xAB, 0xCD, 0xEF];
        odd.extend(crc16(&odd).to_le_bytes());
        assert_eq!(Listener::new(Framing::Rtu).take(&odd), []);
    }

    proptest! {
        #[test]
        fn a_write_arrives_in_whatever_pieces(address in any::<u16>(), words in proptest::collection::vec(any::<u16>(), 1..123), cut in 1..20_usize) {
            let mut frame = vec![1, 16];
            frame.extend(address.to_be_bytes());
            frame.extend((words.len() as u16).to_be_bytes());
            frame.push(2 * words.len() as u8);
            frame.extend(words.iter().flat_map(|w| w.to_be_bytes()));
            let crc = crc16(&frame);
            frame.extend(crc.to_le_bytes());
            let mut listener = Listener::new(Framing::Rtu);
            let heard: Vec<Heard> = frame.chunks(cut).flat_map(|piece| listener.take(piece)).collect();
            prop_assert_eq!(&heard, &[Heard { unit: 1, transaction: 0, request: Request::Write { address, words } }]);
        }

        #[test]
        fn no_bytes_do_harm(bytes in proptest::collection::vec(any::<u8>(), 0..600), cut in 1..50_usize) {
            for framing in [Framing::Rtu, Framing::Tcp] {
                let mut listener = Listener::new(framing);
                for piece in bytes.chunks(cut) {
                    listener.take(piece);
                    prop_assert!(listener.buffer.len() <= 600);
                }
            }
        }
    }
}
