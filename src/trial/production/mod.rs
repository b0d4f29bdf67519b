//! Production on simulated benders: how soon tubes are in tolerance, beside what could be known at best and what is done by hand.
//!
//! ```text
//! lines        what is asked, one line of the report each
//! job          tube after tube: bent, scanned, corrected
//! controllers  benderd; by hand; the oracle, which knows the plant's laws
//! scanner      a scan without a cloud          truth   what a tube really is
//! parts        parts at random              mixups  what goes wrong around a bender
//! campaign     many jobs of one part, for `benderd simulate production`
//! stand        one job as a history, for benches and examples
//! ```

pub mod campaign;
pub mod controllers;
pub mod job;
pub mod lines;
pub mod mixups;
mod oracle;
pub mod parts;
pub mod scanner;
pub mod stand;
pub mod truth;
