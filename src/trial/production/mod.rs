//! Production on simulated benders: how soon tubes are in tolerance, beside what could be known at best and what is done by hand.
//!
//! ```text
//! lines        what is asked, one line of the report each
//! job          tube after tube: bent, scanned, corrected
//! controllers  benderd; by hand; the oracle, which knows the plant's laws
//! scanner      a scan without a cloud          truth   what a tube really is
//! parts        parts at random              mixups  what goes wrong around a bender
//! campaign     many jobs of one part, for `benderd simulate production`
//! ```

pub mod campaign;
pub mod controllers;
pub mod job;
pub mod lines;
pub mod mixups;
mod oracle;
pub mod parts;
pub mod scanner;
pub mod truth;

use rand_chacha::ChaCha8Rng;

use crate::correct::{History, Knowledge, Limits, Part, step};
use crate::sim::forming::Plant;
use crate::tube::Nominal;
use scanner::Scanner;

/// A job as a history, for benches and examples: so many more tubes, each bent with the table of the step before and scanned once.
/// Scans are called after the job's `name`.
pub fn bent(
    name: &str,
    nominal: &Nominal,
    plant: &mut Plant,
    knowledge: &Knowledge,
    mut history: History,
    tubes: usize,
    rng: &mut ChaCha8Rng,
) -> History {
    for _ in 0..tubes {
        let commanded = step(nominal, &history, knowledge, &Limits::default()).commanded;
        let formed = plant.bend(&commanded, nominal.lra.developed_length_mm());
        let measured = Scanner::good().scan(&formed.lra, nominal.od_mm / 2.0, rng);
        let scan_id = Some(format!("{name}, tube {}", history.parts.len() + 1));
        history.parts.push(Part {
            commanded,
            measured,
            revision: None,
            scan_id,
            cut_length_mm: None,
            rescan: false,
        });
    }
    history
}
