//! A profile's request plan as text, for the PLC programmer: `benderd check --plan`.

use std::fmt::Write as _;

use crate::bender::plan::{self, Request};
use crate::bender::{Parity, Profile, Transport, WordOrder, payload_bytes};

/// All of it.
pub fn of(profile: &Profile) -> String {
    let mut out = String::new();
    // Writing to a string does not fail.
    let _ = write(&mut out, profile);
    out
}

fn write(out: &mut String, profile: &Profile) -> std::fmt::Result {
    let bends = profile.limits.max_bends;
    let (format, table) = (&profile.modbus, &profile.table);
    writeln!(out, "{}: {}", profile.name, profile.description)?;
    writeln!(out, "  machine   {} unit {} at {}", transport(profile), profile.unit_id, profile.endpoint)?;
    writeln!(
        out,
        "  numbers   32-bit values {} (A is the highest byte); {} mm and {} degrees a count; rotation {}",
        order(format.word_order),
        table.length_resolution_mm,
        table.angle_resolution_deg,
        if table.rotation_reversed { "left-handed about the feed" } else { "right-handed about the feed" }
    )?;
    let bytes = payload_bytes(profile, bends);
    writeln!(
        out,
        "  requests  read {} registers at most, write {}",
        format.max_read_registers, format.max_write_registers
    )?;
    writeln!(out, "  table     up to {bends} bends, {bytes} bytes")?;
    writeln!(out, "  times     {}", times(profile))?;
    writeln!(out, "\nvalues                     from 0        as 4xxxx")?;
    for field in plan::fields(profile) {
        let span = Request { writes: false, address: field.address, registers: field.registers };
        writeln!(out, "  {:<22}   {}", field.name, registers(&span))?;
    }
    writeln!(out, "\nstate bits that must hold")?;
    for bit in &profile.state_bits {
        writeln!(out, "  bit {:<2} {:<20} {}", bit.bit, bit.name, if bit.must_be { "on" } else { "off" })?;
    }
    writeln!(out, "\na delivery of {bends} bends     from 0        as 4xxxx")?;
    for (number, step) in plan::delivery(profile, bends).iter().enumerate() {
        writeln!(out, "{} {}", number + 1, step.what)?;
        for request in &step.requests {
            let does = if request.writes { "write" } else { "read" };
            writeln!(out, "  {does:<5} {:>3} registers      {}", request.registers, registers(request))?;
        }
    }
    Ok(())
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
        Transport::ModbusTcp => "Modbus TCP,".into(),
        Transport::ModbusRtuOverTcp(_) => "Modbus RTU over TCP,".into(),
        Transport::ModbusRtu(_, serial) => {
            let parity = match serial.parity {
                Parity::None => 'N',
                Parity::Even => 'E',
                Parity::Odd => 'O',
            };
            let rs485 = if serial.rs485 { ", RS-485 by the kernel" } else { "" };
            format!("Modbus RTU, {} baud 8{parity}{}{rs485},", serial.baud, serial.stop_bits)
        }
    }
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
