//! The part of a profile file that a Modbus device needs: its unit, how much fits into a request, where each value is. No two areas
//! may overlap, and one read must cover the status.
//!
//! Under `profile_file`.

use schemars::JsonSchema;
use serde::Deserialize;

use super::direct::DirectMap;
use super::profile::{Profile, WordOrder};
use super::profile_file::integer;
use super::registers::{ModbusMap, Registers};
use crate::config::{At, ConfigError, Document};

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawModbus {
    /// Of 32-bit values, A being the highest byte; [direct] has none.
    word_order: Option<At<RawWordOrder>>,
    max_read_registers: At<i64>,
    max_write_registers: At<i64>,
}

impl RawModbus {
    /// Of 32-bit values; where the file says nothing, the highest byte first.
    pub fn word_order(&self) -> WordOrder {
        self.word_order.as_ref().map_or(WordOrder::Abcd, |order| (*order.get_ref()).into())
    }
}

#[derive(Clone, Copy, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
enum RawWordOrder {
    Abcd,
    Cdab,
    Badc,
    Dcba,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawRegisters {
    identification: At<i64>,
    layout: At<i64>,
    heartbeat: At<i64>,
    state: At<i64>,
    bend_count: At<i64>,
    program: At<i64>,
    active_revision: At<i64>,
    active_crc: At<i64>,
    ack_revision: At<i64>,
    ack_code: At<i64>,
    commit: At<i64>,
    staging: At<i64>,
    active: At<i64>,
}

/// Where a machine without a staging area keeps its rows.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawDirect {
    /// u16 register that must hold `constants.identification`.
    identification: At<i64>,
    /// First coil of the state.
    state_coils: At<i64>,
    /// First register of each column.
    length: At<i64>,
    rotation: At<i64>,
    angle: At<i64>,
}

/// Such a machine; `rows` and `coils`: how many it has.
pub fn parse_direct(
    doc: &Document,
    unit_id: &At<i64>,
    modbus: &RawModbus,
    raw: &RawDirect,
    rows: i64,
    coils: u16,
) -> Result<DirectMap, ConfigError> {
    if let Some(order) = &modbus.word_order
        && modbus.word_order() != WordOrder::Abcd
    {
        let found = doc.text().get(order.span()).unwrap_or("");
        let allowed =
            "nothing, or \"abcd\": the numbers of [direct] are of one register each, its high byte first";
        return Err(doc.value_error(order.span(), "modbus.word_order", found, allowed));
    }
    let column = |value: &At<i64>, key: &str| -> Result<u16, ConfigError> {
        Ok(integer(doc, value, &format!("direct.{key}"), 0..=0x10000 - rows)? as u16)
    };
    // A column that is written in two requests could be left half old, half new.
    integer(doc, &modbus.max_write_registers, "modbus.max_write_registers", rows..=123)?;
    integer(doc, &modbus.max_read_registers, "modbus.max_read_registers", rows..=125)?;
    let area = |address, key, registers| Area { section: "direct", address, key, registers };
    let rows = rows as usize;
    let mut areas = [
        area(&raw.identification, "identification", 1),
        area(&raw.length, "length", rows),
        area(&raw.rotation, "rotation", rows),
        area(&raw.angle, "angle", rows),
    ];
    let map = DirectMap {
        unit_id: integer(doc, unit_id, "unit_id", 0..=255)? as u8,
        identification: integer(doc, &raw.identification, "direct.identification", 0..=0xffff)? as u16,
        state_coils: integer(doc, &raw.state_coils, "direct.state_coils", 0..=0x10000 - 16)? as u16,
        coils,
        columns: [
            column(&raw.length, "length")?,
            column(&raw.rotation, "rotation")?,
            column(&raw.angle, "angle")?,
        ],
    };
    check_overlap(doc, &mut areas)?;
    Ok(map)
}

impl From<RawWordOrder> for WordOrder {
    fn from(raw: RawWordOrder) -> WordOrder {
        match raw {
            RawWordOrder::Abcd => WordOrder::Abcd,
            RawWordOrder::Cdab => WordOrder::Cdab,
            RawWordOrder::Badc => WordOrder::Badc,
            RawWordOrder::Dcba => WordOrder::Dcba,
        }
    }
}

/// The device; whether its areas fit is known when the whole profile is ([`check_areas`]).
pub fn parse_modbus(
    doc: &Document,
    unit_id: &At<i64>,
    raw: &RawModbus,
    registers: &RawRegisters,
) -> Result<ModbusMap, ConfigError> {
    if raw.word_order.is_none() {
        let at = &raw.max_read_registers;
        let allowed = "with word_order beside it: \"abcd\", \"cdab\", \"badc\" or \"dcba\"";
        return Err(doc.value_error(at.span(), "modbus.max_read_registers", at.get_ref(), allowed));
    }
    // Every 32-bit value lies at an even distance from its area's start, so an even limit never splits one.
    let even = |value: &At<i64>, key, max| Ok(integer(doc, value, key, 4..=max)? as u16 & !1);
    Ok(ModbusMap {
        unit_id: integer(doc, unit_id, "unit_id", 0..=255)? as u8,
        max_read_registers: even(&raw.max_read_registers, "modbus.max_read_registers", 125)?,
        max_write_registers: even(&raw.max_write_registers, "modbus.max_write_registers", 123)?,
        registers: parse_registers(doc, registers)?,
    })
}

fn parse_registers(doc: &Document, raw: &RawRegisters) -> Result<Registers, ConfigError> {
    let address = |value: &At<i64>, key: &str| -> Result<u16, ConfigError> {
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

/// One group of registers: the address as written in the file, its key, how many.
struct Area<'a> {
    section: &'static str,
    address: &'a At<i64>,
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
        doc.value_error(self.address.span(), &format!("{}.{}", self.section, self.key), self.start(), allowed)
    }
}

fn areas<'a>(r: &'a RawRegisters, profile: &Profile) -> Vec<Area<'a>> {
    let payload = (profile.payload_header_bytes() + profile.limits.max_bends * Profile::ROW_BYTES) / 2;
    let area = |address, key, registers| Area { section: "registers", address, key, registers };
    vec![
        area(&r.identification, "identification", 2),
        area(&r.layout, "layout", 1),
        area(&r.heartbeat, "heartbeat", 1),
        area(&r.state, "state", 1),
        area(&r.bend_count, "bend_count", 1),
        area(&r.program, "program", profile.table.program_bytes / 2),
        area(&r.active_revision, "active_revision", 2),
        area(&r.active_crc, "active_crc", 2),
        area(&r.ack_revision, "ack_revision", 2),
        area(&r.ack_code, "ack_code", 1),
        area(&r.commit, "commit", 4),
        area(&r.staging, "staging", 4 + payload),
        area(&r.active, "active", payload),
    ]
}

/// Sorts areas by where they begin; no two overlap, and all fit.
fn check_overlap(doc: &Document, areas: &mut [Area<'_>]) -> Result<(), ConfigError> {
    areas.sort_by_key(Area::start);
    if let Some(area) = areas.iter().find(|a| a.end() > 0x10000) {
        let allowed = format!("at most {}: it takes {} registers", 0x10000 - area.registers, area.registers);
        return Err(area.complaint(doc, allowed));
    }
    match areas.iter().zip(areas.iter().skip(1)).find(|(a, b)| a.end() > b.start()) {
        Some((before, area)) => {
            Err(area.complaint(doc, format!("{} or more: {} ends there", before.end(), before.key)))
        }
        None => Ok(()),
    }
}

/// No two areas overlap, all fit, and one read covers the status.
pub fn check_areas(
    doc: &Document,
    raw: &RawRegisters,
    profile: &Profile,
    map: &ModbusMap,
) -> Result<(), ConfigError> {
    let mut areas = areas(raw, profile);
    check_overlap(doc, &mut areas)?;
    let mut status = areas.iter().filter(|a| !matches!(a.key, "staging" | "active"));
    let first = status.clone().map(Area::start).min().unwrap_or(0);
    let most = map.max_read_registers;
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

#[cfg(test)]
mod tests {
    use crate::bender::profile_file::testing::{complaint_of, parse};

    const TEXT: &str = include_str!("../../protocols/reference-modbus.toml");

    fn complaint(from: &str, to: &str) -> String {
        complaint_of(TEXT, from, to)
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

    /// Found: the rows of such a machine take the low register's two bytes, which another order fills with the high ones.
    #[test]
    fn a_map_without_a_staging_area_has_no_word_order() {
        const TEN: &str = include_str!("../../protocols/ten-row.toml");
        let with =
            |order: &str| parse(&TEN.replacen("[modbus]", &format!("[modbus]\nword_order = \"{order}\""), 1));
        assert!(!TEN.contains("word_order") && with("abcd").is_ok());
        for order in ["cdab", "badc", "dcba"] {
            let text = with(order).unwrap_err();
            let said = format!("modbus.word_order = \"{order}\", allowed is nothing, or \"abcd\"");
            assert!(text.contains(&said), "{text}");
        }
        let text = complaint("word_order = \"abcd\"", "");
        assert!(text.contains("modbus.max_read_registers = 125, allowed is with word_order"), "{text}");
    }

    #[test]
    fn columns_that_overlap_are_refused_and_the_neighbour_is_not() {
        const TEN: &str = include_str!("../../protocols/ten-row.toml");
        let complaint = |from, to| complaint_of(TEN, from, to);
        let text = complaint("rotation = 3583", "rotation = 3525");
        assert!(
            text.contains("direct.rotation = 3525, allowed is 3533 or more: length ends there"),
            "{text}"
        );
        let text = complaint("angle = 3553", "angle = 3583");
        assert!(text.contains("direct.angle = 3583, allowed is 3593 or more: rotation ends there"), "{text}");
        let text = complaint("identification = 2520", "identification = 3532");
        assert!(text.contains("direct.identification = 3532, allowed is 3533 or more"), "{text}");
        assert!(parse(&TEN.replacen("rotation = 3583", "rotation = 3533", 1)).is_ok());
        assert!(parse(&TEN.replacen("identification = 2520", "identification = 3533", 1)).is_ok());
    }

    #[test]
    fn a_map_without_a_staging_area_has_its_own_section_and_none_of_the_others() {
        const TEN: &str = include_str!("../../protocols/ten-row.toml");
        let complaint = |from, to| complaint_of(TEN, from, to);
        assert!(parse(TEN).is_ok());
        let text = complaint("max_write_registers = 123", "max_write_registers = 9");
        assert!(text.contains("max_write_registers = 9, allowed is 10 to 123"), "{text}");
        let text = complaint("[direct]", "[registers]");
        assert!(text.contains("unknown field"), "{text}");
        let text = complaint("length = 3523", "length = 65527");
        assert!(text.contains("direct.length = 65527, allowed is 0 to 65526"), "{text}");
        let text = complaint("identification = 60", "identification = 60\nlayout = 1");
        assert!(text.contains("constants.layout = 1, allowed is nothing"), "{text}");
        let text = complaint("identification = 60", "identification = 65536");
        assert!(text.contains("constants.identification = 65536, allowed is 1 to 65535"), "{text}");
        let text = complaint("rotation_sign", "program_characters = 32\nrotation_sign");
        assert!(text.contains("table.program_characters = 32, allowed is nothing"), "{text}");
        let text = parse(&TEXT.replacen("layout = 1", "", 1)).unwrap_err();
        assert!(text.contains("with layout beside it"), "{text}");
    }
}
