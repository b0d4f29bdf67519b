//! The part of a profile file that a machine on CAN or CANopen needs: its database, or its node and objects.
//!
//! Under `profile_file`.

use std::path::Path;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::Deserialize;

use super::can_table::{CanSettings, Contract, PROGRAM_BYTES, ROWS};
use super::dbc::Database;
use super::profile::TableFormat;
use super::profile_file::integer;
use super::sdo::{CanopenSettings, Object};
use crate::config::{At, ConfigError, Document};

/// The database that comes with the program, and its name.
const SHIPPED: (&str, &str) = ("bender.dbc", include_str!("../../protocols/bender.dbc"));

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawCan {
    /// "bender.dbc" is the one that comes with the program; any other is a path, seen from the profile's folder.
    dbc: At<String>,
    fd: bool,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawCanopen {
    node: At<i64>,
    transfer: RawTransfer,
    status: At<String>,
    staging: At<String>,
    commit: At<String>,
    active: At<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
enum RawTransfer {
    Block,
    Segmented,
}

/// The machine's messages, all that are needed.
pub fn parse_can(doc: &Document, raw: &RawCan, table: &TableFormat) -> Result<CanSettings, ConfigError> {
    let name = raw.dbc.get_ref();
    let (file, text) = if name == SHIPPED.0 {
        (format!("protocols/{name} (built in)"), SHIPPED.1.to_owned())
    } else {
        let path = Path::new(doc.file()).parent().unwrap_or(Path::new("")).join(name);
        let text = std::fs::read(&path).map_err(|cause| {
            let found = format!("{name:?} ({}: {cause})", path.display());
            let allowed = format!(
                "{:?} (built in), or the path of a CAN database, seen from the profile's folder",
                SHIPPED.0
            );
            doc.value_error(raw.dbc.span(), "can.dbc", found, allowed)
        })?;
        // Names and comments may be in the alphabet of their author's computer; what counts is ASCII.
        (path.display().to_string(), String::from_utf8_lossy(&text).into_owned())
    };
    let contract = Database::parse(&text).and_then(|database| Contract::of(&database, table, raw.fd));
    let contract = contract.map_err(|error| ConfigError::Syntax { file, detail: error.to_string() })?;
    Ok(CanSettings { contract: Arc::new(contract), fd: raw.fd })
}

/// What the messages have no room for.
pub fn check_can(doc: &Document, characters: &At<i64>, bends: &At<i64>) -> Result<(), ConfigError> {
    integer(doc, characters, "table.program_characters", 4..=PROGRAM_BYTES as i64)?;
    integer(doc, bends, "limits.max_bends", 1..=ROWS as i64)?;
    Ok(())
}

/// The machine's node and objects.
pub fn parse_canopen(doc: &Document, raw: &RawCanopen) -> Result<CanopenSettings, ConfigError> {
    let object = |value: &At<String>, key: &str| -> Result<Object, ConfigError> {
        value.get_ref().parse().map_err(|()| {
            let found = format!("{:?}", value.get_ref());
            doc.value_error(
                value.span(),
                &format!("canopen.{key}"),
                found,
                "index and subindex in hexadecimal: \"2000:00\"",
            )
        })
    };
    let named = [
        ("status", &raw.status),
        ("staging", &raw.staging),
        ("commit", &raw.commit),
        ("active", &raw.active),
    ];
    let mut objects = Vec::new();
    for (key, value) in named {
        let found = object(value, key)?;
        if let Some(same) = objects.iter().position(|o| *o == found) {
            let allowed = format!("another than canopen.{}", named[same].0);
            return Err(doc.value_error(
                value.span(),
                &format!("canopen.{key}"),
                format!("{:?}", value.get_ref()),
                allowed,
            ));
        }
        objects.push(found);
    }
    Ok(CanopenSettings {
        node: integer(doc, &raw.node, "canopen.node", 1..=127)? as u8,
        block: raw.transfer == RawTransfer::Block,
        status: objects[0],
        staging: objects[1],
        commit: objects[2],
        active: objects[3],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::profile_file::testing::complaint_of as complaint;
    use crate::bender::{Profile, Transport};

    const CAN: &str = include_str!("../../protocols/reference-can.toml");
    const CANOPEN: &str = include_str!("../../protocols/reference-canopen.toml");

    #[test]
    fn canopen_is_read_and_its_complaints_name_the_key() {
        let profile = Profile::load("reference-canopen").unwrap();
        let Transport::Canopen(settings) = &profile.transport else { panic!() };
        let object = |index| Object { index, subindex: 0 };
        assert_eq!((settings.node, settings.block, settings.status), (5, true, object(0x2000)));
        assert_eq!(
            (settings.staging, settings.commit, settings.active),
            (object(0x2001), object(0x2002), object(0x2003))
        );
        assert!(
            complaint(CANOPEN, "node = 5", "node = 128").contains("canopen.node = 128, allowed is 1 to 127")
        );
        assert!(
            complaint(CANOPEN, "\"2001:00\"", "\"2001\"")
                .contains("canopen.staging = \"2001\", allowed is index")
        );
        assert!(complaint(CANOPEN, "\"2001:00\"", "\"+001:00\"").contains("canopen.staging"));
        assert!(complaint(CANOPEN, "\"2001:00\"", "\"2000:00\"").contains("another than canopen.status"));
        assert!(complaint(CANOPEN, "\"block\"", "\"bulk\"").contains("segmented"));
        assert!(complaint(CANOPEN, "\"canopen\"", "\"can\"").contains("with [can], without [canopen]"));
        assert!(
            complaint(CANOPEN, "endpoint = \"can0\"", "endpoint = \"/dev/can0\"")
                .contains("name of a CAN interface")
        );
        assert!(
            complaint(CANOPEN, "endpoint = \"can0\"", "endpoint = \"0123456789abcdef\"")
                .contains("up to 14 letters and digits")
        );
    }

    #[test]
    fn a_database_is_built_in_or_beside_the_profile() {
        let profile = Profile::load("reference-can").unwrap();
        assert!(matches!(&profile.transport, Transport::Can(settings) if !settings.fd));
        let text = complaint(CAN, "\"bender.dbc\"", "\"none.dbc\"");
        assert!(text.contains("can.dbc = \"none.dbc\" (none.dbc: "), "{text}");
        assert!(complaint(CAN, "characters = 32", "characters = 36").contains("allowed is 4 to 32"));
        assert!(complaint(CAN, "max_bends = 40", "max_bends = 256").contains("allowed is 1 to 255"));
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("own.toml");
        std::fs::write(&file, CAN.replace("bender.dbc", "own.dbc")).unwrap();
        let load = |database: &str| {
            std::fs::write(folder.path().join("own.dbc"), database).unwrap();
            Profile::load(&file.display().to_string()).map_err(|e| e.to_string())
        };
        let own = load(SHIPPED.1).unwrap();
        assert_eq!(own.transport, profile.transport);
        let text = load(&SHIPPED.1.replace("AckCode", "Answer")).unwrap_err();
        assert!(text.contains("own.dbc: signal AckCode of message STATUS_ITEM is missing"), "{text}");
        assert!(load("no database").unwrap_err().contains("own.dbc: not a CAN database"));
    }
}
