//! What would explain a machine that a profile does not understand: the profile with one or two things changed, and that change in
//! words. Pure; `selftest` tries them on the machine.

use super::profile::{Profile, WordOrder};
use super::registers::Registers;
use super::transport::{Device, Transport};

/// A profile that may be the right one.
#[derive(Debug, Clone)]
pub struct Guess {
    /// What to change, for people.
    pub change: String,
    /// The profile with that change.
    pub profile: Profile,
}

/// The word orders by their names in a profile.
const ORDERS: [(WordOrder, &str); 4] = [
    (WordOrder::Abcd, "abcd"),
    (WordOrder::Cdab, "cdab"),
    (WordOrder::Badc, "badc"),
    (WordOrder::Dcba, "dcba"),
];

/// Numbers that machines are delivered with.
const USUAL_UNITS: [u8; 5] = [1, 2, 3, 0, 255];

/// Other addresses and word orders, for a machine that answers something else.
pub fn others(profile: &Profile) -> Vec<Guess> {
    let Some(map) = profile.transport.modbus() else { return Vec::new() };
    let shifts = [
        (0, ""),
        (-1, "addresses are counted from 1 in this profile: subtract 1 from every address in [registers]"),
        (1, "the machine's registers begin one later: add 1 to every address in [registers]"),
    ];
    let mut guesses = Vec::new();
    for (by, move_by) in shifts {
        let Some(registers) = shifted(&map.registers, by) else { continue };
        for (order, name) in ORDERS {
            let same_order = order == profile.table.word_order;
            if same_order && by == 0 {
                continue;
            }
            let mut other = profile.clone();
            other.table.word_order = order;
            if let Some(map) = modbus_of(&mut other.transport) {
                map.registers = registers.clone();
            }
            let mut changes = Vec::new();
            if by != 0 {
                changes.push(move_by.to_owned());
            }
            if !same_order {
                changes.push(format!("set word_order = \"{name}\" in [modbus]"));
            }
            guesses.push(Guess { change: changes.join("; and "), profile: other });
        }
    }
    guesses
}

/// Other units, for a machine that does not answer.
pub fn silent_ones(profile: &Profile) -> Vec<Guess> {
    let own = match &profile.transport {
        Transport::SerialTable(unit, ..) => Some(*unit),
        transport => transport.modbus().map(|map| map.unit_id),
    };
    let Some(own) = own else { return Vec::new() };
    let with_unit = |unit: u8| {
        let mut other = profile.clone();
        if let Transport::SerialTable(number, ..) = &mut other.transport {
            *number = unit;
        }
        if let Some(map) = modbus_of(&mut other.transport) {
            map.unit_id = unit;
        }
        Guess { change: format!("the machine answers as unit {unit}: set unit_id = {unit}"), profile: other }
    };
    USUAL_UNITS.into_iter().filter(|unit| *unit != own).map(with_unit).collect()
}

/// The same with no more than so many registers in a read.
pub fn with_smaller_reads(profile: &Profile, most: u16) -> Profile {
    let mut smaller = profile.clone();
    if let Some(map) = modbus_of(&mut smaller.transport) {
        map.max_read_registers = most;
    }
    smaller
}

fn modbus_of(transport: &mut Transport) -> Option<&mut super::registers::ModbusMap> {
    match transport {
        Transport::ModbusTcp(Device::Staged(map))
        | Transport::ModbusRtu(Device::Staged(map), ..)
        | Transport::ModbusRtuOverTcp(Device::Staged(map), _) => Some(map),
        _ => None,
    }
}

/// All addresses moved; none where one would leave the range.
fn shifted(registers: &Registers, by: i16) -> Option<Registers> {
    let at = |address: u16| address.checked_add_signed(by);
    Some(Registers {
        identification: at(registers.identification)?,
        layout: at(registers.layout)?,
        heartbeat: at(registers.heartbeat)?,
        state: at(registers.state)?,
        bend_count: at(registers.bend_count)?,
        program: at(registers.program)?,
        active_revision: at(registers.active_revision)?,
        active_crc: at(registers.active_crc)?,
        ack_revision: at(registers.ack_revision)?,
        ack_code: at(registers.ack_code)?,
        commit: at(registers.commit)?,
        staging: at(registers.staging)?,
        active: at(registers.active)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::{decode_status, status_span};

    /// The registers of a machine with this word order whose map begins at `base`, as one row of bytes from register 0.
    fn machine(order: WordOrder, base: usize) -> Vec<u8> {
        let mut bytes = vec![0; 2 * (40 + base)];
        bytes[2 * base..2 * base + 4].copy_from_slice(&order.arrange(*b"BEND"));
        bytes[2 * base + 5] = 1;
        bytes
    }

    /// What the guesses say to change, for a profile whose addresses begin at `first`.
    fn explained(first: u16, machine: &[u8]) -> Vec<String> {
        let mut profile = Profile::load("reference-modbus").unwrap();
        let map = modbus_of(&mut profile.transport).unwrap();
        map.registers = shifted(&map.registers, first as i16).unwrap();
        let understands = |guess: &Guess| {
            let map = guess.profile.transport.modbus().unwrap();
            let (first, count) = status_span(&guess.profile, map);
            let bytes = machine.get(2 * usize::from(first)..2 * usize::from(first + count)).unwrap();
            decode_status(&guess.profile, map, bytes).is_ok()
        };
        others(&profile).into_iter().filter(understands).map(|guess| guess.change).collect()
    }

    #[test]
    fn another_word_order_or_base_is_the_only_explanation() {
        let order = |name: &str| format!("set word_order = \"{name}\" in [modbus]");
        assert_eq!(explained(0, &machine(WordOrder::Cdab, 0)), [order("cdab")]);
        assert_eq!(explained(0, &machine(WordOrder::Badc, 0)), [order("badc")]);
        assert_eq!(explained(0, &machine(WordOrder::Dcba, 0)), [order("dcba")]);
        let from_1 = explained(1, &machine(WordOrder::Abcd, 0));
        assert_eq!(from_1.len(), 1);
        assert!(from_1[0].contains("counted from 1") && from_1[0].contains("subtract 1"), "{from_1:?}");
        let later = explained(0, &machine(WordOrder::Abcd, 1));
        assert!(later.len() == 1 && later[0].contains("add 1 to every address"), "{later:?}");
        let both = explained(1, &machine(WordOrder::Cdab, 0));
        assert!(both.len() == 1 && both[0].contains("subtract 1") && both[0].ends_with(&order("cdab")));
        assert!(explained(0, &[0; 100]).is_empty(), "another machine");
    }

    #[test]
    fn units_are_tried_where_there_are_any_and_no_address_leaves_the_range() {
        let of = |name: &str| Profile::load(name).unwrap();
        let changes: Vec<String> =
            silent_ones(&of("reference-rtu")).into_iter().map(|guess| guess.change).collect();
        assert_eq!(changes.len(), 4);
        assert!(changes[0].ends_with("set unit_id = 2"), "{changes:?}");
        let Transport::SerialTable(unit, ..) = silent_ones(&of("reference-serial"))[0].profile.transport
        else {
            panic!()
        };
        assert_ne!(unit, 1);
        assert!(
            silent_ones(&of("reference-folder")).is_empty() && others(&of("reference-folder")).is_empty()
        );
        assert_eq!(others(&of("reference-modbus")).len(), 3 + 4, "none below register 0");
    }
}
