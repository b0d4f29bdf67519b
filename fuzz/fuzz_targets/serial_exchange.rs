//! The serial table's exchanges against a machine that answers anything, in whatever pieces: every exchange ends, a commit is sent
//! once, and what is read has the length that was asked for.

#![no_main]

use std::sync::LazyLock;

use benderd::bender::{
    Ask, ExchangeAction as Action, ExchangeEvent as Event, Profile, Protocol as _, SerialTable, TableId,
};
use benderd_fuzz::{Frame, Script};
use libfuzzer_sys::fuzz_target;

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-serial").unwrap());

const UNIT: u8 = 1;

fn ask(script: &mut Script) -> Ask {
    match script.any() % 5 {
        0 => Ask::Status,
        1 => Ask::Stage(vec![7; usize::from(script.word() % 600)]),
        2 => Ask::ReadBack { bytes: usize::from(script.word() % 600) },
        3 => Ask::Commit(TableId { revision: script.long(), crc: script.long() }),
        _ => Ask::Recall,
    }
}

/// What comes after the frame that is out; none: nothing.
fn answer(script: &mut Script, out: &Frame, announced: &mut Option<usize>) -> Option<Vec<u8>> {
    let like = |kind, payload: Vec<u8>| Frame { unit: UNIT, sequence: out.sequence, kind, payload };
    let asked = out.payload.get(3).copied().unwrap_or(0);
    Some(match script.byte()? % 8 {
        0 => return None,
        1 => script.piece().to_vec(),
        2 => {
            let payload = script.piece();
            *announced = length(payload);
            like(b'A', payload.to_vec()).encode()
        }
        // As asked.
        3 => {
            let payload = match out.kind {
                b'S' => vec![script.any(); 68],
                b'R' => vec![script.any(); usize::from(asked)],
                b'T' => {
                    let length = script.word() % 700;
                    let offset = u16::from_be_bytes([out.payload[0], out.payload[1]]);
                    let count = length.saturating_sub(offset).min(u16::from(asked));
                    let payload = [&length.to_be_bytes(), &vec![9; usize::from(count)][..]].concat();
                    *announced = Some(usize::from(length));
                    payload
                }
                _ => Vec::new(),
            };
            like(b'A', payload).encode()
        }
        4 => like(b'N', script.piece().to_vec()).encode(),
        5 => Frame { sequence: script.any(), ..like(b'N', vec![script.any()]) }.encode(),
        6 => {
            let (unit, sequence, kind) = (script.any(), script.any(), script.any());
            let frame = Frame { unit, sequence, kind, payload: script.piece().to_vec() };
            if frame == like(b'A', frame.payload.clone()) {
                *announced = length(&frame.payload);
            }
            frame.encode()
        }
        // A right answer, damaged.
        _ => {
            let mut frame = like(b'A', vec![0; usize::from(asked)]).encode();
            let at = usize::from(script.any()) % frame.len();
            frame[at] ^= script.any().max(1);
            frame
        }
    })
}

/// Of the table in force, as an answer to `T` says it.
fn length(payload: &[u8]) -> Option<usize> {
    let (length, _) = payload.split_at_checked(2)?;
    Some(usize::from(u16::from_be_bytes([length[0], length[1]])))
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let ask = ask(&mut script);
    let mut exchange = SerialTable::new(&PROFILE, UNIT, None).begin(&ask);
    let (mut now_ms, mut timeouts, mut sent) = (0, 0, Vec::new());
    let mut announced = None;
    let mut action = exchange.on(Event::Begun, now_ms);
    loop {
        let until = match action {
            Action::Failed(_) => return,
            Action::Done(bytes) => return done(&ask, &bytes, announced),
            Action::Send { pieces, until_ms } => {
                for piece in pieces {
                    sent.push(Frame::parse(&piece).unwrap_or_else(|| panic!("no frame: {piece:02X?}")));
                }
                until_ms
            }
        };
        assert!(until <= now_ms + 500, "waits longer than for one answer");
        assert!(!matches!(ask, Ask::Commit(_)) || sent.len() == 1, "a commit was sent again");
        let out = sent.last().expect("waits for an answer to nothing");
        action = match answer(&mut script, out, &mut announced) {
            Some(bytes) => {
                now_ms = (now_ms + 1).min(until);
                let cut = usize::from(script.any()).max(1);
                let mut action = Action::Send { pieces: Vec::new(), until_ms: until };
                for piece in bytes.chunks(cut) {
                    action = exchange.on(Event::Received(piece.to_vec()), now_ms);
                    if !matches!(&action, Action::Send { pieces, .. } if pieces.is_empty()) {
                        break;
                    }
                }
                action
            }
            None => {
                now_ms = until;
                timeouts += 1;
                assert!(timeouts <= 3 * sent.len(), "it never ends");
                exchange.on(Event::Timeout, now_ms)
            }
        };
    }
});

fn done(ask: &Ask, bytes: &[u8], announced: Option<usize>) {
    match ask {
        Ask::Status => {}
        Ask::Stage(_) | Ask::Commit(_) => assert_eq!(bytes, [0; 0], "the answer to a write is empty"),
        Ask::ReadBack { bytes: asked } => assert_eq!(bytes.len(), *asked),
        Ask::Recall => assert_eq!(Some(bytes.len()), announced, "not the table that the machine has"),
    }
}
