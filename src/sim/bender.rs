//! A simulated bender: the controller's side of the wire contract, without I/O.
//!
//! A register file and one program cycle, [`MachineModel::tick`], as a controller would run it. It is written
//! from the contract (protocols/reference-modbus.md), not from the delivery: the two check each other.
//! `bender_server` puts it on a socket.

use crate::bender::{
    Profile, Staged, TableId, check_limits, commit_image, crc_of, decode_payload, payload_bytes, status_span,
};
use crate::tube::CommandTable;

/// Why a request is refused, as Modbus names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// No such register, or not for writing (exception 2).
    Address,
    /// Not in this way (exception 3).
    Value,
}

/// What happened in a program cycle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MachineEvent {
    /// A staged table became the active one.
    TakenOver {
        /// Which.
        id: TableId,
        /// For which program.
        program: String,
        /// How many bends.
        bends: usize,
    },
    /// A commit was refused.
    Refused {
        /// Which.
        id: TableId,
        /// Code of the wire contract.
        code: u16,
    },
}

/// The machine.
#[derive(Debug, Clone)]
pub struct MachineModel {
    profile: Profile,
    registers: Vec<u16>,
    /// Flips a bit of what is written to the staging area.
    pub corrupts_staging: bool,
    /// The controller's program stands still: no heartbeat, no commit dealt with.
    pub frozen: bool,
}

impl MachineModel {
    /// A machine between parts in automatic mode, with this program loaded and no table.
    pub fn new(profile: Profile, program: &str, bends: u16) -> MachineModel {
        let mut model =
            MachineModel { profile, registers: vec![0; 0x10000], corrupts_staging: false, frozen: false };
        let r = model.profile.registers.clone();
        let identification = model.profile.identification;
        model.put_long(r.identification, identification);
        model.put(r.layout, &[model.profile.layout]);
        let ready = model.profile.state_bits.iter().filter(|b| b.must_be).map(|b| 1_u16 << b.bit).sum();
        model.put(r.state, &[ready]);
        model.load_program(program, bends);
        model
    }

    /// The operator loads a program. The active table stays what it was.
    pub fn load_program(&mut self, program: &str, bends: u16) {
        let registers = usize::from(self.profile.table.program_registers);
        let mut bytes = program.as_bytes().to_vec();
        bytes.resize(2 * registers, 0);
        let words = to_words(&bytes);
        self.put(self.profile.registers.program, &words);
        self.put(self.profile.registers.bend_count, &[bends]);
    }

    /// Another program of the same number of bends.
    pub fn rename_program(&mut self, program: &str) {
        let bends = self.registers[usize::from(self.profile.registers.bend_count)];
        self.load_program(program, bends);
    }

    /// The loaded program gets one bend more.
    pub fn add_bend(&mut self) {
        let count = &mut self.registers[usize::from(self.profile.registers.bend_count)];
        *count = count.wrapping_add(1);
    }

    /// The unit that it answers for.
    pub fn unit_id(&self) -> u8 {
        self.profile.unit_id
    }

    /// Where a commit is written.
    pub fn commit_address(&self) -> u16 {
        self.profile.registers.commit
    }

    /// A part starts or ends: the state bit "between parts" (the first bit where the profile has none so named).
    pub fn set_between_parts(&mut self, between: bool) {
        let bits = &self.profile.state_bits;
        let Some(bit) = bits.iter().find(|b| b.name == "between parts").or(bits.first()) else { return };
        let (mask, on) = (1 << bit.bit, between == bit.must_be);
        let state = &mut self.registers[usize::from(self.profile.registers.state)];
        *state = if on { *state | mask } else { *state & !mask };
    }

    /// Power off and on: staging area, commit word and acknowledgement are volatile, the rest is retained.
    pub fn power_cycle(&mut self) {
        let r = self.profile.registers.clone();
        let staging = vec![0; self.staging_registers()];
        self.put(r.staging, &staging);
        self.put(r.commit, &[0; 4]);
        self.put(r.ack_revision, &[0; 2]);
        self.put(r.ack_code, &[0]);
    }

    /// Reads registers.
    pub fn read(&self, address: u16, count: u16) -> Result<Vec<u16>, Refusal> {
        let start = usize::from(address);
        let end = start + usize::from(count);
        let inside = |area: (usize, usize)| area.0 <= start && end <= area.1;
        if count == 0 || count > 125 {
            return Err(Refusal::Value);
        }
        if ![self.status_area(), self.staging_area(), self.active_area()].into_iter().any(inside) {
            return Err(Refusal::Address);
        }
        Ok(self.registers[start..end].to_vec())
    }

    /// Writes registers: the staging area, or the whole commit word in one request.
    pub fn write(&mut self, address: u16, words: &[u16]) -> Result<(), Refusal> {
        let start = usize::from(address);
        let end = start + words.len();
        let commit = usize::from(self.profile.registers.commit);
        if words.is_empty() || words.len() > 123 {
            return Err(Refusal::Value);
        }
        let staging = self.staging_area();
        if staging.0 <= start && end <= staging.1 {
            self.put(address, words);
            if self.corrupts_staging {
                self.registers[end - 1] ^= 0x0010;
            }
            return Ok(());
        }
        if start < commit + 4 && commit < end {
            if (start, end) != (commit, commit + 4) {
                return Err(Refusal::Value);
            }
            self.put(address, words);
            return Ok(());
        }
        Err(Refusal::Address)
    }

    /// One program cycle: beats the heart and deals with a commit.
    pub fn tick(&mut self) -> Option<MachineEvent> {
        if self.frozen {
            return None;
        }
        let r = self.profile.registers.clone();
        let heart = &mut self.registers[usize::from(r.heartbeat)];
        *heart = heart.wrapping_add(1);
        let id = self.id_at(r.commit);
        if id.revision == 0 {
            return None;
        }
        let event = match self.examine(id) {
            Ok(staged) => self.take_over(&staged),
            Err(code) => {
                self.acknowledge(id, code);
                MachineEvent::Refused { id, code }
            }
        };
        self.put(r.commit, &[0; 4]);
        Some(event)
    }

    /// Name of the active table; revision 0 is none.
    pub fn active(&self) -> TableId {
        let r = &self.profile.registers;
        TableId { revision: self.long(r.active_revision), crc: self.long(r.active_crc) }
    }

    /// The active table as the machine would bend it; none before the first.
    pub fn active_table(&self) -> Option<CommandTable> {
        if self.active().revision == 0 {
            return None;
        }
        decode_payload(&self.profile, &self.active_payload()).ok().map(|(_, table)| table)
    }

    /// The active payload, as long as its bend count says.
    pub fn active_payload(&self) -> Vec<u8> {
        self.payload_at(self.profile.registers.active).unwrap_or_default()
    }

    /// Whether something was ever written to the staging area (since power on).
    pub fn staging_is_empty(&self) -> bool {
        let (start, end) = self.staging_area();
        self.registers[start..end].iter().all(|word| *word == 0)
    }

    /// Somebody enters a table at the machine's own screen.
    pub fn edit_at_screen(&mut self, payload: Vec<u8>) {
        let id = TableId { revision: self.active().revision + 1, crc: crc_of(&payload) };
        self.set_active(&Staged { id, payload });
    }

    /// The staged table, if it may be taken over; else the code of the refusal.
    fn examine(&self, id: TableId) -> Result<Staged, u16> {
        let r = &self.profile.registers;
        if self.id_at(r.staging) != id {
            return Err(2);
        }
        let payload = self.payload_at(r.staging + 4).ok_or(3_u16)?;
        if crc_of(&payload) != id.crc {
            return Err(3);
        }
        let state = self.registers[usize::from(r.state)];
        if self.profile.state_bits.iter().any(|b| (state >> b.bit & 1 == 1) != b.must_be) {
            return Err(4);
        }
        let name = 2 * usize::from(self.profile.table.program_registers);
        let loaded = to_bytes(&self.registers[usize::from(r.program)..][..name / 2]);
        if payload[..name] != loaded {
            return Err(5);
        }
        let bend_count = self.registers[usize::from(r.bend_count)];
        if payload[name..name + 2] != bend_count.to_be_bytes() {
            return Err(6);
        }
        if id.revision != self.active().revision.wrapping_add(1) {
            return Err(7);
        }
        match decode_payload(&self.profile, &payload) {
            Ok((_, table)) if check_limits(&self.profile, &table).is_empty() => Ok(Staged { id, payload }),
            _ => Err(8),
        }
    }

    fn take_over(&mut self, staged: &Staged) -> MachineEvent {
        self.set_active(staged);
        self.acknowledge(staged.id, 1);
        let (program, table) = decode_payload(&self.profile, &staged.payload).unwrap_or_default();
        MachineEvent::TakenOver { id: staged.id, program, bends: table.bends.len() }
    }

    fn set_active(&mut self, staged: &Staged) {
        let r = self.profile.registers.clone();
        self.put(r.active, &to_words(&staged.payload));
        self.put_long(r.active_revision, staged.id.revision);
        self.put_long(r.active_crc, staged.id.crc);
    }

    fn acknowledge(&mut self, id: TableId, code: u16) {
        let r = self.profile.registers.clone();
        self.put_long(r.ack_revision, id.revision);
        self.put(r.ack_code, &[code]);
    }

    /// None when the bend count there is beyond the area.
    fn payload_at(&self, address: u16) -> Option<Vec<u8>> {
        let start = usize::from(address);
        let count = self.registers[start + usize::from(self.profile.table.program_registers)];
        let bends = Some(usize::from(count)).filter(|n| *n <= self.profile.limits.max_bends)?;
        Some(to_bytes(&self.registers[start..start + payload_bytes(&self.profile, bends) / 2]))
    }

    fn status_area(&self) -> (usize, usize) {
        let (first, count) = status_span(&self.profile);
        (usize::from(first), usize::from(first) + usize::from(count))
    }

    fn staging_registers(&self) -> usize {
        4 + payload_bytes(&self.profile, self.profile.limits.max_bends) / 2
    }

    fn staging_area(&self) -> (usize, usize) {
        let start = usize::from(self.profile.registers.staging);
        (start, start + self.staging_registers())
    }

    fn active_area(&self) -> (usize, usize) {
        let start = usize::from(self.profile.registers.active);
        (start, start + self.staging_registers() - 4)
    }

    fn put(&mut self, address: u16, words: &[u16]) {
        let start = usize::from(address);
        self.registers[start..start + words.len()].copy_from_slice(words);
    }

    fn put_long(&mut self, address: u16, value: u32) {
        // The first half of a commit image is the revision: a u32 in the machine's word order.
        let image = commit_image(&self.profile, TableId { revision: value, crc: 0 });
        self.put(address, &to_words(&image[..4]));
    }

    fn long(&self, address: u16) -> u32 {
        let at = usize::from(address);
        let [a, b] = self.registers[at].to_be_bytes();
        let [c, d] = self.registers[at + 1].to_be_bytes();
        u32::from_be_bytes(self.profile.modbus.word_order.arrange([a, b, c, d]))
    }

    fn id_at(&self, address: u16) -> TableId {
        TableId { revision: self.long(address), crc: self.long(address + 2) }
    }
}

fn to_words(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

fn to_bytes(words: &[u16]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_be_bytes()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::{encode_payload, staging_image};
    use crate::tube::CommandRow;

    fn machine() -> MachineModel {
        MachineModel::new(Profile::load("reference-modbus").unwrap(), "P1", 2)
    }

    fn staged(m: &MachineModel, program: &str, bends: usize, length_mm: f64) -> Staged {
        let row = CommandRow { length_mm, rotation_rad: 0.0, angle_rad: 1.0 };
        let table = CommandTable { bends: vec![row; bends], last_length_mm: 5.0 };
        let payload = encode_payload(&m.profile, program, &table).unwrap();
        Staged { id: TableId { revision: m.active().revision + 1, crc: crc_of(&payload) }, payload }
    }

    fn stage(m: &mut MachineModel, s: &Staged) {
        m.write(1000, &to_words(&staging_image(&m.profile, s))).unwrap();
    }

    fn commit(m: &mut MachineModel, id: TableId) -> MachineEvent {
        m.write(32, &to_words(&commit_image(&m.profile, id))).unwrap();
        m.tick().unwrap()
    }

    #[test]
    fn a_committed_table_becomes_active_and_the_commit_word_is_cleared() {
        let mut m = machine();
        assert_eq!(m.active_table(), None);
        let s = staged(&m, "P1", 2, 100.0);
        stage(&mut m, &s);
        assert_eq!(m.tick(), None, "staging alone does nothing");
        assert_eq!(
            commit(&mut m, s.id),
            MachineEvent::TakenOver { id: s.id, program: "P1".into(), bends: 2 }
        );
        assert_eq!(m.active_table().unwrap().bends[1].length_mm, 100.0);
        assert_eq!(m.read(24, 11).unwrap()[..2], [0, 1]);
        assert_eq!(m.read(28, 8).unwrap(), [0, 1, 1, 0, 0, 0, 0, 0], "acknowledged, commit word cleared");
    }

    #[test]
    fn each_refusal_has_its_code_and_leaves_the_active_table_alone() {
        let refused = |change: &dyn Fn(&mut MachineModel, &mut Staged)| {
            let mut m = machine();
            let mut s = staged(&m, "P1", 2, 100.0);
            change(&mut m, &mut s);
            let before = (m.active(), m.active_payload());
            let MachineEvent::Refused { code, .. } = commit(&mut m, s.id) else { panic!("was taken over") };
            assert_eq!((m.active(), m.active_payload()), before);
            assert_eq!(m.read(30, 1).unwrap(), [code]);
            code
        };
        assert_eq!(refused(&|_, _| ()), 2, "nothing staged");
        assert_eq!(
            refused(&|m, s| {
                stage(m, s);
                s.id.crc ^= 1;
            }),
            2
        );
        assert_eq!(
            refused(&|m, s| {
                stage(m, s);
                m.write(1026, &[7]).unwrap();
            }),
            3
        );
        assert_eq!(
            refused(&|m, s| {
                stage(m, s);
                m.write(1020, &[60_000]).unwrap(); // bend count beyond the area
            }),
            3
        );
        assert_eq!(
            refused(&|m, s| {
                stage(m, s);
                m.set_between_parts(false);
            }),
            4
        );
        let other = |program: &'static str, bends: usize, length: f64| {
            refused(&move |m: &mut MachineModel, s: &mut Staged| {
                *s = staged(m, program, bends, length);
                stage(m, s);
            })
        };
        assert_eq!(other("P2", 2, 100.0), 5);
        assert_eq!(other("P1", 3, 100.0), 6);
        assert_eq!(other("P1", 2, 1.0), 8);
        assert_eq!(
            refused(&|m, s| {
                s.id.revision = 2;
                stage(m, s);
            }),
            7
        );
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

    #[test]
    fn power_off_forgets_staging_and_commit_and_keeps_the_table() {
        let mut m = machine();
        let s = staged(&m, "P1", 2, 100.0);
        stage(&mut m, &s);
        commit(&mut m, s.id);
        let next = staged(&m, "P1", 2, 200.0);
        stage(&mut m, &next);
        m.write(32, &to_words(&commit_image(&m.profile, next.id))).unwrap();
        m.power_cycle();
        assert_eq!(m.tick(), None);
        assert!(m.staging_is_empty());
        assert_eq!((m.active(), m.active_payload()), (s.id, s.payload));
    }
}
