//! The shared folder as a protocol: each exchange is one command file and one answer file (protocols/shared-folder.md). Pure but for
//! opening the port and the first number.
//!
//! Over `folder_port` and `folder_text`, under `table_link`.

use std::io;
use std::path::PathBuf;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::caller::millis;
use super::exchange::{Action, Ask, Event, Exchange, Failure, Protocol};
use super::folder_port::{FolderPort, Letter, apart};
use super::folder_text::{Answer, Command, Said, TableText, Verb, read, table, written};
use super::profile::Profile;
use super::recording::Frames;

/// The protocol in one folder.
pub struct SharedFolder {
    profile: Profile,
    number: u16,
    sequence: u32,
    frames: Frames,
}

impl SharedFolder {
    /// With the bender of this number. Numbers of commands begin with the time, so that a daemon that was started again does not
    /// take an answer to the one before for its own.
    pub fn new(profile: &Profile, number: u16) -> SharedFolder {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        SharedFolder {
            profile: profile.clone(),
            number,
            sequence: millis(since) as u32,
            frames: Frames::default(),
        }
    }
}

impl Protocol for SharedFolder {
    type Port = FolderPort;

    fn begin(&mut self, ask: &Ask) -> Box<dyn Exchange<Piece = Letter>> {
        self.sequence = self.sequence.wrapping_add(1).max(1);
        let (verb, wants) = match ask {
            Ask::Status => (Verb::Status, Wants::Status),
            Ask::Stage(_) => (Verb::Stage, Wants::Nothing),
            Ask::ReadBack { bytes } => (Verb::Readback, Wants::Image(*bytes)),
            Ask::Commit(_) => (Verb::Commit, Wants::Nothing),
            Ask::Recall => (Verb::Recall, Wants::Payload),
        };
        let mut command = Command::new(self.sequence, verb);
        let mut letter = Letter::default();
        if let Ask::Commit(id) = ask {
            (command.revision, command.crc) = (Some(id.revision), Some(id.crc));
        }
        if let Ask::Stage(image) = ask
            && let Some(text) = TableText::of_image(&self.profile, image)
        {
            let (bytes, crc) = written(&text);
            (letter.table, command.table_crc) = (Some(bytes), Some(crc));
        }
        letter.text = written(&command).0;
        let answer_ms = millis(self.profile.deadlines.request);
        Box::new(Errand {
            profile: self.profile.clone(),
            sequence: self.sequence,
            letter,
            wants,
            answer_ms,
            until_ms: 0,
            others: 0,
        })
    }

    fn frames(&self) -> &Frames {
        &self.frames
    }

    async fn open(&mut self, endpoint: &str) -> io::Result<FolderPort> {
        let deadlines = &self.profile.deadlines;
        let (look, oldest) = (Duration::from_millis(deadlines.poll_ms), deadlines.transfer);
        let (folder, number) = (PathBuf::from(endpoint), self.number);
        let port = apart(move || FolderPort::of_daemon(&folder, number, look, oldest)).await?;
        Ok(port.recorded(self.frames.clone()).putting_within(deadlines.request))
    }
}

/// What the answer must bring.
#[derive(Debug, Clone, Copy)]
enum Wants {
    Nothing,
    Status,
    /// So many bytes of the staging image.
    Image(usize),
    Payload,
}

/// One command and its answer.
struct Errand {
    profile: Profile,
    sequence: u32,
    letter: Letter,
    wants: Wants,
    answer_ms: u64,
    until_ms: u64,
    /// Answers to other commands than this one.
    others: u32,
}

impl Errand {
    /// None: not the answer to this command.
    fn answer(&self, letter: &Letter) -> Option<Result<Vec<u8>, Failure>> {
        let broken = |why: String| Some(Err(Failure::Broken(why)));
        let answer: Answer = match read(&letter.text) {
            Ok(answer) => answer,
            Err(why) => return broken(format!("the answer file cannot be read: {why}")),
        };
        match answer.result {
            // Such an answer cannot name the command.
            Said::Garbled => return broken("the machine could not read the command".into()),
            _ if answer.sequence != self.sequence => return None,
            Said::Busy => return Some(Err(Failure::Busy)),
            Said::Refused => {
                return Some(Err(Failure::Refused("the table is longer than its staging area".into())));
            }
            Said::Done => {}
        }
        let image = || {
            let text = table(answer.table_crc, letter.table.as_deref())?;
            text.image(&self.profile).ok_or_else(|| "the program's name is too long".to_owned())
        };
        let bytes = match self.wants {
            Wants::Nothing => Ok(Vec::new()),
            Wants::Status => {
                let status = answer.status.as_ref();
                let image = status.and_then(|status| status.image(self.profile.table.program_bytes));
                image.ok_or_else(|| "without a status".to_owned())
            }
            // A file ends with its table's last row; an area goes on, with nothing in it.
            Wants::Image(bytes) => image().map(|mut image| {
                image.resize(bytes, 0);
                image
            }),
            Wants::Payload => image().map(|image| image[8..].to_vec()),
        };
        Some(bytes.map_err(|why| Failure::Broken(format!("the answer came {why}"))))
    }
}

impl Exchange for Errand {
    type Piece = Letter;

    fn on(&mut self, event: Event<Letter>, now_ms: u64) -> Action<Letter> {
        match event {
            Event::Begun => {
                self.until_ms = now_ms + self.answer_ms;
                Action::Send { pieces: vec![std::mem::take(&mut self.letter)], until_ms: self.until_ms }
            }
            Event::Timeout => {
                let mut why = format!("no answer file within {} ms", self.answer_ms);
                if self.others > 0 {
                    why += "; there were answers to other commands: does another program work on this bender's files (a second \
                            benderd?)";
                }
                Action::Failed(Failure::Broken(why))
            }
            Event::Received(letter) => match self.answer(&letter) {
                None => {
                    self.others += 1;
                    Action::Send { pieces: Vec::new(), until_ms: self.until_ms }
                }
                Some(Ok(bytes)) => Action::Done(bytes),
                Some(Err(failure)) => Action::Failed(failure),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_to_somebody_elses_commands_are_told_of_when_the_own_one_does_not_come() {
        let profile = Profile::load("reference-folder").unwrap();
        let mut protocol = SharedFolder::new(&profile, 1);
        let mut exchange = protocol.begin(&Ask::Status);
        exchange.on(Event::Begun, 0);
        let other = Answer::new(protocol.sequence.wrapping_add(7), Said::Done);
        let letter = Letter { text: written(&other).0, table: None };
        let Action::Send { pieces, .. } = exchange.on(Event::Received(letter), 1) else { panic!() };
        assert!(pieces.is_empty());
        let Action::Failed(Failure::Broken(why)) = exchange.on(Event::Timeout, 2000) else { panic!() };
        assert!(why.contains("no answer file") && why.contains("another program"), "{why}");
    }

    #[test]
    fn what_is_behind_a_staged_tables_last_row_reads_as_nothing() {
        let profile = Profile::load("reference-folder").unwrap();
        let staged = TableText {
            version: 1,
            revision: 8,
            crc: 9,
            program: "P".into(),
            last_length: 7,
            rows: vec![[1, 2, 3]],
        };
        let image = staged.image(&profile).unwrap();
        let (table, crc) = written(&staged);
        for asked in [8, 48 + 12, 48 + 24] {
            let mut protocol = SharedFolder::new(&profile, 1);
            let mut exchange = protocol.begin(&Ask::ReadBack { bytes: asked });
            exchange.on(Event::Begun, 0);
            let mut answer = Answer::new(protocol.sequence, Said::Done);
            answer.table_crc = Some(crc);
            let letter = Letter { text: written(&answer).0, table: Some(table.clone()) };
            let Action::Done(bytes) = exchange.on(Event::Received(letter), 1) else { panic!("{asked}") };
            let area = [&image[..], &[0; 12]].concat();
            assert_eq!(bytes, area[..asked]);
        }
    }
}
