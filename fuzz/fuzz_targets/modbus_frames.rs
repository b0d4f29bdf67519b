//! Modbus at the machine's end, both framings: frames and garbage in whatever pieces. What is heard was sent, exactly so; what is sent
//! whole is heard, however it is cut; every answer is a frame; after the garbage the next request is heard.

#![no_main]

use std::sync::LazyLock;

use benderd::bender::{Profile, decode_status};
use benderd::sim::bender::MachineModel;
use benderd::sim::frames::{Framing, Heard, Listener, Request, crc16};
use benderd::sim::modbus_station::ModbusStation;
use benderd::sim::station::{Controller, Station as _};
use benderd_fuzz::Script;
use libfuzzer_sys::fuzz_target;

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-modbus").unwrap());

/// A body (unit, function, the rest) as a frame.
fn wrapped(framing: Framing, transaction: u16, body: &[u8]) -> Vec<u8> {
    let [high, low] = transaction.to_be_bytes();
    match framing {
        Framing::Rtu => [body, &crc16(body).to_le_bytes()].concat(),
        Framing::Tcp => [&[high, low, 0, 0, 0, body.len() as u8], body].concat(),
    }
}

/// The only body that says this; none for functions whose form nobody knows.
fn body(heard: &Heard) -> Option<Vec<u8>> {
    let mut body = vec![heard.unit];
    match &heard.request {
        Request::Read { address, count } => {
            body.push(3);
            body.extend([address.to_be_bytes(), count.to_be_bytes()].concat());
        }
        Request::ReadCoils { address, count } => {
            body.push(1);
            body.extend([address.to_be_bytes(), count.to_be_bytes()].concat());
        }
        Request::Write { address, words } => {
            body.push(16);
            body.extend([address.to_be_bytes(), (words.len() as u16).to_be_bytes()].concat());
            body.push((2 * words.len()) as u8);
            body.extend(words.iter().flat_map(|word| word.to_be_bytes()));
        }
        Request::Other { .. } => return None,
    }
    Some(body)
}

/// One side of the wire.
struct Machine {
    framing: Framing,
    listener: Listener,
    station: ModbusStation,
    model: MachineModel,
    /// What was sent since the last silence.
    sent: Vec<u8>,
}

impl Machine {
    fn new(framing: Framing) -> Machine {
        let model = MachineModel::new(PROFILE.clone(), "P", 1);
        let (listener, station) = (Listener::new(framing), ModbusStation::new(framing));
        Machine { framing, listener, station, model, sent: Vec::new() }
    }

    fn hear(&mut self, piece: &[u8]) -> Vec<Heard> {
        self.sent.extend(piece);
        let heard = self.listener.take(piece);
        for heard in &heard {
            let Some(body) = body(heard) else { continue };
            let frame = wrapped(self.framing, heard.transaction, &body);
            assert!(self.sent.windows(frame.len()).any(|sent| sent == frame), "nobody sent {heard:?}");
        }
        let mut mute = false;
        let mut controller = Controller::new(&mut self.model, None, &mut mute);
        let answers = self.station.hear(piece.to_vec(), &mut controller);
        assert!(answers.len() <= heard.len());
        for answer in answers {
            match self.framing {
                Framing::Rtu => {
                    assert!((5..=256).contains(&answer.len()), "{answer:02X?}");
                    let (body, crc) = answer.split_at(answer.len() - 2);
                    assert_eq!(crc16(body).to_le_bytes(), crc);
                }
                Framing::Tcp => {
                    assert!((9..=260).contains(&answer.len()), "{answer:02X?}");
                    assert_eq!(answer[2..6], [0, 0, 0, (answer.len() - 6) as u8]);
                }
            }
        }
        heard
    }

    fn silence(&mut self) {
        self.listener.silence();
        self.station.silence();
        if self.framing == Framing::Rtu {
            self.sent.clear(); // over TCP what was begun goes on
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let framing = if script.any() & 1 == 0 { Framing::Rtu } else { Framing::Tcp };
    let mut machine = Machine::new(framing);
    while let Some(what) = script.byte() {
        match what & 3 {
            0 => drop(machine.hear(script.piece())),
            // A frame around any body, cut anywhere; behind silence all of it is heard as when it is not cut.
            1 | 2 => {
                let cut = usize::from(what >> 2).max(1);
                let transaction = script.word();
                let frame = wrapped(framing, transaction, script.piece());
                let quiet = !machine.listener.is_amid();
                let heard: Vec<Heard> = frame.chunks(cut).flat_map(|piece| machine.hear(piece)).collect();
                let whole = Listener::new(framing).take(&frame);
                // Of RTU's only one known request: nobody can tell where an unknown one ends.
                let is_one = |one: &Heard| body(one).is_some_and(|body| wrapped(framing, 0, &body) == frame);
                if quiet && (framing == Framing::Tcp || whole.first().is_some_and(is_one)) {
                    assert_eq!(heard, whole, "in pieces of {cut}");
                }
            }
            _ => {
                machine.silence();
                machine.model.tick();
            }
        }
    }
    machine.silence();
    if framing == Framing::Tcp && machine.listener.is_amid() {
        return; // nobody can tell where the next one begins
    }
    let status = wrapped(framing, 7, &[1, 3, 0, 0, 0, 36]);
    let expected = Request::Read { address: 0, count: 36 };
    assert_eq!(machine.hear(&status).pop().map(|heard| heard.request), Some(expected));
    let words = machine.model.read(0, 36).unwrap();
    let bytes: Vec<u8> = words.into_iter().flat_map(u16::to_be_bytes).collect();
    decode_status(&PROFILE, PROFILE.transport.modbus().unwrap(), &bytes).unwrap();
});
