//! Rows of angle 0 (a straight made of two feeds): taken out before the estimator sees a table, put back after.
//!
//! No scan shows them. Their feed stays as drawn; the bend after them takes the whole correction.

use super::history::History;
use super::verdict::Answer;
use crate::tube::{CommandRow, CommandTable, Nominal};

/// Which rows of the part bend.
pub struct Rows {
    nominal: CommandTable,
    bends: Vec<bool>,
}

impl Rows {
    /// The part's rows.
    pub fn of(nominal: &Nominal) -> Rows {
        let bends = nominal.lra.bends.iter().map(|b| b.angle_rad > 0.0).collect();
        Rows { nominal: CommandTable::from_lra(&nominal.lra), bends }
    }

    /// The part without them.
    pub fn merged(&self, nominal: &Nominal) -> Nominal {
        Nominal { lra: nominal.lra.merged(), ..nominal.clone() }
    }

    /// The history without them; tables with another number of rows stay as they are.
    pub fn merge(&self, history: &History) -> History {
        let mut out = history.clone();
        let fitting = out.parts.iter_mut().filter(|p| p.commanded.bends.len() == self.bends.len());
        fitting.for_each(|p| {
            p.commanded = self.merge_table(&p.commanded);
            let answered = p.answered.take();
            p.answered =
                answered.map(|t| if t.bends.len() == self.bends.len() { self.merge_table(&t) } else { t });
        });
        out
    }

    fn merge_table(&self, table: &CommandTable) -> CommandTable {
        let mut out = CommandTable::default();
        let (mut length_mm, mut rotation_rad) = (0.0, 0.0);
        for (row, bends) in table.bends.iter().zip(&self.bends) {
            length_mm += row.length_mm;
            rotation_rad += row.rotation_rad;
            if *bends {
                out.bends.push(CommandRow { length_mm, rotation_rad, angle_rad: row.angle_rad });
                (length_mm, rotation_rad) = (0.0, 0.0);
            }
        }
        out.last_length_mm = length_mm + table.last_length_mm;
        out
    }

    /// The answer with them: rows, spring-back 0, and reasons that count as the part file does.
    pub fn expand(&self, answer: Answer) -> Answer {
        let bending: Vec<usize> = (0..self.bends.len()).filter(|i| self.bends[*i]).collect();
        if bending.len() == self.bends.len() || answer.commanded.bends.len() != bending.len() {
            return answer;
        }
        let mut table = self.nominal.clone();
        let (mut springback_deg, mut springback_sigma_deg) = (Vec::new(), Vec::new());
        let (mut fed_mm, mut turned_rad, mut k) = (0.0, 0.0, 0);
        for (row, bends) in table.bends.iter_mut().zip(&self.bends) {
            if *bends {
                let bend = &answer.commanded.bends[k];
                row.length_mm = (bend.length_mm - fed_mm).max(0.0);
                row.rotation_rad = bend.rotation_rad - turned_rad;
                row.angle_rad = bend.angle_rad;
                (fed_mm, turned_rad) = (0.0, 0.0);
            } else {
                fed_mm += row.length_mm;
                turned_rad += row.rotation_rad;
            }
            let value = |list: &[f64]| if *bends { list.get(k).copied().unwrap_or(0.0) } else { 0.0 };
            springback_deg.push(value(&answer.springback_deg));
            springback_sigma_deg.push(value(&answer.springback_sigma_deg));
            k += usize::from(*bends);
        }
        table.last_length_mm = answer.commanded.last_length_mm - fed_mm;
        let mut predicted = answer.predicted;
        if let Some(predicted) = &mut predicted {
            let mut of_bends = std::mem::take(&mut predicted.angle_deviation_deg).into_iter();
            let of_row = |bends: &bool| if *bends { of_bends.next().unwrap_or(0.0) } else { 0.0 };
            predicted.angle_deviation_deg = self.bends.iter().map(of_row).collect();
        }
        let mut reasons = answer.reasons;
        for reason in &mut reasons {
            reason.bend = reason.bend.map(|b| bending.get(b - 1).map_or(b, |row| row + 1));
        }
        Answer { commanded: table, springback_deg, springback_sigma_deg, predicted, reasons, ..answer }
    }
}
