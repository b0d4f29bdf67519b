//! The part of a profile file that says which link leads to the machine: transport, line, serial port.
//!
//! Under `profile_file`.

use std::time::Duration;

use schemars::JsonSchema;
use serde::Deserialize;

use super::profile::{TableFormat, WordOrder};
use super::profile_can::{RawCan, RawCanopen, parse_can, parse_canopen};
use super::profile_file::integer;
use super::profile_modbus::{RawDirect, RawModbus, RawRegisters, parse_direct, parse_modbus};
use super::transport::{Device, LineSettings, Parity, SerialSettings, Transport};
use crate::config::{At, ConfigError, Document};

/// The links that exist.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
pub enum RawTransport {
    #[serde(rename = "modbus-tcp")]
    Tcp,
    #[serde(rename = "modbus-rtu")]
    Rtu,
    #[serde(rename = "modbus-rtu-over-tcp")]
    RtuOverTcp,
    #[serde(rename = "serial-table")]
    SerialTable,
    #[serde(rename = "shared-folder")]
    Folder,
    #[serde(rename = "can")]
    Can,
    #[serde(rename = "canopen")]
    Canopen,
}

impl RawTransport {
    /// Whether a part of the file belongs to this transport.
    fn needs(self, section: &str) -> bool {
        let needed: &[&str] = match self {
            RawTransport::Tcp => &["unit_id", "[modbus]", "[registers] or [direct]"],
            RawTransport::Rtu => &["unit_id", "[modbus]", "[registers] or [direct]", "[line]", "[serial]"],
            RawTransport::RtuOverTcp => &["unit_id", "[modbus]", "[registers] or [direct]", "[line]"],
            RawTransport::SerialTable => &["unit_id", "[line]", "[serial]"],
            RawTransport::Folder => &["unit_id"],
            RawTransport::Can => &["[can]"],
            RawTransport::Canopen => &["[canopen]"],
        };
        needed.contains(&section)
    }
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawLine {
    quiet_ms: At<i64>,
    echo: bool,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawSerial {
    baud: At<i64>,
    parity: Parity,
    stop_bits: At<i64>,
    rs485: bool,
}

/// The parts of a file that some transports need and others have no use for.
pub struct Sections<'a> {
    /// Who is asked on a line that has several.
    pub unit_id: Option<&'a At<i64>>,
    /// `[modbus]`.
    pub modbus: Option<&'a RawModbus>,
    /// `[registers]` or `[direct]`.
    pub map: Option<RawMap<'a>>,
    /// `[line]`.
    pub line: Option<&'a RawLine>,
    /// `[serial]`.
    pub serial: Option<&'a RawSerial>,
    /// `[can]`.
    pub can: Option<&'a RawCan>,
    /// `[canopen]`.
    pub canopen: Option<&'a RawCanopen>,
}

/// Where a Modbus device keeps its values.
#[derive(Clone, Copy)]
pub enum RawMap<'a> {
    /// `[registers]`.
    Staged(&'a RawRegisters),
    /// `[direct]`, how many rows, how many coils of state.
    Direct(&'a RawDirect, i64, u16),
}

impl Sections<'_> {
    /// Of 32-bit values; where the file says nothing, the highest byte first.
    pub fn word_order(&self) -> WordOrder {
        self.modbus.map_or(WordOrder::Abcd, RawModbus::word_order)
    }

    fn all(&self) -> [(&'static str, bool); 7] {
        [
            ("unit_id", self.unit_id.is_some()),
            ("[modbus]", self.modbus.is_some()),
            ("[registers] or [direct]", self.map.is_some()),
            ("[line]", self.line.is_some()),
            ("[serial]", self.serial.is_some()),
            ("[can]", self.can.is_some()),
            ("[canopen]", self.canopen.is_some()),
        ]
    }
}

/// The transport with all that it needs and nothing that it has no use for.
pub fn parse_transport(
    doc: &Document,
    transport: &At<RawTransport>,
    sections: &Sections<'_>,
    table: &TableFormat,
) -> Result<Transport, ConfigError> {
    let kind = *transport.get_ref();
    let complaint = || complaint(doc, transport, sections);
    if sections.all().into_iter().any(|(name, is)| kind.needs(name) != is) {
        return Err(complaint());
    }
    let unit = || sections.unit_id.ok_or_else(complaint);
    let device = || {
        let modbus = sections.modbus.ok_or_else(complaint)?;
        Ok(match sections.map.ok_or_else(complaint)? {
            RawMap::Staged(registers) => Device::Staged(parse_modbus(doc, unit()?, modbus, registers)?),
            RawMap::Direct(direct, rows, coils) => {
                Device::Direct(parse_direct(doc, unit()?, modbus, direct, rows, coils)?)
            }
        })
    };
    let line = || parse_line(doc, sections.line.ok_or_else(complaint)?);
    let serial = || parse_serial(doc, sections.serial.ok_or_else(complaint)?);
    Ok(match kind {
        RawTransport::Tcp => Transport::ModbusTcp(device()?),
        RawTransport::Rtu => Transport::ModbusRtu(device()?, line()?, serial()?),
        RawTransport::RtuOverTcp => Transport::ModbusRtuOverTcp(device()?, line()?),
        RawTransport::SerialTable => {
            Transport::SerialTable(integer(doc, unit()?, "unit_id", 0..=255)? as u8, line()?, serial()?)
        }
        RawTransport::Folder => Transport::Folder(integer(doc, unit()?, "unit_id", 0..=9999)? as u16),
        RawTransport::Can => Transport::Can(parse_can(doc, sections.can.ok_or_else(complaint)?, table)?),
        RawTransport::Canopen => {
            Transport::Canopen(parse_canopen(doc, sections.canopen.ok_or_else(complaint)?)?)
        }
    })
}

/// What is missing, and what there is no use for.
fn complaint(doc: &Document, transport: &At<RawTransport>, sections: &Sections<'_>) -> ConfigError {
    let name = doc.text().get(transport.span()).unwrap_or("");
    let wrong = sections.all().into_iter().filter(|(name, is)| transport.get_ref().needs(name) != *is);
    let (with, without): (Vec<_>, Vec<_>) = wrong.partition(|(_, is)| !*is);
    let list = |what: &str, names: &[(&str, bool)]| {
        let names: Vec<&str> = names.iter().map(|(name, _)| *name).collect();
        if names.is_empty() { String::new() } else { format!("{what} {}", names.join(" and ")) }
    };
    let allowed = [list("with", &with), list("without", &without)];
    let allowed: Vec<String> = allowed.into_iter().filter(|text| !text.is_empty()).collect();
    doc.value_error(transport.span(), "transport", name, allowed.join(", "))
}

fn parse_line(doc: &Document, raw: &RawLine) -> Result<LineSettings, ConfigError> {
    let quiet_ms = integer(doc, &raw.quiet_ms, "line.quiet_ms", 1..=60_000)?;
    Ok(LineSettings { quiet: Duration::from_millis(quiet_ms as u64), echo: raw.echo })
}

fn parse_serial(doc: &Document, raw: &RawSerial) -> Result<SerialSettings, ConfigError> {
    Ok(SerialSettings {
        baud: integer(doc, &raw.baud, "serial.baud", 300..=4_000_000)? as u32,
        parity: raw.parity,
        stop_bits: integer(doc, &raw.stop_bits, "serial.stop_bits", 1..=2)? as u8,
        rs485: raw.rs485,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::profile_file::testing::{complaint_of, parse};

    const RTU: &str = include_str!("../../protocols/reference-rtu.toml");

    #[test]
    fn a_serial_line_is_read_with_all_its_settings() {
        let profile = parse(RTU).unwrap();
        let line = LineSettings { quiet: Duration::from_millis(500), echo: false };
        let serial = SerialSettings { baud: 19_200, parity: Parity::Even, stop_bits: 1, rs485: false };
        let Transport::ModbusRtu(_, found_line, found_serial) = profile.transport else { panic!() };
        assert_eq!((found_line, found_serial), (line, serial));
    }

    #[test]
    fn what_a_transport_lacks_or_has_no_use_for_is_named() {
        let complaint = |from, to| complaint_of(RTU, from, to);
        let text = complaint("\"modbus-rtu\"", "\"modbus-tcp\"");
        assert!(
            text.contains("transport = \"modbus-tcp\", allowed is without [line] and [serial]"),
            "{text}"
        );
        let text = complaint("\"modbus-rtu\"", "\"modbus-rtu-over-tcp\"");
        assert!(text.contains("without [serial]"), "{text}");
        assert!(complaint("baud = 19200", "baud = 299").contains("serial.baud = 299, allowed is 300 to"));
        assert!(complaint("stop_bits = 1", "stop_bits = 3").contains("serial.stop_bits = 3"));
        assert!(complaint("quiet_ms = 500", "quiet_ms = 0").contains("line.quiet_ms = 0"));
        assert!(complaint("\"even\"", "\"mark\"").contains("mark"));
        assert!(complaint("endpoint = \"/dev", "endpoint = \"dev").contains("path of a serial port"));
    }
}
