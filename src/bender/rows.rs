//! A table's rows in the machine's whole steps, and back: one row after the other, or counted from the first on.
//!
//! What a row's rounding leaves over goes into the next one's, for lengths and rotations: else forty rows would be up to twenty
//! steps off at the end. An angle stands for itself: what one bend lacks is not made up for by another.

use super::profile::{Sequence, TableFormat};
use crate::tube::{CommandRow, CommandTable, WholeSteps};

/// One row: what the machine moves by, and the numbers that it takes (the same, or positions).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Steps {
    /// Steps of length, rotation (right-handed), angle.
    pub moves: [f64; 3],
    /// Numbers of length, rotation (in the machine's sense), angle.
    pub numbers: [f64; 3],
}

/// Rows in whole steps; a value that is no number gives one that is none.
pub fn steps_of(format: &TableFormat, table: &CommandTable) -> Vec<Steps> {
    let sign = if format.rotation_reversed { -1.0 } else { 1.0 };
    let mut feed = Column::new(format.feed);
    let mut turn = Column::new(format.rotation);
    let row = |row: &CommandRow| {
        let (length, length_number) = feed.next(row.length_mm / format.length_resolution_mm);
        let rotation = row.rotation_rad.to_degrees() / format.angle_resolution_deg;
        let (rotation, rotation_number) = turn.next(rotation);
        let angle = (row.angle_rad.to_degrees() / format.angle_resolution_deg).round();
        Steps { moves: [length, rotation, angle], numbers: [length_number, sign * rotation_number, angle] }
    };
    table.bends.iter().map(row).collect()
}

/// Rows of the machine's numbers.
pub fn rows_of(format: &TableFormat, numbers: &[[i32; 3]]) -> Vec<CommandRow> {
    let sign = if format.rotation_reversed { -1.0 } else { 1.0 };
    let (mut feed, mut turn) = (0.0, 0.0);
    let row = |[length, rotation, angle]: &[i32; 3]| {
        let moved = |number: f64, before: &mut f64, sequence| match sequence {
            Sequence::Incremental => number,
            Sequence::Cumulative => number - std::mem::replace(before, number),
        };
        let length = moved(f64::from(*length), &mut feed, format.feed);
        let rotation = moved(f64::from(*rotation), &mut turn, format.rotation);
        CommandRow {
            length_mm: length * format.length_resolution_mm,
            rotation_rad: (sign * rotation * format.angle_resolution_deg).to_radians(),
            angle_rad: (f64::from(*angle) * format.angle_resolution_deg).to_radians(),
        }
    };
    numbers.iter().map(row).collect()
}

/// One column, from the first row on.
struct Column {
    sequence: Sequence,
    steps: WholeSteps,
}

impl Column {
    fn new(sequence: Sequence) -> Column {
        Column { sequence, steps: WholeSteps::default() }
    }

    /// What it moves by, and the number that says so.
    fn next(&mut self, steps: f64) -> (f64, f64) {
        let (moved, position) = self.steps.next(steps);
        (moved, if self.sequence == Sequence::Cumulative { position } else { moved })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bender::Profile;
    use proptest::prelude::*;

    fn table(rows: &[(f64, f64, f64)]) -> CommandTable {
        let row = |(l, r, a): &(f64, f64, f64)| CommandRow {
            length_mm: *l,
            rotation_rad: r.to_radians(),
            angle_rad: a.to_radians(),
        };
        CommandTable { bends: rows.iter().map(row).collect(), last_length_mm: 0.0 }
    }

    fn whole(feed: Sequence, rotation: Sequence) -> TableFormat {
        let format = Profile::load("reference-modbus").unwrap().table;
        TableFormat { length_resolution_mm: 1.0, angle_resolution_deg: 1.0, feed, rotation, ..format }
    }

    fn numbers(format: &TableFormat, table: &CommandTable) -> Vec<[i32; 3]> {
        steps_of(format, table).iter().map(|s| s.numbers.map(|n| n as i32)).collect()
    }

    #[test]
    fn a_machine_of_whole_millimetres_and_degrees_loses_nothing_along_the_table() {
        let table = table(&[(50.4, 0.0, 90.4), (50.4, 20.4, 30.6), (50.4, 20.4, 45.0), (50.4, 20.4, 45.0)]);
        let rows = numbers(&whole(Sequence::Incremental, Sequence::Incremental), &table);
        assert_eq!(rows, [[50, 0, 90], [51, 20, 31], [50, 21, 45], [51, 20, 45]]);
        let rows = numbers(&whole(Sequence::Cumulative, Sequence::Cumulative), &table);
        assert_eq!(rows, [[50, 0, 90], [101, 20, 31], [151, 41, 45], [202, 61, 45]]);
    }

    proptest! {
        #[test]
        fn no_row_is_more_than_half_a_step_from_where_it_should_be(
            rows in prop::collection::vec((0.0..600.0, -360.0..360.0, 0.0..190.0), 1..40),
            feed in prop::sample::select(vec![Sequence::Incremental, Sequence::Cumulative]),
            rotation in prop::sample::select(vec![Sequence::Incremental, Sequence::Cumulative]),
            reversed: bool,
        ) {
            let table = table(&rows);
            let format = TableFormat { rotation_reversed: reversed, ..whole(feed, rotation) };
            let back = rows_of(&format, &numbers(&format, &table));
            let (mut feed, mut turn) = (0.0, 0.0);
            for (wanted, got) in table.bends.iter().zip(&back) {
                feed += wanted.length_mm - got.length_mm;
                turn += (wanted.rotation_rad - got.rotation_rad).to_degrees();
                prop_assert!(feed.abs() <= 0.5 + 1e-9 && turn.abs() <= 0.5 + 1e-9, "{feed} {turn}");
                prop_assert!((wanted.angle_rad - got.angle_rad).to_degrees().abs() <= 0.5 + 1e-9);
            }
            // What the machine holds is written back as it is.
            let again = CommandTable { bends: back, last_length_mm: 0.0 };
            prop_assert_eq!(numbers(&format, &again), numbers(&format, &table));
        }

        #[test]
        fn a_whole_number_of_steps_stays_that_number_after_whatever_rows(
            rows in prop::collection::vec((0.0..600.0, -360.0..360.0), 0..40), length in 0..6000_i32, turn in -360..=360_i32,
        ) {
            let mut rows: Vec<(f64, f64, f64)> = rows.iter().map(|(l, r)| (*l, *r, 1.0)).collect();
            rows.push((f64::from(length), f64::from(turn), 1.0));
            let steps = steps_of(&whole(Sequence::Incremental, Sequence::Incremental), &table(&rows));
            // Unless what came before lies within the numbers' own error of half a step.
            let near = |x: f64| ((x + 0.5).fract().abs() - 0.5).abs() > 0.5 - 1e-6;
            let before: (f64, f64) = rows[..rows.len() - 1].iter().fold((0.0, 0.0), |s, r| (s.0 + r.0, s.1 + r.1));
            prop_assume!(!near(before.0) && !near(before.1));
            prop_assert_eq!(steps.last().unwrap().moves[..2].to_vec(), vec![f64::from(length), f64::from(turn)]);
        }
    }
}
