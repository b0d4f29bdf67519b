//! A Modbus device as its profile describes it: where each value is, how much fits into a request, and what its status says. Read
//! from a profile's file (`profile_modbus`); `plan` makes the requests.

use super::profile::Profile;
use super::wire::{Ack, Status, TableId, check_constants, text_of, u32_at};

/// A Modbus device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModbusMap {
    /// Unit identifier.
    pub unit_id: u8,
    /// Registers per read request, even, 4 to 125.
    pub max_read_registers: u16,
    /// Registers per write request, even, 4 to 123.
    pub max_write_registers: u16,
    /// Where things are.
    pub registers: Registers,
}

/// Addresses of holding registers, counted from 0. No two areas overlap.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Registers {
    /// u32 constant that proves map and word order.
    pub identification: u16,
    /// u16 constant, version of the layout.
    pub layout: u16,
    /// u16 that counts up while the controller's program runs.
    pub heartbeat: u16,
    /// u16 state word.
    pub state: u16,
    /// u16, bends of the loaded program.
    pub bend_count: u16,
    /// Text, name of the loaded program.
    pub program: u16,
    /// u32, revision of the table in force.
    pub active_revision: u16,
    /// u32, CRC of the table in force.
    pub active_crc: u16,
    /// u32, revision that the last acknowledgement speaks of.
    pub ack_revision: u16,
    /// u16, the acknowledgement.
    pub ack_code: u16,
    /// u32 revision and u32 CRC, the commit word; the controller clears it when it has dealt with it.
    pub commit: u16,
    /// u32 revision, u32 CRC, then the payload.
    pub staging: u16,
    /// The payload in force.
    pub active: u16,
}

/// A value that the machine keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// What it is.
    pub name: &'static str,
    /// Where it begins.
    pub address: u16,
    /// How many registers it takes.
    pub registers: u16,
}

/// The values outside of staging and active area, in the order of their addresses.
pub fn fields(profile: &Profile, map: &ModbusMap) -> Vec<Field> {
    let Registers { identification, layout, heartbeat, state, bend_count, program, .. } = map.registers;
    let Registers { active_revision, active_crc, ack_revision, ack_code, commit, .. } = map.registers;
    let field = |name, address, registers| Field { name, address, registers };
    let mut fields = vec![
        field("identification", identification, 2),
        field("layout", layout, 1),
        field("heartbeat", heartbeat, 1),
        field("state", state, 1),
        field("bend count", bend_count, 1),
        field("program", program, (profile.table.program_bytes / 2) as u16),
        field("active revision", active_revision, 2),
        field("active CRC", active_crc, 2),
        field("acknowledged revision", ack_revision, 2),
        field("acknowledgement", ack_code, 1),
        field("commit: revision, CRC", commit, 4),
    ];
    fields.sort_by_key(|f| f.address);
    fields
}

/// First address and number of registers of the status.
pub fn status_span(profile: &Profile, map: &ModbusMap) -> (u16, u16) {
    let fields = fields(profile, map);
    let first = fields.iter().map(|f| f.address).min().unwrap_or(0);
    let end = fields.iter().map(|f| u32::from(f.address) + u32::from(f.registers)).max().unwrap_or(0);
    (first, (end - u32::from(first)) as u16)
}

/// The status from the bytes of [`status_span`]; an error names the constant that is wrong.
pub fn decode_status(profile: &Profile, map: &ModbusMap, bytes: &[u8]) -> Result<Status, String> {
    let (first, count) = status_span(profile, map);
    if bytes.len() != 2 * usize::from(count) {
        return Err(format!("a status has {count} registers, found {}", bytes.len() / 2));
    }
    let (r, order) = (&map.registers, profile.table.word_order);
    let at = |address: u16| 2 * usize::from(address - first);
    let long = |address: u16| u32_at(order, bytes, at(address));
    let word = |address: u16| u16::from_be_bytes([bytes[at(address)], bytes[at(address) + 1]]);
    let places = (format!("register {}", r.identification), format!("register {}", r.layout));
    check_constants(profile, (&places.0, long(r.identification)), (&places.1, word(r.layout)))?;
    let program = at(r.program)..at(r.program) + profile.table.program_bytes;
    Ok(Status {
        heartbeat: word(r.heartbeat),
        state: word(r.state),
        program: text_of(&bytes[program]),
        bend_count: word(r.bend_count),
        active: TableId { revision: long(r.active_revision), crc: long(r.active_crc) },
        ack_revision: long(r.ack_revision),
        ack: Ack::from_code(word(r.ack_code)),
        pending: TableId { revision: long(r.commit), crc: long(r.commit + 2) },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_foreign_constant_is_named() {
        let p = Profile::load("reference-modbus").unwrap();
        let map = p.transport.modbus().unwrap();
        let (_, count) = status_span(&p, map);
        assert_eq!(status_span(&p, map), (0, 36));
        let mut bytes = vec![0; 2 * usize::from(count)];
        assert!(decode_status(&p, map, &bytes).unwrap_err().contains("register 0 holds 0x00000000"));
        bytes[..4].copy_from_slice(b"NDBE");
        assert!(decode_status(&p, map, &bytes).unwrap_err().contains("word order"));
        bytes[..4].copy_from_slice(b"BEND");
        assert!(decode_status(&p, map, &bytes).unwrap_err().contains("register 2 says layout 0"));
        bytes[5] = 1;
        assert_eq!(decode_status(&p, map, &bytes).unwrap().active, TableId::default());
        assert!(decode_status(&p, map, &bytes[2..]).is_err());
    }
}
