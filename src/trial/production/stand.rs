//! A job bent and scanned without anything that goes wrong, as the history that `correct` reads.

use rand_chacha::ChaCha8Rng;

use super::scanner::Scanner;
use crate::correct::{History, Knowledge, Limits, Part, step};
use crate::sim::forming::Plant;
use crate::tube::Nominal;

/// A bender and a scan arm beside it, for benches and examples.
pub struct Stand {
    /// The bender.
    pub plant: Plant,
    /// Errors of the scans.
    pub rng: ChaCha8Rng,
}

impl Stand {
    /// A job as a history: so many tubes, each bent with the table of the step before and scanned once. Scans are called after the
    /// job's `name`.
    pub fn job(
        &mut self,
        name: &str,
        nominal: &Nominal,
        knowledge: &Knowledge,
        begun: History,
        tubes: usize,
    ) -> History {
        let mut history = begun;
        for _ in 0..tubes {
            let commanded = step(nominal, &history, knowledge, &Limits::default()).commanded;
            let formed = self.plant.bend(&commanded, nominal.lra.developed_length_mm());
            let measured = Scanner::good().scan(&formed.lra, nominal.od_mm / 2.0, &mut self.rng);
            let scan_id = Some(format!("{name}, tube {}", history.parts.len() + 1));
            history.parts.push(Part { scan_id, ..Part::new(commanded, measured) });
        }
        history
    }
}
