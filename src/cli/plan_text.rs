//! A profile's request plan as text, for the PLC programmer: `benderd check --plan`.

use std::fmt::Write as _;

use super::plan_objects;
use crate::bender::plan::{self, Request};
use crate::bender::{
    Device, DirectMap, ModbusMap, Parity, Profile, Sequence, SerialSettings, Transport, WordOrder, fields,
    payload_bytes,
};

/// All of it.
pub fn of(profile: &Profile) -> String {
    let mut out = String::new();
    // Writing to a string does not fail.
    let _ = write(&mut out, profile);
    out
}

fn write(out: &mut String, profile: &Profile) -> std::fmt::Result {
    let bends = profile.limits.max_bends;
    let table = &profile.table;
    writeln!(out, "{}: {}", profile.name, profile.description)?;
    writeln!(out, "  machine   {} at {}", transport(profile), profile.endpoint)?;
    let direct = profile.transport.direct();
    let values = match direct {
        Some(_) => "one register each, signed".to_owned(),
        None => format!("32-bit values {} (A is the highest byte)", order(table.word_order)),
    };
    writeln!(
        out,
        "  numbers   {values}; {} mm and {} degrees a count; rotation {}",
        table.length_resolution_mm,
        table.angle_resolution_deg,
        if table.rotation_reversed { "left-handed about the feed" } else { "right-handed about the feed" }
    )?;
    if let Some(map) = profile.transport.modbus() {
        let (read, write) = (map.max_read_registers, map.max_write_registers);
        writeln!(out, "  requests  read {read} registers at most, write {write}")?;
    }
    match direct {
        Some(_) => writeln!(out, "  table     {bends} rows, those behind the last bend 0")?,
        None => writeln!(out, "  table     up to {bends} bends, {} bytes", payload_bytes(profile, bends))?,
    }
    writeln!(out, "  times     {}", times(profile))?;
    if let Some(map) = profile.transport.modbus() {
        writeln!(out, "\nvalues                     from 0        as 4xxxx")?;
        for field in fields(profile, map) {
            let span = Request { writes: false, address: field.address, registers: field.registers };
            writeln!(out, "  {:<22}   {}", field.name, registers(&span))?;
        }
    }
    if let Some(map) = direct {
        write_places(out, profile, map)?;
    }
    writeln!(out, "\nstate bits that must hold")?;
    for bit in &profile.state_bits {
        writeln!(out, "  bit {:<2} {:<20} {}", bit.bit, bit.name, if bit.must_be { "on" } else { "off" })?;
    }
    match profile.transport.device() {
        Some(Device::Staged(map)) => write_requests(out, profile, map),
        Some(Device::Direct(map)) => write_looks(out, profile, map),
        None => plan_objects::write(out, profile),
    }
}

/// Where a machine without a staging area keeps what.
fn write_places(out: &mut String, profile: &Profile, map: &DirectMap) -> std::fmt::Result {
    let table = &profile.table;
    writeln!(out, "\nvalues                     from 0        as 4xxxx")?;
    writeln!(out, "  {:<22}   {}", "identification", registers(&plan::constant(map)))?;
    for (name, column) in table.columns.iter().zip(plan::columns(profile, map, false)) {
        writeln!(out, "  {name:<22}   {}", registers(&column))?;
    }
    writeln!(out, "  {:<22}   coils {}", "state", coils(map))?;
    let sequence = |cumulative| if cumulative { "all from the first on" } else { "each from the one before" };
    writeln!(out, "  {} {}", table.columns[0], sequence(table.feed == Sequence::Cumulative))?;
    writeln!(out, "  {} {}", table.columns[1], sequence(table.rotation == Sequence::Cumulative))
}

fn coils(map: &DirectMap) -> String {
    format!("{} to {}", map.state_coils, map.state_coils + map.coils - 1)
}

/// What is asked of it to put a table in force.
fn write_looks(out: &mut String, profile: &Profile, map: &DirectMap) -> std::fmt::Result {
    let rows = profile.limits.max_bends;
    writeln!(
        out,
        "\na delivery of {rows} rows, in force as soon as they are written: every write needs the operator's approval"
    )?;
    // Rows before and after the state: nobody was writing.
    let look = |out: &mut String| {
        write_request(out, &plan::constant(map))?;
        plan::columns(profile, map, false).iter().try_for_each(|column| write_request(out, column))?;
        writeln!(out, "  read  {:>3} coils          {}", map.coils, coils(map))?;
        plan::columns(profile, map, false).iter().try_for_each(|column| write_request(out, column))
    };
    writeln!(out, "1 who is there, and may it be changed")?;
    look(out)?;
    writeln!(out, "2 still so")?;
    look(out)?;
    writeln!(out, "3 write, once")?;
    plan::columns(profile, map, true).iter().try_for_each(|column| write_request(out, column))?;
    writeln!(out, "4 read back: what is in force now")?;
    look(out)
}

fn write_requests(out: &mut String, profile: &Profile, map: &ModbusMap) -> std::fmt::Result {
    let bends = profile.limits.max_bends;
    writeln!(out, "\na delivery of {bends} bends     from 0        as 4xxxx")?;
    for (number, step) in plan::delivery(profile, map, bends).iter().enumerate() {
        writeln!(out, "{} {}", number + 1, step.what)?;
        step.requests.iter().try_for_each(|request| write_request(out, request))?;
    }
    Ok(())
}

fn write_request(out: &mut String, request: &Request) -> std::fmt::Result {
    let does = if request.writes { "write" } else { "read" };
    writeln!(out, "  {does:<5} {:>3} registers      {}", request.registers, registers(request))
}

fn registers(request: &Request) -> String {
    let (first, last) = (u32::from(request.address), u32::from(request.last()));
    let from_0 = if first == last { first.to_string() } else { format!("{first} to {last}") };
    let marked = |at: u32| if at < 9999 { format!("{}", 40_001 + at) } else { format!("{}", 400_001 + at) };
    let as_4xxxx =
        if first == last { marked(first) } else { format!("{} to {}", marked(first), marked(last)) };
    format!("{from_0:<13} {as_4xxxx}")
}

fn transport(profile: &Profile) -> String {
    match &profile.transport {
        Transport::ModbusTcp(device) => format!("Modbus TCP, unit {}", device.unit_id()),
        Transport::ModbusRtuOverTcp(device, _) => format!("Modbus RTU over TCP, unit {}", device.unit_id()),
        Transport::ModbusRtu(device, _, port) => {
            format!("Modbus RTU, {}, unit {}", serial(port), device.unit_id())
        }
        Transport::Can(can) if can.fd => "CAN FD".into(),
        Transport::Can(_) => "CAN".into(),
        Transport::Canopen(canopen) => format!("CANopen, node {}", canopen.node),
        Transport::Folder(number) => format!("shared folder, bender {number}"),
        Transport::SerialTable(unit, _, port) => {
            format!("serial table protocol, {}, unit {unit}", serial(port))
        }
    }
}

fn serial(serial: &SerialSettings) -> String {
    let parity = match serial.parity {
        Parity::None => 'N',
        Parity::Even => 'E',
        Parity::Odd => 'O',
    };
    let rs485 = if serial.rs485 { ", RS-485 by the kernel" } else { "" };
    format!("{} baud 8{parity}{}{rs485}", serial.baud, serial.stop_bits)
}

fn order(order: WordOrder) -> &'static str {
    match order {
        WordOrder::Abcd => "ABCD",
        WordOrder::Cdab => "CDAB",
        WordOrder::Badc => "BADC",
        WordOrder::Dcba => "DCBA",
    }
}

fn times(profile: &Profile) -> String {
    let d = &profile.deadlines;
    let mut out = format!(
        "connect {} ms, reply {} ms, heartbeat {} ms, commit to active {} ms",
        d.connect.as_millis(),
        d.request.as_millis(),
        d.heartbeat_ms,
        d.confirm_ms
    );
    if let Some(line) = profile.transport.line() {
        let _ = write!(out, "; silent for {} ms after a doubt", line.quiet.as_millis());
    }
    out
}
