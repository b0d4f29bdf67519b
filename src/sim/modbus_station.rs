//! The simulated bender as a Modbus unit, over `frames` and `registers`.

use super::bender::MachineModel;
use super::frames::{Answer, Framing, Heard, Listener, Request, encode};
use super::registers::Refusal;
use super::station::{Controller, Station};

/// Modbus exceptions that are no refusal of the machine's own.
const NO_SUCH_FUNCTION: u8 = 1;
const BUSY: u8 = 6;
const NO_SUCH_UNIT: u8 = 11;

/// One unit on one wire.
#[derive(Debug)]
pub struct ModbusStation {
    framing: Framing,
    listener: Listener,
}

impl ModbusStation {
    /// Nothing heard yet.
    pub fn new(framing: Framing) -> ModbusStation {
        ModbusStation { framing, listener: Listener::new(framing) }
    }

    /// None: silence.
    fn answer(&self, heard: &Heard, controller: &mut Controller<'_>) -> Option<Answer> {
        if controller.is_busy() {
            return Some(Answer::Exception(BUSY));
        }
        if heard.unit != controller.model.unit_id() {
            // On a line another unit may be meant; over TCP nobody else could answer.
            return (self.framing == Framing::Tcp).then_some(Answer::Exception(NO_SUCH_UNIT));
        }
        match &heard.request {
            Request::Read { address, count } => {
                Some(controller.model.read(*address, *count).map_or_else(refused, Answer::Words))
            }
            Request::ReadCoils { address, count } => {
                Some(controller.model.read_coils(*address, *count).map_or_else(refused, Answer::Coils))
            }
            Request::Write { address, words } => write(*address, words, controller),
            Request::Other { .. } => Some(Answer::Exception(NO_SUCH_FUNCTION)),
        }
    }
}

fn write(address: u16, words: &[u16], controller: &mut Controller<'_>) -> Option<Answer> {
    if Some(address) == controller.model.commit_address() {
        return match controller.model.commit_of(words) {
            Ok(id) => controller.write_commit(id).then_some(Answer::Written),
            Err(refusal) => Some(refused(refusal)),
        };
    }
    Some(MachineModel::write(controller.model, address, words).map_or_else(refused, |()| Answer::Written))
}

impl Station for ModbusStation {
    type Piece = Vec<u8>;

    fn hear(&mut self, piece: Vec<u8>, controller: &mut Controller<'_>) -> Vec<Vec<u8>> {
        let mut answers = Vec::new();
        for heard in self.listener.take(&piece) {
            if controller.is_deaf() {
                continue;
            }
            let answer = self.answer(&heard, controller);
            answers.extend(answer.map(|answer| encode(self.framing, &heard, &answer)));
        }
        answers
    }

    fn silence(&mut self) {
        self.listener.silence();
    }
}

fn refused(refusal: Refusal) -> Answer {
    Answer::Exception(match refusal {
        Refusal::Address => 2,
        Refusal::Value => 3,
    })
}
