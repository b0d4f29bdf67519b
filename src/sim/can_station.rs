//! The simulated bender's side of the table messages on CAN: what it sends each tenth of a second, and how it answers. Pure; written from
//! the contract (protocols/reference-can.md) byte by byte, not by the database that the other side reads: the two check each other.

use super::bender::MachineModel;
use super::station::{Controller, Station};
use crate::bender::TableId;
use crate::bender::can::{Frame, FrameId};

const STATUS_STATE: u16 = 0x310;
const STATUS_ITEM: u16 = 0x311;
const TABLE_ITEM: u16 = 0x320;
const TABLE_ECHO: u16 = 0x321;
const COMMIT: u16 = 0x322;
const COMMIT_ECHO: u16 = 0x323;
const TABLE_ROW: u16 = 0x324;
const TABLE_ROW_ECHO: u16 = 0x325;

/// Program cycles of 10 ms between two sendings of the status.
const STATUS_EVERY: u32 = 10;

/// Results.
const DONE: u8 = 0;
const BUSY: u8 = 1;
const NO_SUCH: u8 = 2;

/// A controller on CAN.
#[derive(Debug, Default)]
pub struct CanStation {
    program_cycles: u32,
    status_cycle: u8,
}

impl CanStation {
    /// One that was just switched on.
    pub fn new() -> CanStation {
        CanStation::default()
    }
}

impl Station for CanStation {
    type Piece = Frame;

    fn hear(&mut self, frame: Frame, controller: &mut Controller<'_>) -> Vec<Frame> {
        if controller.is_deaf() {
            return Vec::new();
        }
        match frame.id {
            FrameId::Standard(TABLE_ITEM) if frame.data.len() >= 8 => item(&frame.data, controller),
            FrameId::Standard(TABLE_ROW) if frame.data.len() >= 16 => row(&frame.data, controller),
            FrameId::Standard(COMMIT) if frame.data.len() >= 8 && !controller.is_busy() => {
                let [revision, crc] = [0, 4].map(|at| low_first(&frame.data[at..]));
                if controller.write_commit(TableId { revision, crc }) {
                    return vec![send(COMMIT_ECHO, &frame.data[..8])];
                }
                Vec::new()
            }
            _ => Vec::new(),
        }
    }

    fn cycle(&mut self, controller: &mut Controller<'_>) -> Vec<Frame> {
        self.program_cycles += 1;
        if self.program_cycles < STATUS_EVERY || controller.is_deaf() {
            return Vec::new();
        }
        self.program_cycles = 0;
        self.status_cycle = self.status_cycle.wrapping_add(1);
        status(self.status_cycle, controller.model)
    }
}

fn send(id: u16, data: &[u8]) -> Frame {
    Frame::new(FrameId::Standard(id), data)
}

fn low_first(bytes: &[u8]) -> u32 {
    u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
}

/// All status messages of one cycle.
fn status(cycle: u8, model: &MachineModel) -> Vec<Frame> {
    let image = model.status_image();
    // The image has its words high byte first, the messages low byte first.
    let word = |at: usize| [image[at + 1], image[at]];
    let state = [&[cycle, image[5]], &word(6)[..], &word(8), &word(10)].concat();
    let item = |item: u8, value: [u8; 4]| send(STATUS_ITEM, &[&[item, cycle, 0, 0], &value[..]].concat());
    let long = |at: usize| [image[at + 3], image[at + 2], image[at + 1], image[at]];
    let acknowledgement = [image[25], image[24], 0, 0];
    let values = [long(0), long(12), long(16), long(20), acknowledgement, long(28), long(32)];
    let programs = image[36..].chunks_exact(4).map(|four| [four[0], four[1], four[2], four[3]]);
    let mut frames = vec![send(STATUS_STATE, &state)];
    frames.extend((0..).zip(values).map(|(number, value)| item(number, value)));
    frames.extend((8..).zip(programs).map(|(number, value)| item(number, value)));
    frames
}

/// Where an item of a row lies behind revision and CRC, and whether its four bytes are text.
fn place(item: u8, row: u8, model: &MachineModel) -> Option<(usize, bool)> {
    let (name, row) = (model.profile.table.program_bytes, usize::from(row));
    let at = match item {
        0 => 0,
        1 => 4,
        2 => 8 + name,
        3 => 8 + name + 4,
        4..=6 => 8 + name + 8 + 12 * row + 4 * usize::from(item - 4),
        7 if row < name / 4 => return Some((8 + 4 * row, true)),
        _ => return None,
    };
    Some((at, false))
}

/// The staging area, or the active table behind its revision and CRC.
fn area(operation: u8, model: &MachineModel) -> Vec<u8> {
    if operation != 2 {
        return model.staging().to_vec();
    }
    let id = model.active();
    if id.revision == 0 {
        return Vec::new();
    }
    [&id.revision.to_be_bytes()[..], &id.crc.to_be_bytes(), &model.active_payload()].concat()
}

/// The four bytes of a message for what lies at a place, and back: numbers turn round, the bend count has only its two.
fn turned(item: u8, is_text: bool, four: [u8; 4]) -> [u8; 4] {
    let [a, b, c, d] = four;
    match item {
        _ if is_text => four,
        2 => [b, a, 0, 0],
        _ => [d, c, b, a],
    }
}

/// Reads or writes items of a row that lie side by side; what came of it, and what lies there afterwards.
fn exchange(
    items: &[u8],
    operation: u8,
    row: u8,
    data: &[u8],
    controller: &mut Controller<'_>,
) -> (u8, Vec<u8>) {
    if controller.is_busy() {
        return (BUSY, data.to_vec());
    }
    let mut values = Vec::new();
    for (item, four) in items.iter().zip(data.chunks_exact(4)) {
        let Some((at, is_text)) = place(*item, row, controller.model) else {
            return (NO_SUCH, data.to_vec());
        };
        if operation == 1 {
            let bytes = turned(*item, is_text, [four[0], four[1], four[2], four[3]]);
            if !controller.model.write_staging(at, &bytes) {
                return (NO_SUCH, data.to_vec());
            }
            values.extend(four);
            continue;
        }
        let area = area(operation, controller.model);
        match area.get(at..at + 4) {
            Some(four) if operation == 0 || operation == 2 => {
                values.extend(turned(*item, is_text, [four[0], four[1], four[2], four[3]]));
            }
            _ => return (NO_SUCH, data.to_vec()),
        }
    }
    (DONE, values)
}

fn item(data: &[u8], controller: &mut Controller<'_>) -> Vec<Frame> {
    let (result, values) = exchange(&data[..1], data[1], data[2], &data[4..8], controller);
    vec![send(TABLE_ECHO, &[&[data[0], data[1], data[2], result], &values[..]].concat())]
}

fn row(data: &[u8], controller: &mut Controller<'_>) -> Vec<Frame> {
    let items: &[u8] = if data[0] == 8 { &[4, 5, 6] } else { &[255] };
    let (result, values) = exchange(items, data[1], data[2], &data[4..16], controller);
    vec![send(TABLE_ROW_ECHO, &[&[data[0], data[1], data[2], result], &values[..]].concat())]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::Profile;
    use crate::sim::faults::Fault;
    use proptest::prelude::*;

    fn model() -> MachineModel {
        MachineModel::new(Profile::load("reference-can").unwrap(), "AB-1", 3)
    }

    fn say(model: &mut MachineModel, fault: Option<Fault>, id: u16, data: &[u8]) -> Vec<String> {
        let mut mute = false;
        let mut controller = Controller::new(model, fault, &mut mute);
        let answers = CanStation::new().hear(send(id, data), &mut controller);
        answers.iter().map(Frame::to_string).collect()
    }

    #[test]
    fn the_status_written_out_by_hand() {
        let mut m = model();
        let (mut station, mut mute) = (CanStation::new(), false);
        let mut sent = Vec::new();
        for _ in 0..10 {
            m.tick();
            sent = station.cycle(&mut Controller::new(&mut m, None, &mut mute));
        }
        let sent: Vec<String> = sent.iter().map(Frame::to_string).collect();
        // Cycle 1, layout 1, heartbeat 10, automatic and between parts, 3 bends; "BEND"; the program's first four characters.
        assert_eq!(sent.len(), 1 + 7 + 8);
        assert_eq!(sent[0], "310#01010A0003000300");
        assert_eq!(sent[1], "311#00010000444E4542");
        assert_eq!(sent[2], "311#0101000000000000");
        assert_eq!(sent[8], "311#0801000041422D31");
        assert_eq!(sent[15], "311#0F01000000000000");
    }

    #[test]
    fn items_written_out_by_hand() {
        let mut m = model();
        // Revision 7; three bends; 120.00 mm and -60.000 degrees in row 1; the program's first four characters.
        assert_eq!(say(&mut m, None, 0x320, &[0, 1, 0, 0, 7, 0, 0, 0]), ["321#0001000007000000"]);
        assert_eq!(m.staging()[..4], [0, 0, 0, 7]);
        say(&mut m, None, 0x320, &[2, 1, 0, 0, 3, 0, 0, 0]);
        assert_eq!(m.staging()[40..44], [0, 3, 0, 0]);
        say(&mut m, None, 0x320, &[4, 1, 1, 0, 0xE0, 0x2E, 0, 0]);
        say(&mut m, None, 0x320, &[5, 1, 1, 0, 0xA0, 0x15, 0xFF, 0xFF]);
        assert_eq!(m.staging()[60..68], [0, 0, 0x2E, 0xE0, 0xFF, 0xFF, 0x15, 0xA0]);
        say(&mut m, None, 0x320, &[7, 1, 0, 0, b'A', b'B', b'-', b'1']);
        assert_eq!(&m.staging()[8..12], b"AB-1");
        assert_eq!(say(&mut m, None, 0x320, &[4, 0, 1, 0, 0, 0, 0, 0]), ["321#04000100E02E0000"]);
        // A whole row of CAN FD, the same place.
        let echo = say(&mut m, None, 0x324, &[8, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(echo, ["325#08000100E02E0000A015FFFF00000000"]);
        // Row 40 is beyond, item 9 does not exist, no table is active, the machine is busy.
        assert_eq!(say(&mut m, None, 0x320, &[4, 1, 40, 0, 0, 0, 0, 0]), ["321#0401280200000000"]);
        assert_eq!(say(&mut m, None, 0x320, &[9, 0, 0, 0, 0, 0, 0, 0]), ["321#0900000200000000"]);
        assert_eq!(say(&mut m, None, 0x320, &[2, 2, 0, 0, 0, 0, 0, 0]), ["321#0202000200000000"]);
        assert_eq!(
            say(&mut m, Some(Fault::Busy), 0x320, &[2, 0, 0, 0, 0, 0, 0, 0]),
            ["321#0200000100000000"]
        );
    }

    #[test]
    fn a_commit_is_echoed_unless_it_is_lost() {
        let commit = [2, 0, 0, 0, 0xDD, 0xCC, 0xBB, 0xAA];
        assert_eq!(say(&mut model(), None, 0x322, &commit), ["323#02000000DDCCBBAA"]);
        assert!(say(&mut model(), Some(Fault::DropAfterApply), 0x322, &commit).is_empty());
        let mut m = model();
        say(&mut m, None, 0x322, &commit);
        assert!(m.tick().is_some_and(|event| format!("{event:?}").contains("revision: 2, crc: 2864434397")));
    }

    proptest! {
        #[test]
        fn no_frame_does_harm(id in 0x31F..0x327_u16, data in proptest::collection::vec(any::<u8>(), 0..20)) {
            let _ = say(&mut model(), None, id, &data);
        }
    }
}
