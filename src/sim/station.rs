//! The machine's side of a protocol: pieces in, pieces out, over what the controller keeps. Pure; `serve` puts it on a port.

use super::bender::MachineModel;
use super::faults::Fault;
use crate::bender::TableId;

/// The machine's side of one protocol.
pub trait Station: Send {
    /// What comes over the port in one piece.
    type Piece: Send;

    /// Takes a piece; what it sends in answer.
    fn hear(&mut self, piece: Self::Piece, controller: &mut Controller<'_>) -> Vec<Self::Piece>;

    /// What it sends by itself in a program cycle.
    fn cycle(&mut self, _controller: &mut Controller<'_>) -> Vec<Self::Piece> {
        Vec::new()
    }

    /// Nothing came for longer than the gap in a frame.
    fn silence(&mut self) {}
}

/// What a station reaches of the machine, with the fault that was asked for.
pub struct Controller<'a> {
    /// The machine.
    pub model: &'a mut MachineModel,
    /// A way to misbehave.
    pub fault: Option<Fault>,
    /// Answers nothing any more.
    pub mute: &'a mut bool,
    /// Has no time, this once.
    pub busy: bool,
    /// A commit was written.
    pub committed: bool,
    /// The connection is to be cut.
    pub hangs_up: bool,
}

impl<'a> Controller<'a> {
    /// Of a machine that has not been told to do anything yet.
    pub fn new(model: &'a mut MachineModel, fault: Option<Fault>, mute: &'a mut bool) -> Controller<'a> {
        Controller { model, fault, mute, hangs_up: false, busy: false, committed: false }
    }

    /// Whether it has no time.
    pub fn is_busy(&self) -> bool {
        self.busy || self.fault == Some(Fault::Busy)
    }

    /// Whether it hears nothing.
    pub fn is_deaf(&self) -> bool {
        *self.mute || self.fault == Some(Fault::Silent)
    }

    /// Writes the commit word; whether that is answered.
    pub fn write_commit(&mut self, id: TableId) -> bool {
        self.hangs_up = matches!(self.fault, Some(Fault::DropBeforeApply | Fault::DropAfterApply));
        if self.fault == Some(Fault::SilentAfterCommit) {
            *self.mute = true;
        }
        if self.fault != Some(Fault::DropBeforeApply) {
            self.model.write_commit(id);
            self.committed = true;
        }
        !self.hangs_up && !*self.mute
    }
}
