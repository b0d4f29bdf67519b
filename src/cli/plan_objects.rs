//! What is asked of a machine that keeps objects instead of registers, step by step: part of `benderd check --plan`.

use std::fmt::{Result, Write as _};

use crate::bender::{CanSettings, CanopenSettings, Profile, SERIAL_PIECE, Transport, payload_bytes};

/// The steps of a delivery, each with what does it.
pub fn write(out: &mut String, profile: &Profile) -> Result {
    let bends = profile.limits.max_bends;
    let payload = payload_bytes(profile, bends);
    let [status, stage, read_back, commit, recall] = match &profile.transport {
        Transport::SerialTable(..) => serial(payload),
        Transport::Folder(number) => folder(*number),
        Transport::Can(can) => messages(profile, can),
        Transport::Canopen(canopen) => objects(canopen, payload),
        // Registers have a plan of their own.
        Transport::ModbusTcp(_) | Transport::ModbusRtu(..) | Transport::ModbusRtuOverTcp(..) => return Ok(()),
    };
    let steps = [
        ("who is there, and may it be changed", status.clone()),
        ("stage", stage),
        ("read back", read_back),
        ("still so, and the program runs", status.clone()),
        ("commit, once", commit),
        ("what is in force now", format!("{status}; {recall}")),
    ];
    writeln!(out, "\na delivery of {bends} bends")?;
    for (number, (what, how)) in steps.iter().enumerate() {
        writeln!(out, "{} {what:<36} {how}", number + 1)?;
    }
    Ok(())
}

fn serial(payload: usize) -> [String; 5] {
    let frames = |kind, bytes: usize| format!("{} frames {kind}", bytes.div_ceil(SERIAL_PIECE));
    [
        "1 frame S".into(),
        frames('W', payload + 8),
        frames('R', payload + 8),
        "1 frame C".into(),
        frames('T', payload),
    ]
}

fn folder(number: u16) -> [String; 5] {
    let command = |name: &str| format!("bender{number}.cmd ({name}), bender{number}.ans");
    [
        command("status"),
        format!("bender{number}.tab, {}", command("stage")),
        format!("{}, bender{number}.out", command("readback")),
        command("commit"),
        format!("{}, bender{number}.out", command("recall")),
    ]
}

fn messages(profile: &Profile, can: &CanSettings) -> [String; 5] {
    let (contract, bends) = (&can.contract, profile.limits.max_bends);
    let [state, status, item, commit] =
        [&contract.state, &contract.status, &contract.item.0, &contract.commit.0]
            .map(|m| format!("{} {}", m.id, m.name));
    // Revision, CRC, bend count, last length, the program's name; then rows.
    let head = 4 + profile.table.program_bytes / 4;
    let items = |head: usize| match &contract.row {
        Some((row, _)) => format!("{head} times {item}, {bends} times {} {}", row.id, row.name),
        None => format!("{} times {item}", head + 3 * bends),
    };
    let recalled = items(head - 2); // the status has revision and CRC
    [format!("hears {state} and {status}"), items(head), items(head), format!("1 time {commit}"), recalled]
}

fn objects(canopen: &CanopenSettings, payload: usize) -> [String; 5] {
    let blocks = if canopen.block { "in blocks" } else { "in segments" };
    [
        format!("upload of {}", canopen.status),
        format!("download of {} bytes to {}, {blocks}", payload + 8, canopen.staging),
        format!("upload of {}, {blocks}", canopen.staging),
        format!("download of 8 bytes to {}", canopen.commit),
        format!("upload of {}, {blocks}", canopen.active),
    ]
}
