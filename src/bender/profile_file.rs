//! Profile files: TOML to [`Profile`], every value checked, every complaint with its line.
//!
//! The shipped ones are built in and known by name; any other is given by path.

use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Duration;

use serde::Deserialize;
use toml::Spanned;

use super::profile::{Deadlines, ModbusFormat, Profile, Registers, StateBit, TableFormat, WordOrder};
use super::profile_transport::{RawLine, RawSerial, RawTransport, parse_transport};
use super::transport::Transport;
use crate::config::{ConfigError, Document};
use crate::tube::MachineLimits;

const SHIPPED: [(&str, &str); 3] = [
    ("reference-modbus", include_str!("../../protocols/reference-modbus.toml")),
    ("reference-rtu", include_str!("../../protocols/reference-rtu.toml")),
    ("reference-rtu-over-tcp", include_str!("../../protocols/reference-rtu-over-tcp.toml")),
];

/// Names of the profiles that come with the program.
pub fn shipped_profiles() -> impl Iterator<Item = &'static str> {
    SHIPPED.iter().map(|(name, _)| *name)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawProfile {
    version: Spanned<i64>,
    name: Spanned<String>,
    description: Spanned<String>,
    transport: Spanned<RawTransport>,
    endpoint: Spanned<String>,
    unit_id: Spanned<i64>,
    line: Option<RawLine>,
    serial: Option<RawSerial>,
    modbus: RawModbus,
    registers: RawRegisters,
    constants: RawConstants,
    table: RawTable,
    state_bit: Vec<RawStateBit>,
    limits: RawLimits,
    deadlines: RawDeadlines,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawModbus {
    word_order: RawWordOrder,
    max_read_registers: Spanned<i64>,
    max_write_registers: Spanned<i64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum RawWordOrder {
    Abcd,
    Cdab,
    Badc,
    Dcba,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawRegisters {
    identification: Spanned<i64>,
    layout: Spanned<i64>,
    heartbeat: Spanned<i64>,
    state: Spanned<i64>,
    bend_count: Spanned<i64>,
    program: Spanned<i64>,
    active_revision: Spanned<i64>,
    active_crc: Spanned<i64>,
    ack_revision: Spanned<i64>,
    ack_code: Spanned<i64>,
    commit: Spanned<i64>,
    staging: Spanned<i64>,
    active: Spanned<i64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawConstants {
    identification: Spanned<i64>,
    layout: Spanned<i64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawTable {
    program_registers: Spanned<i64>,
    length_resolution_mm: Spanned<f64>,
    angle_resolution_deg: Spanned<f64>,
    rotation_sign: Spanned<i64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawStateBit {
    bit: Spanned<i64>,
    name: Spanned<String>,
    must_be: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawLimits {
    max_bends: Spanned<i64>,
    min_first_length_mm: Spanned<f64>,
    min_between_mm: Spanned<f64>,
    max_length_mm: Spanned<f64>,
    max_angle_deg: Spanned<f64>,
    max_rotation_deg: Spanned<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawDeadlines {
    connect_ms: Spanned<i64>,
    request_ms: Spanned<i64>,
    heartbeat_ms: Spanned<i64>,
    confirm_ms: Spanned<i64>,
    settle_ms: Spanned<i64>,
    poll_ms: Spanned<i64>,
}

impl Profile {
    /// A shipped profile by its name, or a profile file by its path.
    pub fn load(name_or_path: &str) -> Result<Profile, ConfigError> {
        if let Some((name, text)) = SHIPPED.iter().find(|(name, _)| *name == name_or_path) {
            return Profile::parse(&Document::new(format!("protocols/{name}.toml (built in)"), *text));
        }
        let doc = Document::read(Path::new(name_or_path)).map_err(|error| match error {
            ConfigError::Read { file, cause } if cause.kind() == std::io::ErrorKind::NotFound => {
                let shipped = shipped_profiles().collect::<Vec<_>>().join(", ");
                let hint = format!("no such file and no shipped profile of this name (shipped: {shipped})");
                ConfigError::Read { file, cause: std::io::Error::new(cause.kind(), hint) }
            }
            other => other,
        })?;
        Profile::parse(&doc)
    }

    /// Validates a profile text.
    pub fn parse(doc: &Document) -> Result<Profile, ConfigError> {
        let raw: RawProfile = doc.parse()?;
        integer(doc, &raw.version, "version", 1..=1)?;
        let table = parse_table(doc, &raw.table)?;
        let transport = parse_transport(doc, &raw.transport, raw.line.as_ref(), raw.serial.as_ref())?;
        let profile = Profile {
            name: text(doc, &raw.name, "name", 32)?,
            description: text(doc, &raw.description, "description", 200)?,
            endpoint: endpoint(doc, &raw.endpoint, &transport)?,
            transport,
            unit_id: integer(doc, &raw.unit_id, "unit_id", 0..=255)? as u8,
            modbus: parse_modbus(doc, &raw.modbus)?,
            registers: parse_registers(doc, &raw.registers)?,
            identification: integer(
                doc,
                &raw.constants.identification,
                "constants.identification",
                1..=u32::MAX.into(),
            )? as u32,
            layout: integer(doc, &raw.constants.layout, "constants.layout", 0..=0xffff)? as u16,
            limits: parse_limits(doc, &raw.limits, &table)?,
            table,
            state_bits: raw.state_bit.iter().map(|b| parse_state_bit(doc, b)).collect::<Result<_, _>>()?,
            deadlines: parse_deadlines(doc, &raw.deadlines)?,
        };
        check_areas(doc, &raw, &profile)?;
        Ok(profile)
    }
}

fn parse_modbus(doc: &Document, raw: &RawModbus) -> Result<ModbusFormat, ConfigError> {
    // Every 32-bit value lies at an even distance from its area's start, so an even limit never splits one.
    let even = |value: &Spanned<i64>, key, max| Ok(integer(doc, value, key, 4..=max)? as u16 & !1);
    Ok(ModbusFormat {
        word_order: match raw.word_order {
            RawWordOrder::Abcd => WordOrder::Abcd,
            RawWordOrder::Cdab => WordOrder::Cdab,
            RawWordOrder::Badc => WordOrder::Badc,
            RawWordOrder::Dcba => WordOrder::Dcba,
        },
        max_read_registers: even(&raw.max_read_registers, "modbus.max_read_registers", 125)?,
        max_write_registers: even(&raw.max_write_registers, "modbus.max_write_registers", 123)?,
    })
}

fn parse_registers(doc: &Document, raw: &RawRegisters) -> Result<Registers, ConfigError> {
    let address = |value: &Spanned<i64>, key: &str| -> Result<u16, ConfigError> {
        Ok(integer(doc, value, &format!("registers.{key}"), 0..=0xffff)? as u16)
    };
    Ok(Registers {
        identification: address(&raw.identification, "identification")?,
        layout: address(&raw.layout, "layout")?,
        heartbeat: address(&raw.heartbeat, "heartbeat")?,
        state: address(&raw.state, "state")?,
        bend_count: address(&raw.bend_count, "bend_count")?,
        program: address(&raw.program, "program")?,
        active_revision: address(&raw.active_revision, "active_revision")?,
        active_crc: address(&raw.active_crc, "active_crc")?,
        ack_revision: address(&raw.ack_revision, "ack_revision")?,
        ack_code: address(&raw.ack_code, "ack_code")?,
        commit: address(&raw.commit, "commit")?,
        staging: address(&raw.staging, "staging")?,
        active: address(&raw.active, "active")?,
    })
}

fn parse_table(doc: &Document, raw: &RawTable) -> Result<TableFormat, ConfigError> {
    let registers = integer(doc, &raw.program_registers, "table.program_registers", 2..=32)?;
    if registers % 2 != 0 {
        let span = raw.program_registers.span();
        return Err(doc.value_error(
            span,
            "table.program_registers",
            registers,
            "an even number from 2 to 32",
        ));
    }
    let sign = *raw.rotation_sign.get_ref();
    if sign.abs() != 1 {
        return Err(doc.value_error(raw.rotation_sign.span(), "table.rotation_sign", sign, "1 or -1"));
    }
    Ok(TableFormat {
        program_registers: registers as u16,
        length_resolution_mm: doc.in_range(
            &raw.length_resolution_mm,
            "table.length_resolution_mm",
            1e-4..=1.0,
        )?,
        angle_resolution_deg: doc.in_range(
            &raw.angle_resolution_deg,
            "table.angle_resolution_deg",
            1e-5..=1.0,
        )?,
        rotation_reversed: sign == -1,
    })
}

fn parse_state_bit(doc: &Document, raw: &RawStateBit) -> Result<StateBit, ConfigError> {
    Ok(StateBit {
        bit: integer(doc, &raw.bit, "state_bit.bit", 0..=15)? as u8,
        name: text(doc, &raw.name, "state_bit.name", 40)?,
        must_be: raw.must_be,
    })
}

fn parse_limits(doc: &Document, raw: &RawLimits, table: &TableFormat) -> Result<MachineLimits, ConfigError> {
    let mm = |value, key: &str| doc.in_range(value, &format!("limits.{key}"), 0.0..=100_000.0);
    let rad =
        |value, key: &str, max| Ok(doc.in_range(value, &format!("limits.{key}"), 0.0..=max)?.to_radians());
    Ok(MachineLimits {
        max_bends: integer(doc, &raw.max_bends, "limits.max_bends", 1..=1000)? as usize,
        min_first_length_mm: mm(&raw.min_first_length_mm, "min_first_length_mm")?,
        min_between_mm: mm(&raw.min_between_mm, "min_between_mm")?,
        max_length_mm: mm(&raw.max_length_mm, "max_length_mm")?,
        max_angle_rad: rad(&raw.max_angle_deg, "max_angle_deg", 359.0)?,
        max_rotation_rad: rad(&raw.max_rotation_deg, "max_rotation_deg", 3600.0)?,
        length_resolution_mm: table.length_resolution_mm,
        angle_resolution_rad: table.angle_resolution_deg.to_radians(),
    })
}

fn parse_deadlines(doc: &Document, raw: &RawDeadlines) -> Result<Deadlines, ConfigError> {
    let ms = |value: &Spanned<i64>, key: &str, max| -> Result<u64, ConfigError> {
        Ok(integer(doc, value, &format!("deadlines.{key}"), 1..=max)? as u64)
    };
    let deadlines = Deadlines {
        connect: Duration::from_millis(ms(&raw.connect_ms, "connect_ms", 60_000)?),
        request: Duration::from_millis(ms(&raw.request_ms, "request_ms", 60_000)?),
        heartbeat_ms: ms(&raw.heartbeat_ms, "heartbeat_ms", 60_000)?,
        confirm_ms: ms(&raw.confirm_ms, "confirm_ms", 600_000)?,
        settle_ms: ms(&raw.settle_ms, "settle_ms", 600_000)?,
        poll_ms: ms(&raw.poll_ms, "poll_ms", 10_000)?,
    };
    if deadlines.settle_ms >= deadlines.confirm_ms {
        let allowed = format!("below confirm_ms ({})", deadlines.confirm_ms);
        let span = raw.settle_ms.span();
        return Err(doc.value_error(span, "deadlines.settle_ms", deadlines.settle_ms, allowed));
    }
    Ok(deadlines)
}

/// One group of registers: the address as written in the file, its key, how many.
struct Area<'a> {
    address: &'a Spanned<i64>,
    key: &'static str,
    registers: usize,
}

impl Area<'_> {
    fn start(&self) -> i64 {
        *self.address.get_ref()
    }

    fn end(&self) -> i64 {
        self.start() + self.registers as i64
    }

    fn complaint(&self, doc: &Document, allowed: String) -> ConfigError {
        doc.value_error(self.address.span(), &format!("registers.{}", self.key), self.start(), allowed)
    }
}

fn areas<'a>(r: &'a RawRegisters, profile: &Profile) -> Vec<Area<'a>> {
    let payload = (profile.payload_header_bytes() + profile.limits.max_bends * Profile::ROW_BYTES) / 2;
    let area = |address, key, registers| Area { address, key, registers };
    vec![
        area(&r.identification, "identification", 2),
        area(&r.layout, "layout", 1),
        area(&r.heartbeat, "heartbeat", 1),
        area(&r.state, "state", 1),
        area(&r.bend_count, "bend_count", 1),
        area(&r.program, "program", usize::from(profile.table.program_registers)),
        area(&r.active_revision, "active_revision", 2),
        area(&r.active_crc, "active_crc", 2),
        area(&r.ack_revision, "ack_revision", 2),
        area(&r.ack_code, "ack_code", 1),
        area(&r.commit, "commit", 4),
        area(&r.staging, "staging", 4 + payload),
        area(&r.active, "active", payload),
    ]
}

/// No two areas overlap, all fit, and one read covers the status.
fn check_areas(doc: &Document, raw: &RawProfile, profile: &Profile) -> Result<(), ConfigError> {
    let mut areas = areas(&raw.registers, profile);
    areas.sort_by_key(Area::start);
    if let Some(area) = areas.iter().find(|a| a.end() > 0x10000) {
        let allowed = format!("at most {}: it takes {} registers", 0x10000 - area.registers, area.registers);
        return Err(area.complaint(doc, allowed));
    }
    if let Some((before, area)) = areas.iter().zip(areas.iter().skip(1)).find(|(a, b)| a.end() > b.start()) {
        return Err(area.complaint(doc, format!("{} or more: {} ends there", before.end(), before.key)));
    }
    let mut status = areas.iter().filter(|a| !matches!(a.key, "staging" | "active"));
    let first = status.clone().map(Area::start).min().unwrap_or(0);
    let most = profile.modbus.max_read_registers;
    match status.find(|a| a.end() - first > i64::from(most)) {
        Some(area) => {
            let allowed = format!(
                "below {}: one read of {most} registers covers the whole status, so that it is of one moment",
                first + i64::from(most) - area.registers as i64 + 1
            );
            Err(area.complaint(doc, allowed))
        }
        None => Ok(()),
    }
}

pub(super) fn integer(
    doc: &Document,
    value: &Spanned<i64>,
    key: &str,
    allowed: RangeInclusive<i64>,
) -> Result<i64, ConfigError> {
    let found = *value.get_ref();
    if allowed.contains(&found) {
        return Ok(found);
    }
    let allowed = if allowed.start() == allowed.end() {
        allowed.start().to_string()
    } else {
        format!("{} to {}", allowed.start(), allowed.end())
    };
    Err(doc.value_error(value.span(), key, found, allowed))
}

fn text(doc: &Document, value: &Spanned<String>, key: &str, longest: usize) -> Result<String, ConfigError> {
    let found = value.get_ref();
    if found.is_empty() || found.chars().count() > longest || found.chars().any(char::is_control) {
        let allowed = format!("1 to {longest} printable characters");
        return Err(doc.value_error(value.span(), key, format!("{found:?}"), allowed));
    }
    Ok(found.clone())
}

fn endpoint(doc: &Document, value: &Spanned<String>, transport: &Transport) -> Result<String, ConfigError> {
    let found = value.get_ref();
    if transport.takes(found) {
        return Ok(found.clone());
    }
    Err(doc.value_error(value.span(), "endpoint", format!("{found:?}"), transport.form()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = SHIPPED[0].1;

    fn parse(text: &str) -> Result<Profile, String> {
        Profile::parse(&Document::new("p.toml", text)).map_err(|e| e.to_string())
    }

    fn complaint(from: &str, to: &str) -> String {
        assert!(TEXT.contains(from), "the shipped profile no longer contains {from:?}");
        parse(&TEXT.replacen(from, to, 1)).unwrap_err()
    }

    #[test]
    fn every_shipped_profile_is_valid_and_named_as_its_file() {
        for name in shipped_profiles() {
            assert_eq!(Profile::load(name).unwrap().name, name);
            let path = format!("{}/protocols/{name}.toml", env!("CARGO_MANIFEST_DIR"));
            assert_eq!(Profile::load(&path).unwrap(), Profile::load(name).unwrap());
        }
        let folder = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/protocols")).unwrap();
        let files = folder.filter(|f| f.as_ref().unwrap().path().extension().is_some_and(|e| e == "toml"));
        assert_eq!(files.count(), SHIPPED.len(), "each profile in protocols/ is built in");
    }

    #[test]
    fn complaints_name_line_key_found_and_allowed() {
        let line = |needle: &str| 1 + TEXT[..TEXT.find(needle).unwrap()].matches('\n').count();
        assert_eq!(
            complaint("unit_id = 1", "unit_id = 256"),
            format!("p.toml, line {}: unit_id = 256, allowed is 0 to 255", line("unit_id"))
        );
        assert_eq!(
            complaint("bit = 3", "bit = 16"),
            format!("p.toml, line {}: state_bit.bit = 16, allowed is 0 to 15", line("bit = 3"))
        );
        assert!(complaint("version = 1", "version = 2").contains("version = 2, allowed is 1"));
        assert!(complaint("unit_id = 1", "unit = 1").contains("unit"));
        assert!(complaint("\"abcd\"", "\"acbd\"").contains("abcd"));
        assert!(complaint("\"modbus-tcp\"", "\"smoke\"").contains("modbus-tcp"));
        assert!(complaint("_sign = 1", "_sign = 0").contains("rotation_sign = 0, allowed is 1 or -1"));
        assert!(complaint("mm = 0.01", "mm = nan").contains("length_resolution_mm = NaN"));
        assert!(complaint("127.0.0.1:5020", "127.0.0.1").contains("host:port"));
        assert!(complaint("settle_ms = 500", "settle_ms = 5000").contains("below confirm_ms (5000)"));
        assert!(complaint("registers = 16 ", "registers = 15 ").contains("even number"));
    }

    #[test]
    fn areas_that_overlap_or_overflow_are_refused_and_the_neighbour_is_not() {
        assert!(complaint("commit = 32", "commit = 29").contains("commit = 29, allowed is 30 or more"));
        assert!(
            complaint("active = 2000", "active = 1263").contains("active = 1263, allowed is 1264 or more")
        );
        assert!(parse(&TEXT.replace("active = 2000", "active = 1264")).is_ok());
        assert!(complaint("active = 2000", "active = 65277").contains("at most 65276"));
        assert!(parse(&TEXT.replace("active = 2000", "active = 65276")).is_ok());
        assert!(complaint("commit = 32", "commit = 121").contains("one read of 124 registers"));
        assert!(parse(&TEXT.replace("commit = 32", "commit = 120")).is_ok());
    }

    #[test]
    fn an_unknown_name_lists_what_is_shipped() {
        let text = Profile::load("no-such-bender").unwrap_err().to_string();
        assert!(text.contains("no-such-bender") && text.contains("reference-modbus"), "{text}");
    }
}
