//! CAN databases (DBC): which bits of which frame are which value. Raw values only: a count of steps is what goes into a table.
//!
//! Read when a profile is loaded; `can_table` takes from it the messages of its contract.

use can_dbc::{ByteOrder, Dbc, MessageId, MultiplexIndicator, ValueType};
use thiserror::Error;

use super::can::{Frame, FrameId};

/// The widest signal that is read: one that reaches over no more than nine bytes.
const WIDEST_BITS: usize = 63;

/// Why a database is of no use.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum DbcError {
    /// It is no DBC.
    #[error("not a CAN database (DBC): {0}")]
    Syntax(String),
    /// Something that is needed is not there.
    #[error("{what} is missing; the database has {found}")]
    Missing {
        /// What, by name.
        what: String,
        /// What there is instead.
        found: String,
    },
    /// Something is there and does not fit.
    #[error("{what} {found}, allowed is {allowed}")]
    Unfit {
        /// What, by name.
        what: String,
        /// What it is.
        found: String,
        /// What it may be.
        allowed: String,
    },
}

/// A database.
pub struct Database {
    dbc: Dbc,
}

/// One message with its signals.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// Its name.
    pub name: String,
    /// The identifier of its frames.
    pub id: FrameId,
    /// The length of its frames' data.
    pub bytes: usize,
    signals: Vec<Signal>,
}

/// Some bits of a message.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Its name.
    pub name: String,
    /// The first bit, counted as DBC does: the least significant in little-endian order, the most significant in big-endian.
    pub start: usize,
    /// How many.
    pub bits: usize,
    /// Whether the most significant bit comes first (Motorola's order).
    pub big_endian: bool,
    /// Two's complement.
    pub signed: bool,
    /// The unit's worth of one step.
    pub factor: f64,
    /// What raw 0 stands for.
    pub offset: f64,
    /// When it is there.
    pub presence: Presence,
}

/// When a signal is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Presence {
    /// Always.
    Always,
    /// Always, and it says which of the others are.
    Switch,
    /// When the switch has this value.
    When(i64),
}

impl Database {
    /// Reads a database.
    pub fn parse(text: &str) -> Result<Database, DbcError> {
        let dbc = Dbc::try_from(text).map_err(|e| DbcError::Syntax(e.to_string().trim().to_owned()))?;
        Ok(Database { dbc })
    }

    /// A message by its name, if all of it can be used.
    pub fn message(&self, name: &str) -> Result<Message, DbcError> {
        let Some(found) = self.dbc.messages.iter().find(|message| message.name == name) else {
            let names: Vec<&str> = self.dbc.messages.iter().map(|m| m.name.as_str()).take(20).collect();
            let found = if names.is_empty() { "no messages".to_owned() } else { names.join(", ") };
            return Err(DbcError::Missing { what: format!("message {name}"), found });
        };
        let (id, in_range) = match found.id {
            MessageId::Standard(id) => (FrameId::Standard(id), id <= 0x7FF),
            MessageId::Extended(id) => (FrameId::Extended(id), id <= 0x1FFF_FFFF),
        };
        let bytes = usize::try_from(found.size).unwrap_or(usize::MAX);
        if !in_range || !Frame::is_possible_length(bytes) {
            return Err(DbcError::Unfit {
                what: format!("message {name}"),
                found: format!("has the identifier {id} and {bytes} bytes"),
                allowed: "an identifier of 11 or 29 bits and a length that CAN or CAN FD has".into(),
            });
        }
        let signals = found.signals.iter().map(|signal| read_signal(name, bytes, signal));
        Ok(Message { name: name.to_owned(), id, bytes, signals: signals.collect::<Result<_, _>>()? })
    }
}

fn read_signal(message: &str, bytes: usize, found: &can_dbc::Signal) -> Result<Signal, DbcError> {
    let what = format!("signal {} of message {message}", found.name);
    let unfit =
        |found: String, allowed: &str| DbcError::Unfit { what: what.clone(), found, allowed: allowed.into() };
    let whole = |number: u64| usize::try_from(number).unwrap_or(usize::MAX);
    let signal = Signal {
        name: found.name.clone(),
        start: whole(found.start_bit),
        bits: whole(found.size),
        big_endian: found.byte_order == ByteOrder::BigEndian,
        signed: found.value_type == ValueType::Signed,
        factor: found.factor,
        offset: found.offset,
        presence: match found.multiplexer_indicator {
            MultiplexIndicator::Plain => Presence::Always,
            MultiplexIndicator::Multiplexor => Presence::Switch,
            MultiplexIndicator::MultiplexedSignal(case) => Presence::When(i64::try_from(case).unwrap_or(-1)),
            MultiplexIndicator::MultiplexorAndMultiplexedSignal(_) => {
                return Err(unfit("is multiplexed and a multiplexer".into(), "one multiplexer a message"));
            }
        },
    };
    if !(1..=WIDEST_BITS).contains(&signal.bits) || signal.last().is_none_or(|last| last >= 8 * bytes) {
        let found = format!("has {} bits from bit {}", signal.bits, signal.start);
        return Err(unfit(found, &format!("1 to {WIDEST_BITS} bits within the message's {bytes} bytes")));
    }
    Ok(signal)
}

impl Message {
    /// A signal by its name.
    pub fn signal(&self, name: &str) -> Result<&Signal, DbcError> {
        self.signals.iter().find(|signal| signal.name == name).ok_or_else(|| DbcError::Missing {
            what: format!("signal {name} of message {}", self.name),
            found: self.signals.iter().map(|s| s.name.as_str()).collect::<Vec<_>>().join(", "),
        })
    }

    /// The signal that says which others are there.
    pub fn switch(&self) -> Option<&Signal> {
        self.signals.iter().find(|signal| signal.presence == Presence::Switch)
    }

    /// A frame of it with these signals, all other bits 0. The name of a signal that is not there or too narrow for its value.
    pub fn pack(&self, values: &[(&str, i64)]) -> Result<Frame, DbcError> {
        let mut data = vec![0; self.bytes];
        for (name, raw) in values {
            let signal = self.signal(name)?;
            if !signal.pack(&mut data, *raw) {
                return Err(DbcError::Unfit {
                    what: format!("signal {name} of message {}", self.name),
                    found: format!("would be {raw}"),
                    allowed: format!("what its {} bits hold", signal.bits),
                });
            }
        }
        Ok(Frame::new(self.id, data))
    }

    /// The value of a signal, if the frame is one of this message, long enough, and has it.
    pub fn unpack(&self, frame: &Frame, name: &str) -> Option<i64> {
        if frame.id != self.id || frame.data.len() < self.bytes {
            return None;
        }
        let signal = self.signals.iter().find(|signal| signal.name == name)?;
        match signal.presence {
            Presence::When(case) if self.switch()?.unpack(&frame.data)? != case => None,
            _ => signal.unpack(&frame.data),
        }
    }
}

impl Signal {
    /// First and last bit in an order in which a number's bits follow each other: each byte's from its least significant bit on, in
    /// big-endian order from its most significant one.
    fn span(&self) -> Option<(usize, usize)> {
        if self.big_endian {
            let first = self.start / 8 * 8 + (7 - self.start % 8);
            Some((first, first.checked_add(self.bits)?.checked_sub(1)?))
        } else {
            Some((self.start, self.start.checked_add(self.bits)?.checked_sub(1)?))
        }
    }

    /// The last bit that it covers, in the order of [`Signal::span`].
    fn last(&self) -> Option<usize> {
        self.start.checked_add(8)?; // no position can overflow
        self.span().map(|(_, last)| last)
    }

    /// The bytes that it covers as one number, the place of its least significant bit in that, and where they are.
    fn window(&self, data: &[u8]) -> Option<(u128, usize, std::ops::RangeInclusive<usize>)> {
        let (first, last) = self.span()?;
        let bytes = first / 8..=last / 8;
        let covered = data.get(bytes.clone())?;
        let fold = |number: u128, byte: &u8| number << 8 | u128::from(*byte);
        Some(if self.big_endian {
            (covered.iter().fold(0, fold), 7 - last % 8, bytes)
        } else {
            (covered.iter().rev().fold(0, fold), first % 8, bytes)
        })
    }

    fn mask(&self) -> u128 {
        (1 << self.bits) - 1
    }

    /// Its value in a frame's data, if that is long enough.
    pub fn unpack(&self, data: &[u8]) -> Option<i64> {
        let (number, shift, _) = self.window(data)?;
        let raw = (number >> shift & self.mask()) as i64;
        let unused = 64 - self.bits;
        Some(if self.signed { raw << unused >> unused } else { raw })
    }

    /// Puts a value into a frame's data; false when the value or the data is no match.
    pub fn pack(&self, data: &mut [u8], raw: i64) -> bool {
        let (least, most) = if self.signed {
            (-(1_i64 << (self.bits - 1)), (1_i64 << (self.bits - 1)) - 1)
        } else {
            (0, self.mask() as i64)
        };
        let Some((number, shift, bytes)) = self.window(data).filter(|_| (least..=most).contains(&raw)) else {
            return false;
        };
        let number = number & !(self.mask() << shift) | (raw as u128 & self.mask()) << shift;
        let all = number.to_be_bytes();
        let count = bytes.end() - bytes.start() + 1;
        let covered = &all[all.len() - count..];
        for (byte, place) in data[bytes].iter_mut().zip(0..count) {
            *byte = covered[if self.big_endian { place } else { count - 1 - place }];
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SHIPPED: &str = include_str!("../../protocols/bender.dbc");

    fn signal(start: usize, bits: usize, big_endian: bool, signed: bool) -> Signal {
        let (factor, offset, presence) = (1.0, 0.0, Presence::Always);
        Signal { name: "S".into(), start, bits, big_endian, signed, factor, offset, presence }
    }

    /// Where bit k of a number lies (byte, bit), one step at a time as the DBC's numbering has it.
    fn place(signal: &Signal, k: usize) -> (usize, usize) {
        let mut at = signal.start;
        if signal.big_endian {
            for _ in k..signal.bits - 1 {
                at = if at.is_multiple_of(8) { at + 15 } else { at - 1 };
            }
        } else {
            at += k;
        }
        (at / 8, at % 8)
    }

    #[test]
    fn frames_written_out_by_hand() {
        let database = Database::parse(SHIPPED).unwrap();
        let item = database.message("TABLE_ITEM").unwrap();
        assert_eq!((item.id, item.bytes), (FrameId::Standard(0x320), 8));
        // Length of row 2, to be written to the staging area: -123.45 mm, in steps of 0.01.
        let frame = item.pack(&[("Item", 4), ("Operation", 1), ("Row", 2), ("Length", -12_345)]).unwrap();
        assert_eq!(frame.to_string(), "320#04010200C7CFFFFF");
        assert_eq!(item.unpack(&frame, "Length"), Some(-12_345));
        assert_eq!(item.unpack(&frame, "Angle"), None, "another value of the multiplexer");
        let state = database.message("STATUS_STATE").unwrap();
        let frame = Frame::new(state.id, [7, 1, 0x34, 0x12, 3, 0, 40, 0]);
        let values =
            ["Cycle", "Layout", "Heartbeat", "State", "BendCount"].map(|n| state.unpack(&frame, n).unwrap());
        assert_eq!(values, [7, 1, 0x1234, 3, 40]);
        assert_eq!(state.unpack(&Frame::new(state.id, [7; 7]), "Cycle"), None, "too short");
        // The classic example of Motorola's order: 12 bits whose most significant is bit 3 of byte 0.
        let motorola = signal(3, 12, true, false);
        assert_eq!(motorola.unpack(&[0xFA, 0xBC]), Some(0xABC));
        let mut data = [0xF0, 0x00];
        assert!(motorola.pack(&mut data, 0x123));
        assert_eq!(data, [0xF1, 0x23]);
    }

    #[test]
    fn what_is_missing_or_does_not_fit_is_named() {
        let database = Database::parse(SHIPPED).unwrap();
        let text = database.message("TABLE_ITME").unwrap_err().to_string();
        assert!(text.starts_with("message TABLE_ITME is missing; the database has STATUS_STATE, "), "{text}");
        let item = database.message("TABLE_ITEM").unwrap();
        let text = item.signal("Feed").unwrap_err().to_string();
        assert!(
            text.contains("signal Feed of message TABLE_ITEM is missing") && text.contains("LastLength"),
            "{text}"
        );
        let text = item.pack(&[("Row", 256)]).unwrap_err().to_string();
        assert_eq!(text, "signal Row of message TABLE_ITEM would be 256, allowed is what its 8 bits hold");
        let complaint = |from: &str, to: &str| {
            assert!(SHIPPED.contains(from), "{from}");
            Database::parse(&SHIPPED.replacen(from, to, 1))
                .unwrap()
                .message("STATUS_STATE")
                .unwrap_err()
                .to_string()
        };
        let text = complaint("Heartbeat : 16|16@1+", "Heartbeat : 56|16@1+");
        assert!(text.contains("signal Heartbeat of message STATUS_STATE has 16 bits from bit 56"), "{text}");
        assert!(complaint("STATUS_STATE: 8", "STATUS_STATE: 9").contains("9 bytes"));
        assert!(complaint("Cycle : 0|8@1+", "Cycle m1M : 0|8@1+").contains("one multiplexer"));
        assert!(complaint("BO_ 784 ", "BO_ 4096 ").contains("identifier 1000"));
        assert!(Database::parse("BO_ twelve").is_err_and(|e| e.to_string().contains("not a CAN database")));
    }

    proptest! {
        #[test]
        fn a_value_lies_where_it_does_bit_by_bit(
            start in 0..512_usize, bits in 1..=63_usize, big_endian: bool, signed: bool, value: i64,
            before in proptest::collection::vec(any::<u8>(), 64),
        ) {
            let s = signal(start, bits, big_endian, signed);
            let fits = (0..bits).all(|k| place(&s, k).0 < 64);
            prop_assert_eq!(s.last().is_some_and(|last| last < 512), fits);
            prop_assume!(fits);
            let unused = 64 - bits as u32;
            let raw = if signed { value << unused >> unused } else { (value as u64 >> unused) as i64 };
            let mut data = before.clone();
            prop_assert!(s.pack(&mut data, raw));
            let mut expected = before;
            for k in 0..bits {
                let (byte, bit) = place(&s, k);
                expected[byte] = expected[byte] & !(1 << bit) | ((raw >> k & 1) as u8) << bit;
            }
            prop_assert_eq!(&data, &expected);
            prop_assert_eq!(s.unpack(&data), Some(raw));
            // One more than it holds; of 63 bits that is negative.
            let beyond = 1 << (bits - usize::from(signed));
            prop_assert!(!s.pack(&mut data, beyond), "{}", beyond);
        }

        #[test]
        fn no_text_does_harm(
            text in ".{0,200}", at in 0..6000_usize, cut in 0..40_usize, put in "[ -~\n]{0,10}",
        ) {
            let _ = Database::parse(&text);
            let at = at.min(SHIPPED.len());
            let damaged = format!("{}{put}{}", &SHIPPED[..at], &SHIPPED[(at + cut).min(SHIPPED.len())..]);
            if let Ok(database) = Database::parse(&damaged) {
                for name in ["STATUS_STATE", "STATUS_ITEM", "TABLE_ITEM", "TABLE_ROW"] {
                    if let Ok(message) = database.message(name) {
                        let frame = Frame::new(message.id, vec![0xA5; message.bytes]);
                        message.signals.iter().for_each(|s| _ = message.unpack(&frame, &s.name));
                    }
                }
            }
        }
    }
}
