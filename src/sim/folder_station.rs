//! The simulated bender at a shared folder, by the contract (protocols/shared-folder.md).

use super::station::{Controller, Station};
use crate::bender::folder_text::{Answer, Command, Said, StatusText, TableText, Verb, read, table, written};
use crate::bender::{Letter, Profile, TableId, payload_bytes};

/// One machine at one folder.
#[derive(Debug)]
pub struct FolderStation {
    profile: Profile,
}

impl FolderStation {
    /// A machine of this profile.
    pub fn new(profile: Profile) -> FolderStation {
        FolderStation { profile }
    }

    /// None: no answer.
    fn carry_out(
        &self,
        letter: &Letter,
        controller: &mut Controller<'_>,
    ) -> Option<(Answer, Option<TableText>)> {
        let plain = |sequence, said| Some((Answer::new(sequence, said), None));
        let Ok(command) = read::<Command>(&letter.text) else { return plain(0, Said::Garbled) };
        let done = Answer::new(command.sequence, Said::Done);
        if controller.is_busy() {
            return plain(command.sequence, Said::Busy);
        }
        match command.command {
            Verb::Status => {
                let status = StatusText::of_image(&controller.model.status_image());
                Some((Answer { status, ..done }, None))
            }
            Verb::Stage => match table(command.table_crc, letter.table.as_deref()) {
                Ok(text) => {
                    let written =
                        text.image(&self.profile).is_some_and(|i| controller.model.write_staging(0, &i));
                    plain(command.sequence, if written { Said::Done } else { Said::Refused })
                }
                Err(_) => plain(command.sequence, Said::Garbled),
            },
            Verb::Readback => {
                let text = TableText::of_image(&self.profile, controller.model.staging());
                match text {
                    Some(text) => Some((done, Some(text))),
                    None => plain(command.sequence, Said::Refused),
                }
            }
            Verb::Commit => {
                let id = TableId { revision: command.revision?, crc: command.crc? };
                controller.write_commit(id).then_some((done, None))
            }
            Verb::Recall => {
                let active = controller.model.active();
                let longs = [active.revision.to_be_bytes(), active.crc.to_be_bytes()].concat();
                let mut image = [longs, controller.model.active_payload()].concat();
                image.resize(image.len().max(8 + payload_bytes(&self.profile, 0)), 0); // no table: no rows
                Some((done, TableText::of_image(&self.profile, &image)))
            }
        }
    }
}

impl Station for FolderStation {
    type Piece = Letter;

    fn hear(&mut self, letter: Letter, controller: &mut Controller<'_>) -> Vec<Letter> {
        if controller.is_deaf() {
            return Vec::new();
        }
        let answer = self.carry_out(&letter, controller).map(|(mut answer, text)| {
            let table = text.map(|text| {
                let (bytes, crc) = written(&text);
                answer.table_crc = Some(crc);
                bytes
            });
            Letter { text: written(&answer).0, table }
        });
        answer.into_iter().collect()
    }
}
