//! The simulated bender as a Modbus device: what it keeps, as registers.

use super::bender::MachineModel;
use crate::bender::{Device, Field, ModbusMap, TableId, fields, status_span};

/// Why a request is refused, as Modbus names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// No such register, or not for writing (exception 2).
    Address,
    /// Not in this way (exception 3).
    Value,
}

/// First byte of an area's register, and the area.
type Area = (u16, Vec<u8>);

impl MachineModel {
    /// The device's map; a machine that speaks no Modbus has no registers.
    fn map(&self) -> Option<&ModbusMap> {
        self.profile.transport.modbus()
    }

    fn is_direct(&self) -> bool {
        self.profile.transport.direct().is_some()
    }

    /// The unit that it answers for.
    pub fn unit_id(&self) -> u8 {
        match self.profile.transport.device() {
            Some(Device::Staged(map)) => map.unit_id,
            Some(Device::Direct(map)) => map.unit_id,
            None => 0,
        }
    }

    /// Where a commit is written.
    pub fn commit_address(&self) -> Option<u16> {
        self.map().map(|map| map.registers.commit)
    }

    /// Reads registers.
    pub fn read(&self, address: u16, count: u16) -> Result<Vec<u16>, Refusal> {
        if self.is_direct() {
            return self.read_direct(address, count);
        }
        let map = self.map().ok_or(Refusal::Address)?;
        if count == 0 || count > 125 {
            return Err(Refusal::Value);
        }
        let areas = [
            (status_span(&self.profile, map).0, self.status_area(map)),
            (map.registers.staging, self.staging().to_vec()),
            (map.registers.active, self.active_area()),
        ];
        let found = areas.iter().find_map(|area| inside(area, address, usize::from(count)));
        Ok(to_words(found.ok_or(Refusal::Address)?))
    }

    /// Writes registers: the staging area, or the whole commit word in one request.
    pub fn write(&mut self, address: u16, words: &[u16]) -> Result<(), Refusal> {
        if self.is_direct() {
            return self.write_direct(address, words);
        }
        let (staging, commit) =
            self.map().map(|m| (m.registers.staging, m.registers.commit)).ok_or(Refusal::Address)?;
        if words.is_empty() || words.len() > 123 {
            return Err(Refusal::Value);
        }
        let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_be_bytes()).collect();
        if address >= staging && self.write_staging(2 * usize::from(address - staging), &bytes) {
            return Ok(());
        }
        let (start, end) = (usize::from(address), usize::from(address) + words.len());
        let commit = usize::from(commit);
        if (start, end) == (commit, commit + 4) {
            let id = self.commit_of(words)?;
            self.write_commit(id);
            return Ok(());
        }
        Err(if start < commit + 4 && commit < end { Refusal::Value } else { Refusal::Address })
    }

    /// The commit word that is written.
    pub fn commit_of(&self, words: &[u16]) -> Result<TableId, Refusal> {
        let order = self.profile.table.word_order;
        let long = |words: &[u16]| {
            let ([a, b], [c, d]) = (words[0].to_be_bytes(), words[1].to_be_bytes());
            u32::from_be_bytes(order.arrange([a, b, c, d]))
        };
        if words.len() != 4 {
            return Err(Refusal::Value);
        }
        Ok(TableId { revision: long(words), crc: long(&words[2..]) })
    }

    /// The status, from its first register on; what lies between the values is 0.
    fn status_area(&self, map: &ModbusMap) -> Vec<u8> {
        let (first, count) = status_span(&self.profile, map);
        let mut area = vec![0; 2 * usize::from(count)];
        for field in fields(&self.profile, map) {
            let value = self.value(&field, map);
            area[2 * usize::from(field.address - first)..][..value.len()].copy_from_slice(&value);
        }
        area
    }

    fn value(&self, field: &Field, map: &ModbusMap) -> Vec<u8> {
        let (r, at) = (&map.registers, field.address);
        let order = self.profile.table.word_order;
        let long = |value: u32| order.arrange(value.to_be_bytes()).to_vec();
        let word = |value: u16| value.to_be_bytes().to_vec();
        match at {
            at if at == r.identification => long(self.profile.identification),
            at if at == r.layout => word(self.profile.layout),
            at if at == r.heartbeat => word(self.heartbeat),
            at if at == r.state => word(self.state),
            at if at == r.bend_count => word(self.bend_count),
            at if at == r.program => self.program_bytes(),
            at if at == r.active_revision => long(self.active().revision),
            at if at == r.active_crc => long(self.active().crc),
            at if at == r.ack_revision => long(self.ack_revision),
            at if at == r.ack_code => word(self.ack_code),
            _ => [long(self.commit.revision), long(self.commit.crc)].concat(),
        }
    }

    /// As long as the longest table; what an older, longer one left behind the last row does not show here.
    fn active_area(&self) -> Vec<u8> {
        let mut area = self.active_payload();
        area.resize(self.staging().len() - 8, 0);
        area
    }
}

fn inside((first, bytes): &Area, address: u16, registers: usize) -> Option<&[u8]> {
    let start = 2 * usize::from(address.checked_sub(*first)?);
    bytes.get(start..)?.get(..2 * registers)
}

fn to_words(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::Profile;

    fn machine() -> MachineModel {
        MachineModel::new(Profile::load("reference-modbus").unwrap(), "P1", 2)
    }

    #[test]
    fn only_staging_and_the_whole_commit_word_can_be_written() {
        let mut m = machine();
        assert_eq!(m.write(0, &[1]), Err(Refusal::Address));
        assert_eq!(m.write(2000, &[1]), Err(Refusal::Address));
        assert_eq!(m.write(999, &[1, 1]), Err(Refusal::Address));
        assert_eq!(m.write(1263, &[1]), Ok(()));
        assert_eq!(m.write(1263, &[1, 1]), Err(Refusal::Address));
        assert_eq!(m.write(32, &[1, 1]), Err(Refusal::Value));
        assert_eq!(m.write(1000, &[0; 124]), Err(Refusal::Value));
        assert_eq!(m.read(0, 36).map(|w| w.len()), Ok(36));
        assert_eq!(m.read(0, 37), Err(Refusal::Address));
        assert_eq!(m.read(1000, 126), Err(Refusal::Value));
        assert_eq!(m.read(0xffff, 2), Err(Refusal::Address));
    }
}
