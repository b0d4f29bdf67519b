//! The part of a profile file that says which link leads to the machine: transport, line, serial port.
//!
//! Under `profile_file`.

use std::time::Duration;

use serde::Deserialize;
use toml::Spanned;

use super::profile_file::integer;
use super::transport::{LineSettings, Parity, SerialSettings, Transport};
use crate::config::{ConfigError, Document};

/// The links that exist.
#[derive(Debug, Clone, Copy, Deserialize)]
pub enum RawTransport {
    #[serde(rename = "modbus-tcp")]
    Tcp,
    #[serde(rename = "modbus-rtu")]
    Rtu,
    #[serde(rename = "modbus-rtu-over-tcp")]
    RtuOverTcp,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawLine {
    quiet_ms: Spanned<i64>,
    echo: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawSerial {
    baud: Spanned<i64>,
    parity: Parity,
    stop_bits: Spanned<i64>,
    rs485: bool,
}

/// The transport with all that it needs and nothing that it has no use for.
pub fn parse_transport(
    doc: &Document,
    transport: &Spanned<RawTransport>,
    line: Option<&RawLine>,
    serial: Option<&RawSerial>,
) -> Result<Transport, ConfigError> {
    let wrong = |allowed: &str| {
        let name = doc.text().get(transport.span()).unwrap_or("");
        Err(doc.value_error(transport.span(), "transport", name, allowed))
    };
    match (transport.get_ref(), line, serial) {
        (RawTransport::Tcp, None, None) => Ok(Transport::ModbusTcp),
        (RawTransport::Tcp, ..) => wrong("without [line] and [serial]"),
        (RawTransport::Rtu, Some(line), Some(serial)) => {
            Ok(Transport::ModbusRtu(parse_line(doc, line)?, parse_serial(doc, serial)?))
        }
        (RawTransport::Rtu, ..) => wrong("with [line] and [serial]"),
        (RawTransport::RtuOverTcp, Some(line), None) => {
            Ok(Transport::ModbusRtuOverTcp(parse_line(doc, line)?))
        }
        (RawTransport::RtuOverTcp, ..) => wrong("with [line], without [serial]"),
    }
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
    use crate::bender::Profile;

    fn parse(text: &str) -> Result<Profile, String> {
        Profile::parse(&Document::new("p.toml", text)).map_err(|e| e.to_string())
    }

    const RTU: &str = include_str!("../../protocols/reference-rtu.toml");

    #[test]
    fn a_serial_line_is_read_with_all_its_settings() {
        let profile = parse(RTU).unwrap();
        let line = LineSettings { quiet: Duration::from_millis(500), echo: false };
        let serial = SerialSettings { baud: 19_200, parity: Parity::Even, stop_bits: 1, rs485: false };
        assert_eq!(profile.transport, Transport::ModbusRtu(line, serial));
    }

    #[test]
    fn what_a_transport_lacks_or_has_no_use_for_is_named() {
        let complaint = |from: &str, to: &str| {
            assert!(RTU.contains(from), "{from:?}");
            parse(&RTU.replacen(from, to, 1)).unwrap_err()
        };
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
