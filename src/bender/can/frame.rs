//! A CAN frame, and what else is heard on a bus: its conditions, as the kernel's error frames tell them. Pure.

use libc::{CAN_ERR_BUSOFF, CAN_ERR_CRTL, CAN_ERR_RESTARTED};

/// Longest data of a classic frame.
pub const CLASSIC_BYTES: usize = 8;

/// Lengths that a CAN FD frame can have beyond those of a classic one.
pub const FD_BYTES: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];

/// Bits of an error frame's second data byte: the controller's receiving or sending side is error-passive.
const PASSIVE: u8 = 0x30;

/// What a frame is called on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum FrameId {
    /// 11 bits.
    Standard(u16),
    /// 29 bits.
    Extended(u32),
}

impl std::fmt::Display for FrameId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            FrameId::Standard(id) => write!(f, "{id:03X}"),
            FrameId::Extended(id) => write!(f, "{id:08X}"),
        }
    }
}

/// A data frame. More than 8 bytes need CAN FD.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Its identifier.
    pub id: FrameId,
    /// Its data.
    pub data: Vec<u8>,
}

impl Frame {
    /// A frame; whether a bus can carry it is seen when it is sent.
    pub fn new(id: FrameId, data: impl Into<Vec<u8>>) -> Frame {
        Frame { id, data: data.into() }
    }

    /// Whether only CAN FD carries it.
    pub fn needs_fd(&self) -> bool {
        self.data.len() > CLASSIC_BYTES
    }

    /// Whether a frame can have this length.
    pub fn is_possible_length(bytes: usize) -> bool {
        bytes <= CLASSIC_BYTES || FD_BYTES.contains(&bytes)
    }
}

impl std::fmt::Display for Frame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}#", self.id)?;
        self.data.iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

/// How the bus, or the controller on it, is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Condition {
    /// The controller took itself off the bus after too many errors.
    BusOff,
    /// It is on the bus again.
    Restarted,
    /// Too many errors to take part as usual.
    ErrorPassive,
    /// Any other error that was seen on the bus; the kernel's class bits.
    Noise(u32),
}

impl Condition {
    /// From the class bits and the data of an error frame (linux/can/error.h). One that tells of several things is taken for the
    /// gravest of them.
    pub fn of_error_frame(classes: u32, data: &[u8]) -> Condition {
        if classes & CAN_ERR_BUSOFF != 0 {
            return Condition::BusOff;
        }
        if classes & CAN_ERR_RESTARTED != 0 {
            return Condition::Restarted;
        }
        let controller = data.get(1).copied().unwrap_or(0);
        if classes & CAN_ERR_CRTL != 0 && controller & PASSIVE != 0 {
            return Condition::ErrorPassive;
        }
        Condition::Noise(classes)
    }
}

/// What is heard on a bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Heard {
    /// A frame of another node.
    Frame(Frame),
    /// How the bus is doing.
    Condition(Condition),
}

/// Counts errors that come in storms: says how many there were since it said so last, once a second at most.
#[derive(Debug, Clone, Default)]
pub struct Storm {
    count: u64,
    said_ms: Option<u64>,
}

impl Storm {
    /// One more; the count, when it is time to say it.
    pub fn note(&mut self, now_ms: u64) -> Option<u64> {
        self.count += 1;
        if self.said_ms.is_some_and(|said| now_ms < said.saturating_add(1000)) {
            return None;
        }
        self.said_ms = Some(now_ms);
        Some(std::mem::take(&mut self.count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_frames_written_out_by_hand() {
        // The class bits of linux/can/error.h: controller 4, acknowledge 20h, bus-off 40h, bus error 80h, restarted 100h.
        let of = |classes, second: u8| Condition::of_error_frame(classes, &[0, second, 0, 0, 0, 0, 0, 0]);
        assert_eq!(of(0x40, 0), Condition::BusOff);
        assert_eq!(of(0x40 | 0x04, 0x30), Condition::BusOff, "the gravest of several");
        assert_eq!(of(0x100, 0), Condition::Restarted);
        assert_eq!(of(0x04, 0x10), Condition::ErrorPassive, "receiving");
        assert_eq!(of(0x04 | 0x200, 0x20), Condition::ErrorPassive, "sending, with counters");
        assert_eq!(of(0x04, 0x04), Condition::Noise(0x04), "a warning only");
        assert_eq!(of(0x20 | 0x80, 0), Condition::Noise(0xA0));
        assert_eq!(Condition::of_error_frame(0x04, &[]), Condition::Noise(0x04));
    }

    #[test]
    fn a_storm_is_said_once_a_second_and_none_of_it_is_lost() {
        let mut storm = Storm::default();
        let said: Vec<u64> = (0..10_000).filter_map(|ms| storm.note(5 + ms)).collect();
        assert_eq!(said, [1, 1000, 1000, 1000, 1000, 1000, 1000, 1000, 1000, 1000]);
        assert_eq!(storm.note(10_005), Some(1000));
    }

    #[test]
    fn frames_for_people_and_their_lengths() {
        assert_eq!(Frame::new(FrameId::Standard(0x31), [0xAB, 1]).to_string(), "031#AB01");
        assert_eq!(Frame::new(FrameId::Extended(0x31), []).to_string(), "00000031#");
        assert!([0, 8, 12, 64].into_iter().all(Frame::is_possible_length));
        assert!(![9, 13, 65].into_iter().any(Frame::is_possible_length));
    }
}
