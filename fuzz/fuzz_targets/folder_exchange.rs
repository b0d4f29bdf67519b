//! The shared folder's exchanges against a machine that answers anything: every exchange ends, a command goes out once, and what is
//! read has the length that was asked for.

#![no_main]

use std::sync::LazyLock;

use benderd::bender::folder_text::{Answer, Command, Said, StatusText, TableText, read, written};
use benderd::bender::{
    Ask, ExchangeAction as Action, ExchangeEvent as Event, Letter, Profile, Protocol as _, SharedFolder,
    TableId, decode_payload, payload_bytes, status_bytes,
};
use benderd_fuzz::Script;
use libfuzzer_sys::fuzz_target;

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-folder").unwrap());

fn ask(script: &mut Script) -> Ask {
    match script.any() % 5 {
        0 => Ask::Status,
        1 => Ask::Stage(script.piece().to_vec()),
        2 => Ask::ReadBack { bytes: usize::from(script.word() % 600) },
        3 => Ask::Commit(TableId { revision: script.long(), crc: script.long() }),
        _ => Ask::Recall,
    }
}

/// A name of a few characters, or of bytes that are none.
fn name(script: &mut Script) -> String {
    String::from_utf8_lossy(script.piece()).into_owned()
}

fn table(script: &mut Script) -> TableText {
    let rows = usize::from(script.any() % 50);
    TableText {
        version: 1,
        revision: script.long(),
        crc: script.long(),
        program: name(script),
        last_length: script.long() as i32,
        rows: vec![[script.long() as i32, -7, i32::MIN]; rows],
    }
}

fn status(script: &mut Script) -> StatusText {
    StatusText {
        identification: script.long(),
        layout: script.word(),
        heartbeat: 0,
        state: 3,
        program: name(script),
        bends: script.word(),
        active_revision: script.long(),
        active_crc: 0,
        acknowledged_revision: 0,
        acknowledgement: script.word(),
        commit_revision: 0,
        commit_crc: 0,
    }
}

/// What comes after the command; none: nothing.
fn answer(script: &mut Script, sequence: u32) -> Option<Letter> {
    let what = script.byte()?;
    if what & 0x80 == 0 {
        let (text, table) = (script.piece().to_vec(), script.piece().to_vec());
        return Some(Letter { text, table: (what & 1 == 0).then_some(table) });
    }
    let said = [
        Said::Done,
        Said::Done,
        Said::Done,
        Said::Busy,
        Said::Garbled,
        Said::Refused,
        Said::Done,
        Said::Done,
    ];
    let sequence = if what & 0x40 == 0 { sequence } else { script.long() };
    let mut answer = Answer::new(sequence, said[usize::from(what & 7)]);
    if what & 8 != 0 {
        answer.status = Some(status(script));
    }
    let table = (what & 16 != 0).then(|| written(&table(script)));
    answer.table_crc = table.as_ref().map(|(_, crc)| crc ^ u32::from(what & 32));
    Some(Letter { text: written(&answer).0, table: table.map(|(bytes, _)| bytes) })
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let ask = ask(&mut script);
    let mut exchange = SharedFolder::new(&PROFILE, 1).begin(&ask);
    let Action::Send { pieces, until_ms } = exchange.on(Event::Begun, 0) else { panic!("nothing is sent") };
    let [letter] = &pieces[..] else { panic!("not one letter: {pieces:?}") };
    let command: Command = read(&letter.text).unwrap();
    assert_eq!(command.table_crc.is_some(), letter.table.is_some());
    loop {
        let event = answer(&mut script, command.sequence).map_or(Event::Timeout, Event::Received);
        let ends = event == Event::Timeout;
        match exchange.on(event, if ends { until_ms } else { 1 }) {
            Action::Done(bytes) => return done(&ask, &bytes),
            Action::Failed(_) => return,
            Action::Send { pieces, until_ms: then } => {
                assert!(!ends && pieces.is_empty() && then == until_ms, "it goes on");
            }
        }
    }
});

fn done(ask: &Ask, bytes: &[u8]) {
    match ask {
        Ask::Status => assert_eq!(bytes.len(), status_bytes(&PROFILE)),
        Ask::Stage(_) | Ask::Commit(_) => assert_eq!(bytes, [0; 0], "the answer to a write is empty"),
        Ask::ReadBack { bytes: asked } => assert_eq!(bytes.len(), *asked),
        Ask::Recall => {
            let (_, table) = decode_payload(&PROFILE, bytes).unwrap();
            assert_eq!(bytes.len(), payload_bytes(&PROFILE, table.bends.len()));
        }
    }
}
