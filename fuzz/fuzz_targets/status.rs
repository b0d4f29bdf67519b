//! Statuses of any bytes, from registers and as an image: what is decoded stands where the contracts say.

#![no_main]

use std::sync::LazyLock;

use benderd::bender::folder_text::StatusText;
use benderd::bender::{
    Ack, Profile, Status, TableId, decode_status, decode_status_image, status_bytes, status_span,
};
use benderd_fuzz::Script;
use libfuzzer_sys::fuzz_target;

static MODBUS: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-modbus").unwrap());
static SERIAL: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-serial").unwrap());

const IDENTIFIED: [u8; 6] = [0x42, 0x45, 0x4E, 0x44, 0, 1];

/// Where the values begin, in bytes: state, bend count, program, active revision and CRC, acknowledged revision, acknowledgement,
/// commit.
struct Places([usize; 8]);

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_be_bytes([bytes[at], bytes[at + 1]])
}

fn long(bytes: &[u8], at: usize) -> u32 {
    u32::from(word(bytes, at)) << 16 | u32::from(word(bytes, at + 2))
}

fn check(status: &Status, bytes: &[u8], places: Places) {
    let Places([state, bends, program, revision, crc, acknowledged, code, commit]) = places;
    assert_eq!((status.heartbeat, status.state), (word(bytes, 6), word(bytes, state)));
    assert_eq!(status.bend_count, word(bytes, bends));
    assert_eq!(status.active, TableId { revision: long(bytes, revision), crc: long(bytes, crc) });
    assert_eq!(status.pending, TableId { revision: long(bytes, commit), crc: long(bytes, commit + 4) });
    assert_eq!(
        (status.ack_revision, status.ack),
        (long(bytes, acknowledged), Ack::from_code(word(bytes, code)))
    );
    let name = &bytes[program..program + 32];
    assert!(status.program.len() <= 32 && status.program.bytes().all(|b| (b' '..=b'~').contains(&b)));
    assert!(name.iter().zip(status.program.bytes()).all(|(there, found)| *there == found || found == b'?'));
}

fn registers(bytes: &[u8]) {
    let map = MODBUS.transport.modbus().unwrap();
    assert_eq!(status_span(&MODBUS, map), (0, 36));
    let found = decode_status(&MODBUS, map, bytes);
    assert_eq!(found.is_ok(), bytes.len() == 72 && bytes[..6] == IDENTIFIED, "{found:?}");
    if let Ok(status) = found {
        check(&status, bytes, Places([8, 10, 16, 48, 52, 56, 60, 64]));
    }
}

fn image(bytes: &[u8]) {
    let found = decode_status_image(&SERIAL, bytes);
    assert_eq!(found.is_ok(), bytes.len() == status_bytes(&SERIAL) && bytes[..6] == IDENTIFIED, "{found:?}");
    let text = StatusText::of_image(bytes);
    assert_eq!(text.is_some(), bytes.len() >= 36);
    if let Ok(status) = found {
        check(&status, bytes, Places([8, 10, 36, 12, 16, 20, 24, 28]));
        let again = text.and_then(|text| text.image(32)).unwrap();
        assert_eq!(decode_status_image(&SERIAL, &again).unwrap(), status);
    }
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let how = script.any();
    let mut bytes = script.rest().to_vec();
    if how & 1 != 0 {
        // The machine that is expected: most inputs would get no further.
        bytes.resize(if how & 2 == 0 { 72 } else { status_bytes(&SERIAL) }, 0);
        bytes[..6].copy_from_slice(&IDENTIFIED);
    }
    if how & 2 == 0 { registers(&bytes) } else { image(&bytes) }
});
