//! A simulated bender: the controller's side of the wire contract, without I/O.
//!
//! What it keeps and one program cycle, [`MachineModel::tick`], as a controller would run it. It is written
//! from the contract (protocols/reference-modbus.md), not from the delivery: the two check each other.
//! `registers` shows it as Modbus registers, `bender_server` puts it on a socket.

use crate::bender::{
    Profile, Staged, TableId, check_limits, crc_of, decode_payload, encode_payload, payload_bytes,
};
use crate::tube::{CommandRow, CommandTable};

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
    /// Something went wrong, as was asked for: when, and what.
    Trouble(String),
}

/// The machine.
#[derive(Debug, Clone)]
pub struct MachineModel {
    pub(super) profile: Profile,
    pub(super) heartbeat: u16,
    pub(super) state: u16,
    pub(super) program: String,
    pub(super) bend_count: u16,
    active: TableId,
    active_payload: Vec<u8>,
    pub(super) ack_revision: u32,
    pub(super) ack_code: u16,
    /// Revision 0: none.
    pub(super) commit: TableId,
    /// Revision, CRC, payload, as long as the longest table.
    staging: Vec<u8>,
    /// Flips a bit of what is written to the staging area.
    pub corrupts_staging: bool,
    /// The controller's program stands still: no heartbeat, no commit dealt with.
    pub frozen: bool,
    /// The payload that the operator enters at the screen; none: one that this machine can make.
    pub at_screen: Option<Vec<u8>>,
}

impl MachineModel {
    /// A machine between parts in automatic mode, with this program loaded and no table.
    pub fn new(profile: Profile, program: &str, bends: u16) -> MachineModel {
        let ready = profile.state_bits.iter().filter(|b| b.must_be).map(|b| 1_u16 << b.bit).sum();
        let staging = vec![0; 8 + payload_bytes(&profile, profile.limits.max_bends)];
        MachineModel {
            profile,
            heartbeat: 0,
            state: ready,
            program: program.to_owned(),
            bend_count: bends,
            active: TableId::default(),
            active_payload: Vec::new(),
            ack_revision: 0,
            ack_code: 0,
            commit: TableId::default(),
            staging,
            corrupts_staging: false,
            frozen: false,
            at_screen: None,
        }
    }

    /// The operator loads a program. The active table stays what it was.
    pub fn load_program(&mut self, program: &str, bends: u16) {
        (self.program, self.bend_count) = (program.to_owned(), bends);
    }

    /// Another program of the same number of bends.
    pub fn rename_program(&mut self, program: &str) {
        program.clone_into(&mut self.program);
    }

    /// The loaded program gets one bend more.
    pub fn add_bend(&mut self) {
        self.bend_count = self.bend_count.wrapping_add(1);
    }

    /// A part starts or ends: the state bit "between parts" (the first bit where the profile has none so named).
    pub fn set_between_parts(&mut self, between: bool) {
        self.set_condition("between parts", between);
    }

    /// Emergency stop: the state bit of this name (the first bit where the profile has none so named).
    pub fn emergency_stop(&mut self) {
        self.set_condition("emergency stop", false);
    }

    /// Whether the condition of a state bit holds from now on.
    fn set_condition(&mut self, name: &str, holds: bool) {
        let bits = &self.profile.state_bits;
        let Some(bit) = bits.iter().find(|b| b.name == name).or(bits.first()) else { return };
        let (mask, on) = (1 << bit.bit, holds == bit.must_be);
        self.state = if on { self.state | mask } else { self.state & !mask };
    }

    /// Power off and on: staging area, commit word and acknowledgement are volatile, the rest is retained.
    pub fn power_cycle(&mut self) {
        self.staging.fill(0);
        self.commit = TableId::default();
        (self.ack_revision, self.ack_code) = (0, 0);
    }

    /// The staging area: revision, CRC, payload.
    pub fn staging(&self) -> &[u8] {
        &self.staging
    }

    /// Writes bytes to the staging area; false where it ends before.
    pub fn write_staging(&mut self, offset: usize, bytes: &[u8]) -> bool {
        let Some(area) = self.staging.get_mut(offset..).and_then(|rest| rest.get_mut(..bytes.len())) else {
            return false;
        };
        area.copy_from_slice(bytes);
        if self.corrupts_staging
            && let Some(byte) = area.last_mut()
        {
            *byte ^= 0x10;
        }
        true
    }

    /// Writes the commit word.
    pub fn write_commit(&mut self, id: TableId) {
        self.commit = id;
    }

    /// One program cycle: beats the heart and deals with a commit.
    pub fn tick(&mut self) -> Option<MachineEvent> {
        if self.frozen {
            return None;
        }
        self.heartbeat = self.heartbeat.wrapping_add(1);
        let id = self.commit;
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
        self.commit = TableId::default();
        Some(event)
    }

    /// The status as one row of bytes, as the contracts without registers write it: high byte first.
    pub fn status_image(&self) -> Vec<u8> {
        let longs = |values: &[u32]| values.iter().flat_map(|v| v.to_be_bytes()).collect::<Vec<u8>>();
        let words = |values: &[u16]| values.iter().flat_map(|v| v.to_be_bytes()).collect::<Vec<u8>>();
        [
            longs(&[self.profile.identification]),
            words(&[self.profile.layout, self.heartbeat, self.state, self.bend_count]),
            longs(&[self.active.revision, self.active.crc, self.ack_revision]),
            words(&[self.ack_code, 0]),
            longs(&[self.commit.revision, self.commit.crc]),
            self.program_bytes(),
        ]
        .concat()
    }

    /// Name of the active table; revision 0 is none.
    pub fn active(&self) -> TableId {
        self.active
    }

    /// The active table as the machine would bend it; none before the first.
    pub fn active_table(&self) -> Option<CommandTable> {
        if self.active.revision == 0 {
            return None;
        }
        decode_payload(&self.profile, &self.active_payload).ok().map(|(_, table)| table)
    }

    /// The active payload, as long as its bend count says.
    pub fn active_payload(&self) -> Vec<u8> {
        self.active_payload.clone()
    }

    /// Whether something was ever written to the staging area (since power on).
    pub fn staging_is_empty(&self) -> bool {
        self.staging.iter().all(|byte| *byte == 0)
    }

    /// Somebody enters a table at the machine's own screen.
    pub fn edit_at_screen(&mut self, payload: Vec<u8>) {
        self.active = TableId { revision: self.active.revision + 1, crc: crc_of(&payload) };
        self.active_payload = payload;
    }

    /// The operator enters a table at the screen.
    pub fn operator_edits(&mut self) {
        let payload = self.at_screen.clone().or_else(|| {
            let bend = CommandRow { length_mm: 100.0, rotation_rad: 0.0, angle_rad: 1.0 };
            let table = CommandTable { bends: vec![bend; self.bend_count.into()], last_length_mm: 100.0 };
            encode_payload(&self.profile, &self.program, &table).ok()
        });
        if let Some(payload) = payload {
            self.edit_at_screen(payload);
        }
    }

    /// The staged table, if it may be taken over; else the code of the refusal.
    fn examine(&self, id: TableId) -> Result<Staged, u16> {
        if self.staged_id() != id {
            return Err(2);
        }
        let payload = self.staged_payload().ok_or(3_u16)?;
        if crc_of(payload) != id.crc {
            return Err(3);
        }
        if self.profile.state_bits.iter().any(|b| (self.state >> b.bit & 1 == 1) != b.must_be) {
            return Err(4);
        }
        let (name, rest) = payload.split_at(self.profile.table.program_bytes);
        if name != self.program_bytes() {
            return Err(5);
        }
        if rest[..2] != self.bend_count.to_be_bytes() {
            return Err(6);
        }
        if id.revision != self.active.revision.wrapping_add(1) {
            return Err(7);
        }
        match decode_payload(&self.profile, payload) {
            Ok((_, table)) if check_limits(&self.profile, &table).is_empty() => {
                Ok(Staged { id, payload: payload.to_vec() })
            }
            _ => Err(8),
        }
    }

    fn take_over(&mut self, staged: &Staged) -> MachineEvent {
        (self.active, self.active_payload) = (staged.id, staged.payload.clone());
        self.acknowledge(staged.id, 1);
        let (program, table) = decode_payload(&self.profile, &staged.payload).unwrap_or_default();
        MachineEvent::TakenOver { id: staged.id, program, bends: table.bends.len() }
    }

    fn acknowledge(&mut self, id: TableId, code: u16) {
        (self.ack_revision, self.ack_code) = (id.revision, code);
    }

    /// The loaded program's name, padded with zero.
    pub(super) fn program_bytes(&self) -> Vec<u8> {
        let mut bytes = self.program.as_bytes().to_vec();
        bytes.resize(self.profile.table.program_bytes, 0);
        bytes
    }

    fn staged_id(&self) -> TableId {
        let order = self.profile.table.word_order;
        let long = |at: usize| {
            let [a, b, c, d] = [0, 1, 2, 3].map(|i| self.staging[at + i]);
            u32::from_be_bytes(order.arrange([a, b, c, d]))
        };
        TableId { revision: long(0), crc: long(4) }
    }

    /// None when the bend count there is beyond the area.
    fn staged_payload(&self) -> Option<&[u8]> {
        let count = 8 + self.profile.table.program_bytes;
        let bends = usize::from(u16::from_be_bytes([self.staging[count], self.staging[count + 1]]));
        self.staging.get(8..8 + payload_bytes(&self.profile, bends))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::staging_image;

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
        assert!(m.write_staging(0, &staging_image(&m.profile, s)));
    }

    fn commit(m: &mut MachineModel, id: TableId) -> MachineEvent {
        m.write_commit(id);
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
        assert_eq!((m.active().revision, m.ack_revision, m.ack_code), (1, 1, 1));
        assert_eq!(m.commit, TableId::default());
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
            assert_eq!(m.ack_code, code);
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
                assert!(m.write_staging(52, &[0, 7]));
            }),
            3
        );
        assert_eq!(
            refused(&|m, s| {
                stage(m, s);
                assert!(m.write_staging(40, &60_000_u16.to_be_bytes())); // bend count beyond the area
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
    fn power_off_forgets_staging_and_commit_and_keeps_the_table() {
        let mut m = machine();
        let s = staged(&m, "P1", 2, 100.0);
        stage(&mut m, &s);
        commit(&mut m, s.id);
        let next = staged(&m, "P1", 2, 200.0);
        stage(&mut m, &next);
        m.write_commit(next.id);
        m.power_cycle();
        assert_eq!(m.tick(), None);
        assert!(m.staging_is_empty());
        assert_eq!((m.active(), m.active_payload()), (s.id, s.payload));
    }
}
