//! CAN databases: whatever the text, what is taken from it can be packed and unpacked, and comes back as it was.

#![no_main]

use benderd::bender::Database;
use benderd::bender::can::Frame;
use libfuzzer_sys::fuzz_target;

/// What stands behind a keyword.
fn names<'a>(text: &'a str, keyword: &'a str, place: usize) -> impl Iterator<Item = &'a str> {
    let lines = text.lines().map(str::trim).filter(move |line| line.starts_with(keyword));
    lines.filter_map(move |line| line.split_whitespace().nth(place)).map(|name| name.trim_end_matches(':'))
}

fuzz_target!(|data: &[u8]| {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let Ok(database) = Database::parse(text) else { return };
    for message in names(text, "BO_ ", 2) {
        let Ok(message) = database.message(message) else { continue };
        for name in names(text, "SG_ ", 1) {
            let Ok(signal) = message.signal(name) else { continue };
            let most =
                if signal.signed { (1_i64 << (signal.bits - 1)) - 1 } else { (1_i64 << signal.bits) - 1 };
            let least = if signal.signed { -most - 1 } else { 0 };
            for raw in [least, most, 0, most / 3] {
                let mut bytes = vec![0xA5; message.bytes];
                assert!(signal.pack(&mut bytes, raw), "{name} takes {raw}");
                assert_eq!(signal.unpack(&bytes), Some(raw));
            }
            assert!(!signal.pack(&mut vec![0; message.bytes], most.saturating_add(1)) || most == i64::MAX);
            let _ = message.unpack(&Frame::new(message.id, vec![0xFF; message.bytes]), name);
            assert_eq!(message.unpack(&Frame::new(message.id, vec![]), name), None);
        }
    }
});
