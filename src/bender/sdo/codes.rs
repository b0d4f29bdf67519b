//! What a transfer's abort codes mean, and the checksum over a block transfer (CiA 301, 7.2.4.3).

/// The toggle bit did not alternate.
pub const TOGGLE: u32 = 0x0503_0000;
/// No answer in time.
pub const TIMED_OUT: u32 = 0x0504_0000;
/// The command is not known: a server without block transfer says so.
pub const UNKNOWN_COMMAND: u32 = 0x0504_0001;
/// A block of 0 or more than 127 segments.
pub const BLOCK_SIZE: u32 = 0x0504_0002;
/// More segments acknowledged than sent.
pub const SEQUENCE: u32 = 0x0504_0003;
/// The checksum is another.
pub const CHECKSUM: u32 = 0x0504_0004;
/// More data than can be.
pub const NO_MEMORY: u32 = 0x0504_0005;
/// More or fewer bytes than announced.
pub const LENGTH: u32 = 0x0607_0010;
/// The device cannot do it now: it may be asked again.
pub const DEVICE_STATE: u32 = 0x0800_0022;

/// A code in words.
pub fn meaning(code: u32) -> &'static str {
    match code {
        TOGGLE => "the toggle bit did not alternate: a segment was lost or came twice",
        TIMED_OUT => "no answer in time",
        UNKNOWN_COMMAND => "the command is not known",
        BLOCK_SIZE => "a block of so many segments is not allowed",
        SEQUENCE => "a sequence number is wrong",
        CHECKSUM => "the checksum is another",
        NO_MEMORY => "not enough memory",
        0x0601_0000 => "the object cannot be accessed so",
        0x0601_0001 => "the object can only be written",
        0x0601_0002 => "the object can only be read",
        0x0602_0000 => {
            "there is no such object; check status, staging, commit and active in the profile's [canopen]"
        }
        0x0604_0041 | 0x0604_0042 | 0x0604_0043 | 0x0604_0047 => "the device's parameters do not allow it",
        0x0606_0000 => "a fault of the device's hardware",
        LENGTH => "the length is not that of the object",
        0x0607_0012 => "more bytes than the object has",
        0x0607_0013 => "fewer bytes than the object has",
        0x0609_0011 => "there is no such subindex",
        0x0609_0030..=0x0609_0032 => "the value is outside its range",
        0x060A_0023 => "a resource is not there",
        0x0800_0020 => "the device could not store or fetch the data",
        0x0800_0021 => "the device is under local control",
        DEVICE_STATE => "not in the device's present state",
        0x0800_0023 => "the device has no object dictionary",
        0x0800_0024 => "there is no data",
        0x0800_0000 => "no reason given",
        _ => "a code that CiA 301 does not name",
    }
}

/// The checksum of a block transfer: polynomial 1021h, start 0, highest bit first.
pub fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0, |crc, byte| {
        (0..8).fold(
            crc ^ u16::from(*byte) << 8,
            |crc, _| if crc & 0x8000 == 0 { crc << 1 } else { crc << 1 ^ 0x1021 },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_of_the_usual_nine_characters() {
        assert_eq!(crc16(b"123456789"), 0x31C3);
    }
}
