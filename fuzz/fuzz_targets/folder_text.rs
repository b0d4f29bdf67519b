//! Texts of the shared folder, of any bytes: what is read is of the contract's version and comes back the same when it is written; an
//! image becomes a table or none; the simulated bender answers every command with a text that can be read.

#![no_main]

use std::fmt::Debug;
use std::sync::LazyLock;

use benderd::bender::folder_text::{Answer, Command, StatusText, TableText, read, table, written};
use benderd::bender::{Letter, Profile, crc_of, decode_status_image};
use benderd::sim::bender::MachineModel;
use benderd::sim::folder_station::FolderStation;
use benderd::sim::station::{Controller, Station as _};
use benderd_fuzz::Script;
use libfuzzer_sys::fuzz_target;
use serde::Serialize;
use serde::de::DeserializeOwned;

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-folder").unwrap());

/// Reads it and writes it again.
fn again<T: Serialize + DeserializeOwned + PartialEq + Debug>(bytes: &[u8]) -> Option<T> {
    let text: T = read(bytes).ok()?;
    let (bytes, crc) = written(&text);
    assert_eq!(crc, crc_of(&bytes));
    assert_eq!(read::<T>(&bytes).as_ref(), Ok(&text));
    Some(text)
}

fn texts(bytes: &[u8]) {
    if let Some(command) = again::<Command>(bytes) {
        assert_eq!(command.version, 1);
    }
    if let Some(answer) = again::<Answer>(bytes) {
        assert_eq!(answer.version, 1);
        let status = answer.status.as_ref();
        if let Some(image) = status.and_then(|status| status.image(PROFILE.table.program_bytes)) {
            let _ = decode_status_image(&PROFILE, &image);
            let back = StatusText::of_image(&image).unwrap();
            assert_eq!((back.state, back.commit_crc), (status.unwrap().state, status.unwrap().commit_crc));
        }
    }
    if let Some(text) = again::<TableText>(bytes) {
        assert_eq!(text.version, 1);
        assert_eq!(table(Some(crc_of(bytes)), Some(bytes)), Ok(text.clone()));
        assert!(table(Some(!crc_of(bytes)), Some(bytes)).is_err());
        if let Some(image) = text.image(&PROFILE) {
            let back = TableText::of_image(&PROFILE, &image).unwrap();
            assert_eq!(
                (back.revision, back.crc, back.last_length),
                (text.revision, text.crc, text.last_length)
            );
            assert_eq!(back.rows, text.rows);
        }
    }
}

fn image(bytes: &[u8]) {
    let Some(text) = TableText::of_image(&PROFILE, bytes) else { return };
    let image = text.image(&PROFILE).unwrap();
    assert!(image.len() <= bytes.len());
    assert_eq!(TableText::of_image(&PROFILE, &image).unwrap(), text);
}

fn commands(script: &mut Script) {
    let station = &mut FolderStation::new(PROFILE.clone());
    let mut model = MachineModel::new(PROFILE.clone(), "P", 1);
    while let Some(what) = script.byte() {
        let text = script.piece();
        let table = (what & 1 != 0).then(|| script.piece().to_vec());
        let mut text = text.to_vec();
        if let Some(table) = &table {
            text.extend(format!("\ntable_crc = {}\n", crc_of(table)).into_bytes());
        }
        let command = read::<Command>(&text);
        let mut mute = false;
        let mut controller = Controller::new(&mut model, None, &mut mute);
        let answers = station.hear(Letter { text, table }, &mut controller);
        assert!(answers.len() <= 1);
        for Letter { text, table: bytes } in answers {
            let answer: Answer = read(&text).unwrap();
            assert_eq!(answer.sequence, command.as_ref().map_or(0, |command| command.sequence));
            assert_eq!(answer.table_crc.is_some(), bytes.is_some());
            if bytes.is_some() {
                table_of(&answer, bytes.as_deref());
            }
        }
        model.tick();
    }
}

fn table_of(answer: &Answer, bytes: Option<&[u8]>) {
    let text = table(answer.table_crc, bytes).unwrap();
    assert!(text.image(&PROFILE).is_some());
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    match script.any() % 3 {
        0 => texts(script.rest()),
        1 => image(script.rest()),
        _ => commands(&mut script),
    }
});
