//! A profile file as it is written: its keys, and the JSON schema that editors check them by. What the values must be, `profile_file`
//! says.

use schemars::JsonSchema;
use serde::Deserialize;

use super::profile::Sequence;
use super::profile_can::{RawCan, RawCanopen};
use super::profile_modbus::{RawDirect, RawModbus, RawRegisters};
use super::profile_transport::{RawLine, RawSerial, RawTransport};
use crate::config::At;

/// The schema of profile files, as protocols/profile.schema.json has it.
pub fn profile_schema() -> String {
    let schema = schemars::schema_for!(RawProfile);
    serde_json::to_string_pretty(&schema).unwrap_or_default() + "\n"
}

/// A machine's profile: what benderd must know of it to deliver tables. `benderd check --plan FILE` checks every value.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawProfile {
    /// Version of this form: 1.
    pub version: At<i64>,
    /// Short name, 1 to 32 characters.
    pub name: At<String>,
    /// One line for people.
    pub description: At<String>,
    /// Which link leads to the machine.
    pub transport: At<RawTransport>,
    /// Where it is: host:port, the path of a serial port or a folder, a CAN interface.
    pub endpoint: At<String>,
    /// Who is asked: Modbus unit, number on a serial line, number of a bender in a folder.
    pub unit_id: Option<At<i64>>,
    /// Of Modbus devices.
    pub modbus: Option<RawModbus>,
    /// Of Modbus devices with a staging area.
    pub registers: Option<RawRegisters>,
    /// Of Modbus devices whose rows are in force as soon as they are written.
    pub direct: Option<RawDirect>,
    /// Of lines that cannot be closed.
    pub line: Option<RawLine>,
    /// Of serial ports.
    pub serial: Option<RawSerial>,
    /// Of machines on CAN.
    pub can: Option<RawCan>,
    /// Of machines on CANopen.
    pub canopen: Option<RawCanopen>,
    /// By which the machine is known.
    pub constants: RawConstants,
    /// How a table is written in whole numbers.
    pub table: RawTable,
    /// What must hold before anything is sent.
    pub state_bit: Vec<RawStateBit>,
    /// What the machine can do.
    pub limits: RawLimits,
    /// How long to wait for what.
    pub deadlines: RawDeadlines,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawConstants {
    /// 1 to 4294967295.
    pub identification: At<i64>,
    /// 0 to 65535; not with `direct`.
    pub layout: Option<At<i64>>,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawTable {
    /// Longest name of a program, a multiple of 4 up to 64; not with `direct`.
    pub program_characters: Option<At<i64>>,
    /// Millimetres a count, 0.0001 to 1.
    pub length_resolution_mm: At<f64>,
    /// Degrees a count, 0.00001 to 1.
    pub angle_resolution_deg: At<f64>,
    /// 1: right-handed about the feed direction, -1: the other way.
    pub rotation_sign: At<i64>,
    /// How lengths are counted.
    #[serde(default)]
    pub feed: Sequence,
    /// How rotations are counted.
    #[serde(default)]
    pub rotation: Sequence,
    /// Names on the machine's screen.
    pub columns: Option<RawColumns>,
}

/// What the machine's screen calls them.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawColumns {
    /// Of length.
    pub length: At<String>,
    /// Of rotation.
    pub rotation: At<String>,
    /// Of angle.
    pub angle: At<String>,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawStateBit {
    /// 0 (the least significant) to 15.
    pub bit: At<i64>,
    /// What it says when set.
    pub name: At<String>,
    /// Without this value nothing is sent.
    pub must_be: bool,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawLimits {
    /// 1 to 1000.
    pub max_bends: At<i64>,
    /// Shortest straight before the first bend.
    pub min_first_length_mm: At<f64>,
    /// Shortest straight between two bends.
    pub min_between_mm: At<f64>,
    /// Longest straight.
    pub max_length_mm: At<f64>,
    /// Largest bend, up to 359.
    pub max_angle_deg: At<f64>,
    /// Largest turn of the plane between two bends, up to 3600.
    pub max_rotation_deg: At<f64>,
}

#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawDeadlines {
    /// To open the connection.
    pub connect_ms: At<i64>,
    /// For one reply.
    pub request_ms: At<i64>,
    /// For a whole table; not over Modbus, where each request has its own time.
    pub transfer_ms: Option<At<i64>>,
    /// Longest time in which a live machine's heartbeat stands still.
    pub heartbeat_ms: At<i64>,
    /// From the commit to the table being active.
    pub confirm_ms: At<i64>,
    /// Longest time in which a commit that was sent may still arrive; below confirm_ms.
    pub settle_ms: At<i64>,
    /// Between two looks at the machine.
    pub poll_ms: At<i64>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    const SHIPPED: &str = include_str!("../../protocols/profile.schema.json");

    /// Written anew by `UPDATE_SCHEMA=1 cargo test profile_schema`.
    #[test]
    fn the_shipped_profile_schema_is_the_programs() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/protocols/profile.schema.json");
        if std::env::var_os("UPDATE_SCHEMA").is_some() {
            std::fs::write(path, profile_schema()).unwrap();
        }
        assert_eq!(
            std::fs::read_to_string(path).unwrap(),
            profile_schema(),
            "UPDATE_SCHEMA=1 writes it anew"
        );
    }

    /// Every key of a value is known to its schema, and every key that must be there is.
    fn check(schema: &Value, all: &Value, value: &Value, at: &str) {
        if let Some(name) = schema["$ref"].as_str() {
            let name = name.rsplit('/').next().unwrap();
            return check(&all["$defs"][name], all, value, at);
        }
        if let Some(options) = schema["anyOf"].as_array() {
            let option = options.iter().find(|o| o["type"] != "null").unwrap();
            return check(option, all, value, at);
        }
        match value {
            Value::Object(table) => {
                assert_eq!(schema["additionalProperties"], false, "{at}");
                for (key, value) in table {
                    let property = &schema["properties"][key];
                    assert!(!property.is_null(), "{at}.{key} is not in the schema");
                    check(property, all, value, &format!("{at}.{key}"));
                }
                for key in schema["required"].as_array().into_iter().flatten() {
                    assert!(table.contains_key(key.as_str().unwrap()), "{at}.{key} is required");
                }
            }
            Value::Array(list) => list.iter().for_each(|value| check(&schema["items"], all, value, at)),
            _ => {}
        }
    }

    #[test]
    fn every_shipped_profile_fits_the_profile_schema() {
        let schema: Value = serde_json::from_str(SHIPPED).unwrap();
        let mut count = 0;
        for file in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/protocols")).unwrap() {
            let path = file.unwrap().path();
            if path.extension().is_some_and(|e| e == "toml") {
                let value: Value = toml::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
                check(&schema, &schema, &value, &path.display().to_string());
                count += 1;
            }
        }
        assert_eq!(count, crate::bender::shipped_profiles().count());
    }
}
