//! Profile files of any text: what is accepted agrees with itself. Its plan keeps to its areas and covers them, the longest table comes
//! back as it was, and a machine of this profile can be made that is ready.

#![no_main]

use benderd::bender::plan::{Request, delivery, rows};
use benderd::bender::{
    ModbusMap, Profile, Sequence, Transport, decode_payload, decode_status, decode_status_image,
    encode_payload, fields, payload_bytes, status_span,
};
use benderd::config::Document;
use benderd::sim::bender::MachineModel;
use benderd::tube::{CommandRow, CommandTable};
use benderd_fuzz::Script;
use libfuzzer_sys::fuzz_target;

const SHIPPED: [&str; 8] = [
    include_str!("../../protocols/reference-modbus.toml"),
    include_str!("../../protocols/reference-rtu.toml"),
    include_str!("../../protocols/reference-rtu-over-tcp.toml"),
    include_str!("../../protocols/reference-serial.toml"),
    include_str!("../../protocols/reference-folder.toml"),
    include_str!("../../protocols/ten-row.toml"),
    include_str!("../../protocols/reference-can.toml"),
    include_str!("../../protocols/reference-canopen.toml"),
];

/// First register of an area and the one behind it.
type Area = (usize, usize);

/// The requests cover the area, one after the other, none larger than the device takes.
fn cover<'a>(requests: impl Iterator<Item = &'a Request>, (start, end): Area, most: u16, writes: bool) {
    let mut next = start;
    for request in requests {
        assert_eq!((usize::from(request.address), request.writes), (next, writes));
        assert!((1..=most).contains(&request.registers) && usize::from(request.last()) < end);
        next += usize::from(request.registers);
    }
    assert_eq!(next, end);
}

fn plan(profile: &Profile, map: &ModbusMap) {
    let (first, count) = status_span(profile, map);
    let status = (usize::from(first), usize::from(first) + usize::from(count));
    for field in fields(profile, map) {
        assert!(
            field.address >= first && usize::from(field.address) + usize::from(field.registers) <= status.1
        );
    }
    let (staging, active) = (usize::from(map.registers.staging), usize::from(map.registers.active));
    for bends in [1, profile.limits.max_bends] {
        let registers = payload_bytes(profile, bends) / 2;
        let staged = (staging, staging + 4 + registers);
        let commit = (usize::from(map.registers.commit), usize::from(map.registers.commit) + 4);
        let apart = |a: Area, b: Area| a.1 <= b.0 || b.1 <= a.0;
        let active = (active, active + registers);
        assert!(
            apart(staged, commit) && apart(staged, active) && apart(commit, active) && apart(staged, status)
        );
        assert!(staged.1 <= 0x10000 && active.1 <= 0x10000 && usize::from(rows(profile, map)) < active.1);

        let steps = delivery(profile, map, bends);
        let most = map.max_read_registers;
        cover(steps[0].requests.iter(), status, most, false);
        cover(steps[1].requests.iter(), staged, map.max_write_registers, true);
        cover(steps[2].requests.iter(), staged, most, false);
        cover(steps[4].requests.iter(), commit, 4, true);
        cover(steps[5].requests[..1].iter(), status, most, false);
        cover(steps[5].requests[1..].iter(), active, most, false);
    }
}

fn table(profile: &Profile) {
    let limits = &profile.limits;
    let row = CommandRow {
        length_mm: limits.max_length_mm,
        rotation_rad: -limits.max_rotation_rad,
        angle_rad: limits.max_angle_rad,
    };
    let table = CommandTable { bends: vec![row; limits.max_bends], last_length_mm: limits.max_length_mm };
    let steps = |sequence| sequence == Sequence::Incremental;
    let fits =
        steps(profile.table.feed) && steps(profile.table.rotation) && profile.transport.direct().is_none();
    match encode_payload(profile, "P", &table) {
        Ok(payload) => {
            assert_eq!(payload.len(), payload_bytes(profile, limits.max_bends));
            let (_, back) = decode_payload(profile, &payload).unwrap();
            // Where rows are written directly, those without an angle at the end are none.
            let cut = profile.transport.direct().is_some() && back.bends.len() < limits.max_bends;
            assert!(cut || encode_payload(profile, "P", &back).unwrap() == payload);
            assert!(!cut || limits.max_angle_rad < limits.angle_resolution_rad);
        }
        // Positions, and 16 bits, may not reach as far as the limits.
        Err(reasons) => assert!(!fits && reasons.iter().all(|r| r.code == "not_encodable"), "{reasons:?}"),
    }
    assert!(limits.min_first_length_mm <= limits.max_length_mm, "no table can be made");
    assert!(limits.min_between_mm <= limits.max_length_mm, "no table of two bends can be made");
}

fn machine(profile: &Profile) {
    let mut model = MachineModel::new(profile.clone(), "P", 1);
    model.tick();
    let status = decode_status_image(profile, &model.status_image()).unwrap();
    assert!(profile.state_bits.iter().all(|b| (status.state >> b.bit & 1 == 1) == b.must_be), "never ready");
    let Some(map) = profile.transport.modbus() else { return };
    let (address, count) = status_span(profile, map);
    let words = model.read(address, count).unwrap();
    let bytes: Vec<u8> = words.into_iter().flat_map(u16::to_be_bytes).collect();
    assert_eq!(decode_status(profile, map, &bytes).unwrap(), status);
}

/// A part of the file that its transport has no use for is refused.
fn parts(profile: &Profile, text: &str) {
    let written: toml::Table = toml::from_str(text).unwrap();
    let has = |name: &str| written.contains_key(name);
    assert_eq!(has("modbus"), profile.transport.device().is_some());
    assert_eq!(has("registers"), profile.transport.modbus().is_some());
    assert_eq!(has("direct"), profile.transport.direct().is_some());
    assert_eq!(has("can"), matches!(profile.transport, Transport::Can(_)));
    assert_eq!(has("canopen"), matches!(profile.transport, Transport::Canopen(_)));
    assert_eq!(has("line"), profile.transport.line().is_some());
    assert_eq!(has("serial"), profile.transport.serial().is_some());
}

/// A shipped profile with some of its lines changed: most texts of any bytes are no TOML.
fn changed(script: &mut Script) -> String {
    let profile = SHIPPED[usize::from(script.any()) % SHIPPED.len()];
    let mut lines: Vec<String> = profile.lines().map(str::to_owned).collect();
    while let Some(line) = script.byte() {
        let at = usize::from(line) % lines.len();
        let key = lines[at].split_inclusive('=').next().unwrap_or("").to_owned();
        match script.any() % 6 {
            0 => lines[at].clear(),
            1 => lines[at] = format!("{key} {}", script.any()),
            2 => lines[at] = format!("{key} {}", script.word()),
            3 => lines[at] = format!("{key} {:?}", f64::from(script.long() as i32) / 1000.0),
            4 => lines[at] = format!("{key} {}", String::from_utf8_lossy(script.piece())),
            _ => {
                let other = usize::from(script.any()) % lines.len();
                lines[at] = lines[other].clone();
            }
        }
    }
    lines.join("\n")
}

fuzz_target!(|data: &[u8]| {
    // A text begins with a character that is seen.
    let text = match data.split_first() {
        Some((0..=31, rest)) => changed(&mut Script::new(rest)),
        _ => String::from_utf8_lossy(data).into_owned(),
    };
    match Profile::parse(&Document::new("profile.toml", text.as_str())) {
        // It names the profile, or the database that the profile names.
        Err(error) => assert!(error.to_string().contains("profile.toml") || text.contains("dbc"), "{error}"),
        Ok(profile) => agrees(&profile, &text),
    }
});

fn agrees(profile: &Profile, text: &str) {
    assert!(profile.deadlines.settle_ms < profile.deadlines.confirm_ms);
    assert!(profile.transport.takes(&profile.endpoint));
    if let Some(map) = profile.transport.modbus() {
        plan(profile, map);
    }
    table(profile);
    machine(profile);
    parts(profile, text);
}
