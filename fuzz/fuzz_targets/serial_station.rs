//! The simulated bender on a serial line: frames and garbage in whatever pieces. It answers with frames of the contract, carries out
//! only what is one, and each of those.

#![no_main]

use std::sync::LazyLock;

use benderd::bender::{Profile, Staged, TableId, crc_of, decode_status_image, staging_image};
use benderd::sim::bender::MachineModel;
use benderd::sim::serial_station::SerialStation;
use benderd::sim::station::{Controller, Station as _};
use benderd_fuzz::{Frame, Script, sealed};
use libfuzzer_sys::fuzz_target;

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-serial").unwrap());

const UNIT: u8 = 1;

struct Machine {
    station: SerialStation,
    model: MachineModel,
}

impl Machine {
    fn hear(&mut self, piece: &[u8]) -> Vec<Frame> {
        let mut mute = false;
        let mut controller = Controller::new(&mut self.model, None, &mut mute);
        let answers = self.station.hear(piece.to_vec(), &mut controller);
        answers.iter().map(|a| self.answer(a)).collect()
    }

    fn answer(&self, bytes: &[u8]) -> Frame {
        let text = String::from_utf8_lossy(bytes);
        let frame = Frame::parse(bytes).unwrap_or_else(|| panic!("no frame of the contract: {text:?}"));
        assert!(frame.unit == UNIT && matches!(frame.kind, b'A' | b'N'), "{text:?}");
        frame
    }

    /// A whole frame in pieces: what is one and for this machine is answered once, what is none is not carried out.
    fn whole(&mut self, bytes: &[u8], cut: usize) {
        let mut answers = Vec::new();
        for piece in bytes.chunks(cut.max(1)) {
            answers.extend(self.hear(piece));
        }
        let apart = bytes[1..bytes.len() - 2].iter().all(|b| b.is_ascii_graphic() && *b != b':');
        match Frame::parse(bytes) {
            Some(request) if request.unit == UNIT => {
                let [answer] = &answers[..] else { panic!("{request:?}: {answers:?}") };
                assert_eq!(answer.sequence, request.sequence);
            }
            Some(_) => assert_eq!(answers, []),
            None if apart => assert!(answers.iter().all(|a| a.kind == b'N'), "{answers:?}"),
            None => {}
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let model = MachineModel::new(PROFILE.clone(), "P", 1);
    let mut machine = Machine { station: SerialStation::new(UNIT), model };
    while let Some(what) = script.byte() {
        let cut = usize::from(what >> 3);
        match what & 7 {
            0 => drop(machine.hear(script.piece())),
            1 => machine.whole(&sealed(script.piece()), cut),
            2 | 3 => {
                let (sequence, kind) = (script.any(), b"SWRTC"[usize::from(script.any() % 5)]);
                let frame = Frame { unit: UNIT, sequence, kind, payload: script.piece().to_vec() };
                machine.whole(&frame.encode(), cut);
            }
            // A table that may be taken over, staged in pieces, with its commit.
            4 => stage(&mut machine, script.piece()),
            5 => drop(machine.model.tick()),
            _ => {
                let (unit, sequence) = (script.any(), script.any());
                let frame = Frame { unit, sequence, kind: script.any(), payload: script.piece().to_vec() };
                machine.whole(&frame.encode(), cut);
            }
        }
    }
    decode_status_image(&PROFILE, &machine.model.status_image()).unwrap();
});

fn stage(machine: &mut Machine, row: &[u8]) {
    let mut payload = b"P".to_vec();
    payload.resize(32, 0);
    payload.extend([0, 1, 0, 0]);
    payload.extend(row.iter().take(16));
    payload.resize(52, 0);
    let id = TableId { revision: machine.model.active().revision + 1, crc: crc_of(&payload) };
    let image = staging_image(&PROFILE, &Staged { id, payload });
    let write = Frame { unit: UNIT, sequence: 1, kind: b'W', payload: [&[0, 0], &image[..]].concat() };
    machine.whole(&write.encode(), 200);
    let commit = Frame { sequence: 2, kind: b'C', payload: image[..8].to_vec(), ..write };
    machine.whole(&commit.encode(), 200);
}
