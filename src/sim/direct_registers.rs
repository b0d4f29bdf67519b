//! The simulated bender as a Modbus device whose rows are in force as soon as they are written: columns of 16-bit numbers, coils of
//! state.

use super::bender::MachineModel;
use super::registers::Refusal;
use crate::bender::{DirectMap, Profile};

impl MachineModel {
    fn direct(&self) -> Result<DirectMap, Refusal> {
        self.profile.transport.direct().cloned().ok_or(Refusal::Address)
    }

    /// The state's coils.
    pub fn read_coils(&self, address: u16, count: u16) -> Result<Vec<bool>, Refusal> {
        let map = self.direct()?;
        let first = address.checked_sub(map.state_coils).ok_or(Refusal::Address)?;
        if count == 0 || first + count > map.coils {
            return Err(Refusal::Address);
        }
        Ok((first..first + count).map(|bit| self.state >> bit & 1 == 1).collect())
    }

    /// Registers of one column, or the one that says which machine it is.
    pub(super) fn read_direct(&self, address: u16, count: u16) -> Result<Vec<u16>, Refusal> {
        let map = self.direct()?;
        if (address, count) == (map.identification, 1) {
            return Ok(vec![self.profile.identification as u16]);
        }
        let (column, row) = self.place(&map, address, count)?;
        Ok((row..row + usize::from(count)).map(|row| self.rows()[row][column]).collect())
    }

    /// Writes registers of one column.
    pub(super) fn write_direct(&mut self, address: u16, words: &[u16]) -> Result<(), Refusal> {
        let map = self.direct()?;
        let (column, row) = self.place(&map, address, words.len() as u16)?;
        let mut rows = self.rows();
        for (row, word) in rows[row..].iter_mut().zip(words) {
            row[column] = *word;
        }
        self.set_rows(&rows);
        Ok(())
    }

    fn place(&self, map: &DirectMap, address: u16, count: u16) -> Result<(usize, usize), Refusal> {
        let most = self.profile.limits.max_bends;
        let within = |first: &u16| {
            let row = usize::from(address.checked_sub(*first)?);
            (count > 0 && row + usize::from(count) <= most).then_some(row)
        };
        let found = map.columns.iter().enumerate().find_map(|(column, first)| Some((column, within(first)?)));
        found.ok_or(Refusal::Address)
    }

    /// All rows that the machine has, length, rotation, angle.
    fn rows(&self) -> Vec<[u16; 3]> {
        let payload = self.active_payload();
        let rows = payload.get(self.profile.payload_header_bytes()..).unwrap_or(&[]);
        let row = |bytes: &[u8]| [2, 6, 10].map(|at| u16::from_be_bytes([bytes[at], bytes[at + 1]]));
        let mut rows: Vec<[u16; 3]> = rows.chunks_exact(Profile::ROW_BYTES).map(row).collect();
        rows.resize(self.profile.limits.max_bends, [0; 3]);
        rows
    }

    fn set_rows(&mut self, rows: &[[u16; 3]]) {
        let mut payload = vec![0; self.profile.payload_header_bytes()];
        payload[self.profile.table.program_bytes..][..2].copy_from_slice(&(rows.len() as u16).to_be_bytes());
        for number in rows.iter().flatten() {
            payload.extend(i32::from(*number as i16).to_be_bytes());
        }
        self.edit_at_screen(payload);
    }
}
