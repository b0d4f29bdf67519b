//! The status as one row of bytes, for machines without registers: serial tables, CAN, CANopen, shared folder.
//!
//! ```text
//!  0  identification        u32      16  active CRC             u32
//!  4  layout                u16      20  acknowledged revision  u32
//!  6  heartbeat             u16      24  acknowledgement        u16
//!  8  state                 u16      26  spare                  u16, 0
//! 10  bend count            u16      28  commit revision        u32
//! 12  active revision       u32      32  commit CRC             u32
//!                                    36  program                padded with zero
//! ```
//!
//! All high byte first.

use super::profile::{Profile, WordOrder};
use super::wire::{Ack, Status, TableId, check_constants, text_of, u32_at};

/// Where the program's name begins.
pub const PROGRAM: usize = 36;

/// Length of a status image.
pub fn status_bytes(profile: &Profile) -> usize {
    PROGRAM + profile.table.program_bytes
}

/// The status of an image; an error names the constant that is wrong.
pub fn decode_status_image(profile: &Profile, image: &[u8]) -> Result<Status, String> {
    let expected = status_bytes(profile);
    if image.len() != expected {
        return Err(format!("a status has {expected} bytes, found {}", image.len()));
    }
    let long = |at: usize| u32_at(WordOrder::Abcd, image, at);
    let word = |at: usize| u16::from_be_bytes([image[at], image[at + 1]]);
    check_constants(profile, ("the status", long(0)), ("the status", word(4)))?;
    Ok(Status {
        heartbeat: word(6),
        state: word(8),
        bend_count: word(10),
        active: TableId { revision: long(12), crc: long(16) },
        ack_revision: long(20),
        ack: Ack::from_code(word(24)),
        pending: TableId { revision: long(28), crc: long(32) },
        program: text_of(&image[PROGRAM..]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_written_out_by_hand() {
        let profile = Profile::load("reference-modbus").unwrap();
        let mut image = b"BEND\0\x01\x12\x34\0\x03\0\x02\0\0\0\x07\xAA\xBB\xCC\xDD\0\0\0\x08\0\x05\0\0\0\0\0\0\0\0\0\0AB-1".to_vec();
        image.resize(68, 0);
        let status = decode_status_image(&profile, &image).unwrap();
        assert_eq!((status.heartbeat, status.state, status.bend_count), (0x1234, 3, 2));
        assert_eq!(status.active, TableId { revision: 7, crc: 0xAABB_CCDD });
        assert_eq!((status.ack_revision, status.ack), (8, Ack::Refused(5)));
        assert_eq!((status.pending, status.program.as_str()), (TableId::default(), "AB-1"));
        assert!(decode_status_image(&profile, &image[1..]).unwrap_err().contains("68 bytes, found 67"));
        image[5] = 2;
        assert!(decode_status_image(&profile, &image).unwrap_err().contains("layout 2"));
        image[0] = 0;
        assert!(decode_status_image(&profile, &image).unwrap_err().contains("0x00454E44"));
    }
}
