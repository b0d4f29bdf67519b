//! Recall before correct: a correction applies to the table that the machine holds. When that is not what was committed last,
//! somebody changed it at the machine: what differs is said, and nothing is sent.

use super::limits::Reason;
use super::link::ActiveTable;
use super::profile::Profile;
use super::rows::steps_of;
use super::wire::{decode_payload, encode_payload};
use crate::tube::CommandTable;

/// What a delivery does to the table in force.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Operation {
    /// Makes the rows, whatever the machine holds.
    #[default]
    New,
    /// Changes values of the rows; never adds or removes any.
    Correct {
        /// The table that was committed last, which the machine must still hold, row for row.
        last: CommandTable,
    },
}

/// Why a correction does not apply to what the machine holds; empty when it does.
pub fn objections(
    profile: &Profile,
    program: &str,
    last: &CommandTable,
    new: &CommandTable,
    active: &ActiveTable,
) -> Vec<Reason> {
    let reason = |text: String| vec![Reason::new("table_changed", None, text)];
    if active.status.active.revision == 0 {
        return reason("the machine holds no table that could be corrected; deliver a new one".into());
    }
    let (held_program, held) = match decode_payload(profile, &active.payload) {
        Ok(held) => held,
        Err(why) => return reason(format!("the machine's table cannot be read: {why}")),
    };
    let (mut reasons, direct) = (Vec::new(), profile.transport.direct().is_some());
    if encode_payload(profile, program, last).is_ok_and(|committed| committed != active.payload) {
        if !direct && held_program != program.trim_end_matches(' ') {
            let text = format!(
                "the machine's table is for program {held_program:?}, committed was one for {program:?}"
            );
            reasons.extend(reason(text));
        }
        reasons.extend(differences(profile, last, &held));
    }
    if held.bends.len() != new.bends.len() {
        let (held, new) = (held.bends.len(), new.bends.len());
        let text =
            format!("a correction neither adds nor removes bends: it has {new}, the machine's table {held}");
        reasons.push(Reason::new("row_count", None, text));
    }
    reasons
}

/// Each value that is not what was committed.
fn differences(profile: &Profile, last: &CommandTable, held: &CommandTable) -> Vec<Reason> {
    let table = &profile.table;
    let mut reasons = Vec::new();
    if last.bends.len() != held.bends.len() {
        let (last, held) = (last.bends.len(), held.bends.len());
        let text = format!("{last} bends were committed, the machine's table has {held}");
        reasons.push(Reason::new("table_changed", None, text));
    }
    let units = [
        ("mm", table.length_resolution_mm),
        ("deg", table.angle_resolution_deg),
        ("deg", table.angle_resolution_deg),
    ];
    let mut compare = |bend, name: &str, (unit, step): (&str, f64), committed: f64, found: f64| {
        if committed != found {
            let (committed, found) = (committed * step, found * step);
            let text = format!("{name} {committed:.3} {unit} was committed, the machine holds {found:.3}");
            reasons.push(Reason::new("table_changed", bend, text));
        }
    };
    let rows = steps_of(table, last).into_iter().zip(steps_of(table, held));
    for (i, (committed, found)) in rows.enumerate() {
        for column in 0..3 {
            let (name, moves) = (&table.columns[column], (committed.moves[column], found.moves[column]));
            compare(Some(i + 1), name, units[column], moves.0, moves.1);
        }
    }
    let tail = |t: &CommandTable| (t.last_length_mm / table.length_resolution_mm).round();
    if profile.transport.direct().is_none() {
        compare(None, "last length", units[0], tail(last), tail(held));
    }
    reasons
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::{Ack, Status, TableId, crc_of};
    use crate::tube::CommandRow;

    fn table(rows: &[(f64, f64, f64)], last: f64) -> CommandTable {
        let row = |(l, r, a): &(f64, f64, f64)| CommandRow {
            length_mm: *l,
            rotation_rad: r.to_radians(),
            angle_rad: a.to_radians(),
        };
        CommandTable { bends: rows.iter().map(row).collect(), last_length_mm: last }
    }

    fn held(program: &str, table: &CommandTable) -> ActiveTable {
        let payload = encode_payload(&profile(), program, table).unwrap();
        let status = Status {
            heartbeat: 1,
            state: 3,
            program: "P1".into(),
            bend_count: 2,
            active: TableId { revision: 7, crc: crc_of(&payload) },
            ack_revision: 7,
            ack: Ack::Taken,
            pending: TableId::default(),
        };
        ActiveTable { status, payload }
    }

    fn profile() -> Profile {
        Profile::load("reference-modbus").unwrap()
    }

    fn texts(last: &CommandTable, new: &CommandTable, active: &ActiveTable) -> Vec<String> {
        objections(&profile(), "P1", last, new, active).iter().map(Reason::to_string).collect()
    }

    #[test]
    fn what_was_committed_may_be_corrected_and_what_differs_is_named() {
        let last = table(&[(100.0, 0.0, 92.1), (50.0, -60.0, 45.0)], 80.0);
        let new = table(&[(100.2, 0.0, 92.9), (50.0, -60.0, 45.1)], 80.0);
        assert!(texts(&last, &new, &held("P1", &last)).is_empty());
        let edited = table(&[(100.0, 0.0, 93.0), (50.0, -60.0, 45.0)], 81.0);
        assert_eq!(
            texts(&last, &new, &held("P1", &edited)),
            [
                "bend 1: angle 92.100 deg was committed, the machine holds 93.000",
                "last length 80.000 mm was committed, the machine holds 81.000"
            ]
        );
        let other = texts(&last, &new, &held("P9", &last));
        assert_eq!(other, ["the machine's table is for program \"P9\", committed was one for \"P1\""]);
        let longer = table(&[(100.0, 0.0, 92.1), (50.0, -60.0, 45.0), (9.0, 1.0, 1.0)], 80.0);
        assert_eq!(
            texts(&last, &new, &held("P1", &longer)),
            [
                "2 bends were committed, the machine's table has 3",
                "a correction neither adds nor removes bends: it has 2, the machine's table 3"
            ]
        );
        assert_eq!(texts(&last, &longer, &held("P1", &last)).len(), 1, "nor may it add one");
        let mut none = held("P1", &last);
        none.status.active = TableId::default();
        assert!(texts(&last, &new, &none)[0].contains("holds no table"));
    }
}
