//! Payloads of any bytes, in every word order, sequence and direction of rotation: a table that is decoded encodes to the same bytes.

#![no_main]

use std::sync::LazyLock;

use benderd::bender::{
    Profile, Sequence, WordOrder, check_limits, decode_payload, encode_payload, payload_bytes,
};
use benderd_fuzz::Script;
use libfuzzer_sys::fuzz_target;

const ORDERS: [WordOrder; 4] = [WordOrder::Abcd, WordOrder::Cdab, WordOrder::Badc, WordOrder::Dcba];

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-modbus").unwrap());

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let mut profile = PROFILE.clone();
    let how = script.any();
    let sequence = |bit: u8| if bit == 0 { Sequence::Incremental } else { Sequence::Cumulative };
    let counted = script.any();
    (profile.table.feed, profile.table.rotation) = (sequence(counted & 1), sequence(counted & 2));
    profile.table.word_order = ORDERS[usize::from(how & 3)];
    profile.table.rotation_reversed = how & 4 != 0;
    profile.table.length_resolution_mm = [0.01, 1e-4, 0.0254, 1.0][usize::from(how >> 3 & 3)];
    profile.table.angle_resolution_deg = [0.001, 1e-5, 1.0 / 3.0, 1.0][usize::from(how >> 5 & 3)];
    let mut payload = script.rest().to_vec();
    let name = profile.table.program_bytes;
    if how & 0x80 != 0 && payload.len() >= payload_bytes(&profile, 0) {
        // As many bends as there are bytes for: most inputs would get no further.
        let bends = (payload.len() - payload_bytes(&profile, 0)) / Profile::ROW_BYTES;
        payload.truncate(payload_bytes(&profile, bends));
        payload[name..name + 2].copy_from_slice(&(bends as u16).to_be_bytes());
    }
    let Ok((program, table)) = decode_payload(&profile, &payload) else { return };
    assert_eq!(payload.len(), payload_bytes(&profile, table.bends.len()));
    check_limits(&profile, &table);

    // What the encoder never writes, the decoder may read: names that are none, and the spare word.
    let mut padded = program.clone().into_bytes();
    padded.resize(name, 0);
    let encoded = encode_payload(&profile, if program.is_empty() { "A" } else { &program }, &table);
    let mut encoded = encoded.unwrap_or_else(|reasons| panic!("decoded but not encodable: {reasons:?}"));
    encoded[..name].copy_from_slice(&payload[..name]);
    encoded[name + 2..name + 4].copy_from_slice(&payload[name + 2..name + 4]);
    assert_eq!(encoded, payload);
    if padded == payload[..name] && payload[name + 2..name + 4] == [0, 0] && !program.is_empty() {
        assert_eq!(encode_payload(&profile, &program, &table).unwrap(), payload);
    }
});
