//! Profile files: TOML to [`Profile`], every value checked, every complaint with its line.
//!
//! The shipped ones are built in and known by name; any other is given by path.

use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Duration;

use super::profile::{Deadlines, Profile, StateBit, TableFormat, WordOrder};
use super::profile_can::check_can;
use super::profile_modbus::check_areas;
use super::profile_raw::{RawConstants, RawDeadlines, RawLimits, RawProfile, RawStateBit, RawTable};
use super::profile_transport::{RawMap, Sections, parse_transport};
use super::transport::Transport;
use crate::config::{At, ConfigError, Document};
use crate::tube::MachineLimits;

const SHIPPED: [(&str, &str); 8] = [
    ("reference-modbus", include_str!("../../protocols/reference-modbus.toml")),
    ("reference-rtu", include_str!("../../protocols/reference-rtu.toml")),
    ("reference-serial", include_str!("../../protocols/reference-serial.toml")),
    ("reference-folder", include_str!("../../protocols/reference-folder.toml")),
    ("ten-row", include_str!("../../protocols/ten-row.toml")),
    ("reference-rtu-over-tcp", include_str!("../../protocols/reference-rtu-over-tcp.toml")),
    ("reference-can", include_str!("../../protocols/reference-can.toml")),
    ("reference-canopen", include_str!("../../protocols/reference-canopen.toml")),
];

/// Longest name of a program on machines that keep none.
const UNKEPT_PROGRAM: usize = 32;

/// Names of the profiles that come with the program.
pub fn shipped_profiles() -> impl Iterator<Item = &'static str> {
    SHIPPED.iter().map(|(name, _)| *name)
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
        if raw.registers.is_some() && raw.direct.is_some() {
            let span = raw.transport.span();
            let found = doc.text().get(span.clone()).unwrap_or("");
            return Err(doc.value_error(span, "transport", found, "with one of [registers] and [direct]"));
        }
        let sections = Sections {
            unit_id: raw.unit_id.as_ref(),
            modbus: raw.modbus.as_ref(),
            map: match (&raw.registers, &raw.direct) {
                (Some(registers), None) => Some(RawMap::Staged(registers)),
                (None, Some(direct)) => {
                    let rows = integer(doc, &raw.limits.max_bends, "limits.max_bends", 1..=123)?;
                    let coils = raw.state_bit.iter().map(|b| *b.bit.get_ref() + 1).max().unwrap_or(1);
                    Some(RawMap::Direct(direct, rows, coils.clamp(1, 16) as u16))
                }
                _ => None,
            },
            line: raw.line.as_ref(),
            serial: raw.serial.as_ref(),
            can: raw.can.as_ref(),
            canopen: raw.canopen.as_ref(),
        };
        let table = parse_table(doc, &raw.table, sections.word_order(), raw.direct.is_some())?;
        if raw.can.is_some()
            && let Some(characters) = &raw.table.program_characters
        {
            check_can(doc, characters, &raw.limits.max_bends)?;
        }
        let transport = parse_transport(doc, &raw.transport, &sections, &table)?;
        let (identification, layout) = parse_constants(doc, &raw.constants, &transport)?;
        let deadlines = parse_deadlines(doc, &raw.deadlines, &transport)?;
        let profile = Profile {
            name: text(doc, &raw.name, "name", 32)?,
            description: text(doc, &raw.description, "description", 200)?,
            endpoint: endpoint(doc, &raw.endpoint, &transport)?,
            transport,
            identification,
            layout,
            limits: parse_limits(doc, &raw.limits, &table)?,
            table,
            state_bits: parse_state_bits(doc, &raw.state_bit)?,
            deadlines,
        };
        if let (Some(map), Some(registers)) = (profile.transport.modbus(), &raw.registers) {
            check_areas(doc, registers, &profile, map)?;
        }
        Ok(profile)
    }
}

/// Identification and layout.
fn parse_constants(
    doc: &Document,
    raw: &RawConstants,
    transport: &Transport,
) -> Result<(u32, u16), ConfigError> {
    let identification = |most| integer(doc, &raw.identification, "constants.identification", 1..=most);
    match (&raw.layout, transport.direct()) {
        (Some(layout), None) => {
            let layout = integer(doc, layout, "constants.layout", 0..=0xffff)? as u16;
            Ok((identification(u32::MAX.into())? as u32, layout))
        }
        // One register.
        (None, Some(_)) => Ok((identification(0xffff)? as u32, 0)),
        (None, None) => Err(incomplete(doc, &raw.identification, "constants.identification", "layout")),
        (Some(layout), Some(_)) => Err(useless(doc, layout, "constants.layout")),
    }
}

fn parse_table(
    doc: &Document,
    raw: &RawTable,
    word_order: WordOrder,
    is_direct: bool,
) -> Result<TableFormat, ConfigError> {
    let program_bytes = match (&raw.program_characters, is_direct) {
        (Some(characters), false) => program_bytes(doc, characters)?,
        (None, true) => UNKEPT_PROGRAM,
        (None, false) => {
            return Err(incomplete(doc, &raw.rotation_sign, "table.rotation_sign", "program_characters"));
        }
        (Some(characters), true) => return Err(useless(doc, characters, "table.program_characters")),
    };
    let sign = *raw.rotation_sign.get_ref();
    if sign.abs() != 1 {
        return Err(doc.value_error(raw.rotation_sign.span(), "table.rotation_sign", sign, "1 or -1"));
    }
    let columns = match &raw.columns {
        None => ["length", "rotation", "angle"].map(str::to_owned),
        Some(names) => [
            text(doc, &names.length, "table.columns.length", 12)?,
            text(doc, &names.rotation, "table.columns.rotation", 12)?,
            text(doc, &names.angle, "table.columns.angle", 12)?,
        ],
    };
    Ok(TableFormat {
        program_bytes,
        word_order,
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
        feed: raw.feed,
        rotation: raw.rotation,
        columns,
    })
}

fn parse_state_bits(doc: &Document, raw: &[RawStateBit]) -> Result<Vec<StateBit>, ConfigError> {
    for (i, one) in raw.iter().enumerate() {
        let bit = one.bit.get_ref();
        if let Some(before) = raw[..i].iter().find(|before| before.bit.get_ref() == bit) {
            let allowed = format!("each bit once: it is {:?} already", before.name.get_ref());
            return Err(doc.value_error(one.bit.span(), "state_bit.bit", bit, allowed));
        }
    }
    raw.iter().map(|one| parse_state_bit(doc, one)).collect()
}

fn program_bytes(doc: &Document, characters: &At<i64>) -> Result<usize, ConfigError> {
    let key = "table.program_characters";
    let found = integer(doc, characters, key, 4..=64)?;
    if found % 4 != 0 {
        return Err(doc.value_error(characters.span(), key, found, "a multiple of 4, 4 to 64"));
    }
    Ok(found as usize)
}

/// A value that needs another beside it.
fn incomplete(doc: &Document, value: &At<i64>, key: &str, beside: &str) -> ConfigError {
    doc.value_error(value.span(), key, value.get_ref(), format!("with {beside} beside it"))
}

/// A value that a machine whose rows are written directly has no use for.
fn useless(doc: &Document, value: &At<i64>, key: &str) -> ConfigError {
    doc.value_error(value.span(), key, value.get_ref(), "nothing: with [direct] the machine keeps none")
}

fn parse_state_bit(doc: &Document, raw: &RawStateBit) -> Result<StateBit, ConfigError> {
    Ok(StateBit {
        bit: integer(doc, &raw.bit, "state_bit.bit", 0..=15)? as u8,
        name: text(doc, &raw.name, "state_bit.name", 40)?,
        must_be: raw.must_be,
    })
}

fn parse_limits(doc: &Document, raw: &RawLimits, table: &TableFormat) -> Result<MachineLimits, ConfigError> {
    let mm = |value, key: &str, most| doc.in_range(value, &format!("limits.{key}"), 0.0..=most);
    let max_length_mm = mm(&raw.max_length_mm, "max_length_mm", 100_000.0)?;
    let rad =
        |value, key: &str, max| Ok(doc.in_range(value, &format!("limits.{key}"), 0.0..=max)?.to_radians());
    Ok(MachineLimits {
        max_bends: integer(doc, &raw.max_bends, "limits.max_bends", 1..=1000)? as usize,
        min_first_length_mm: mm(&raw.min_first_length_mm, "min_first_length_mm", max_length_mm)?,
        min_between_mm: mm(&raw.min_between_mm, "min_between_mm", max_length_mm)?,
        max_length_mm,
        max_angle_rad: rad(&raw.max_angle_deg, "max_angle_deg", 359.0)?,
        max_rotation_rad: rad(&raw.max_rotation_deg, "max_rotation_deg", 3600.0)?,
        length_resolution_mm: table.length_resolution_mm,
        angle_resolution_rad: table.angle_resolution_deg.to_radians(),
    })
}

fn parse_deadlines(
    doc: &Document,
    raw: &RawDeadlines,
    transport: &Transport,
) -> Result<Deadlines, ConfigError> {
    let ms = |value: &At<i64>, key: &str, max| -> Result<u64, ConfigError> {
        Ok(integer(doc, value, &format!("deadlines.{key}"), 1..=max)? as u64)
    };
    let request = ms(&raw.request_ms, "request_ms", 60_000)?;
    let transfer = match (&raw.transfer_ms, transport.device()) {
        (None, Some(_)) => request,
        (Some(transfer), None) => ms(transfer, "transfer_ms", 600_000)?,
        (Some(wrong), Some(_)) => {
            let allowed = "nothing: over Modbus every request has its own time";
            return Err(doc.value_error(wrong.span(), "deadlines.transfer_ms", wrong.get_ref(), allowed));
        }
        (None, None) => {
            let span = raw.request_ms.span();
            let allowed = "with transfer_ms beside it: the longest time for a whole table";
            return Err(doc.value_error(span, "deadlines.request_ms", request, allowed));
        }
    };
    let deadlines = Deadlines {
        connect: Duration::from_millis(ms(&raw.connect_ms, "connect_ms", 60_000)?),
        request: Duration::from_millis(request),
        transfer: Duration::from_millis(transfer),
        heartbeat_ms: ms(&raw.heartbeat_ms, "heartbeat_ms", 60_000)?,
        confirm_ms: ms(&raw.confirm_ms, "confirm_ms", 600_000)?,
        settle_ms: ms(&raw.settle_ms, "settle_ms", 600_000)?,
        poll_ms: ms(&raw.poll_ms, "poll_ms", 10_000)?,
    };
    if matches!(transport, Transport::Folder(_)) && deadlines.settle_ms <= request {
        let allowed = format!("above request_ms ({request}): a command file may be carried out that late");
        let span = raw.settle_ms.span();
        return Err(doc.value_error(span, "deadlines.settle_ms", deadlines.settle_ms, allowed));
    }
    if deadlines.settle_ms >= deadlines.confirm_ms {
        let allowed = format!("below confirm_ms ({})", deadlines.confirm_ms);
        let span = raw.settle_ms.span();
        return Err(doc.value_error(span, "deadlines.settle_ms", deadlines.settle_ms, allowed));
    }
    Ok(deadlines)
}

pub(super) fn integer(
    doc: &Document,
    value: &At<i64>,
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

fn text(doc: &Document, value: &At<String>, key: &str, longest: usize) -> Result<String, ConfigError> {
    let found = value.get_ref();
    if found.is_empty() || found.chars().count() > longest || found.chars().any(char::is_control) {
        let allowed = format!("1 to {longest} printable characters");
        return Err(doc.value_error(value.span(), key, format!("{found:?}"), allowed));
    }
    Ok(found.clone())
}

fn endpoint(doc: &Document, value: &At<String>, transport: &Transport) -> Result<String, ConfigError> {
    let found = value.get_ref();
    if transport.takes(found) {
        return Ok(found.clone());
    }
    Err(doc.value_error(value.span(), "endpoint", format!("{found:?}"), transport.form()))
}

/// What tests of the profile's parts share.
#[cfg(test)]
pub(super) mod testing {
    use super::*;

    /// A profile's text.
    pub fn parse(text: &str) -> Result<Profile, String> {
        Profile::parse(&Document::new("p.toml", text)).map_err(|e| e.to_string())
    }

    /// What is said of it when something in it is changed.
    pub fn complaint_of(text: &str, from: &str, to: &str) -> String {
        assert!(text.contains(from), "the shipped profile no longer contains {from:?}");
        parse(&text.replacen(from, to, 1)).unwrap_err()
    }
}

#[cfg(test)]
mod tests {
    use super::testing::{complaint_of, parse};
    use super::*;

    const TEXT: &str = SHIPPED[0].1;

    fn complaint(from: &str, to: &str) -> String {
        complaint_of(TEXT, from, to)
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
        assert!(complaint("characters = 32 ", "characters = 30 ").contains("multiple of 4"));
        assert_eq!(
            complaint("bit = 3", "bit = 1"),
            format!(
                "p.toml, line {}: state_bit.bit = 1, allowed is each bit once: it is \"between parts\" already",
                line("bit = 3")
            )
        );
        assert!(
            complaint("first_length_mm = 10.0", "first_length_mm = 6000.1").contains("allowed is 0 to 6000")
        );
        assert!(complaint("min_between_mm = 0.0", "min_between_mm = 7e3").contains("allowed is 0 to 6000"));
        let direct = "[direct]\nidentification = 1\nstate_coils = 2\nlength = 3\nrotation = 4\nangle = 5\n\n[constants]";
        assert!(complaint("[constants]", direct).contains("with one of [registers] and [direct]"));
    }

    #[test]
    fn a_folder_is_given_the_time_in_which_a_command_may_still_be_carried_out() {
        let text = include_str!("../../protocols/reference-folder.toml");
        let with = |ms: &str| parse(&text.replacen("settle_ms = 2500", ms, 1));
        assert!(
            with("settle_ms = 2000")
                .unwrap_err()
                .contains("settle_ms = 2000, allowed is above request_ms (2000)")
        );
        assert!(with("settle_ms = 2001").is_ok());
    }

    #[test]
    fn an_unknown_name_lists_what_is_shipped() {
        let text = Profile::load("no-such-bender").unwrap_err().to_string();
        assert!(text.contains("no-such-bender") && text.contains("reference-modbus"), "{text}");
    }
}
