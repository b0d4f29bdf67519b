//! A cell as benderd.toml describes it, with everything it names loaded and checked against each other.

use std::time::Duration;

use thiserror::Error;

use super::chain::Chain;
use super::driver::{Craft, Identity};
use super::event::Dwell;
use super::places;
use crate::arm::FolderSettings;
use crate::bender::{Job, Operation, Profile, prepare};
use crate::cloud::Unit;
use crate::config::{CellConfig, ConfigError, DaemonConfig, Materials, ScanUnit, load_part};
use crate::correct::Verdict;

/// Why a cell cannot be set up.
#[derive(Debug, Error)]
pub enum SetupError {
    /// One of its files.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Its part cannot be bent on its machine.
    #[error("cell {cell}: part {part:?} cannot be made on {profile}: {why}")]
    Unfit {
        /// The cell.
        cell: String,
        /// The part.
        part: String,
        /// The machine's profile.
        profile: String,
        /// Every reason.
        why: String,
    },
    /// Its machine's link leads to no address of this form.
    #[error("cell {cell} address = {address:?}, allowed for profile {profile} is {allowed}")]
    Address {
        /// The cell.
        cell: String,
        /// What was found.
        address: String,
        /// The machine's profile.
        profile: String,
        /// The form.
        allowed: &'static str,
    },
    /// It would be in the way of another cell or of the journal.
    #[error(
        "cell {cell} {key} = {found}, allowed is one of its own, neither around nor within another; {clash}"
    )]
    Shared {
        /// The cell.
        cell: String,
        /// Name of the key.
        key: &'static str,
        /// Its value, folders with links followed.
        found: String,
        /// With whose.
        clash: String,
    },
    /// A folder that the daemon needs is not one or cannot be written.
    #[error("{what} = {folder}: {existing} is no folder that this user may write to: {cause}")]
    Folder {
        /// The key.
        what: String,
        /// Path as configured.
        folder: String,
        /// What exists of it.
        existing: String,
        /// What the system said.
        cause: std::io::Error,
    },
}

/// Everything that a cell's driver is made from.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Who it is.
    pub identity: Identity,
    /// Its machine.
    pub profile: Profile,
    /// Where that is, `host:port`.
    pub address: String,
    /// Its scans.
    pub folder: FolderSettings,
    /// How it measures and decides.
    pub chain: Chain,
    /// What a person should know although it works.
    pub warnings: Vec<String>,
}

impl Setup {
    /// Loads all cells, and sees that none is in the way of another and that their folders can be used.
    pub fn load_all(config: &DaemonConfig) -> Result<Vec<Setup>, SetupError> {
        let materials = Materials::load(config.materials.as_deref())?;
        let setups =
            config.cells.iter().map(|c| Setup::load(c, &materials)).collect::<Result<Vec<_>, _>>()?;
        let machines: Vec<_> = setups.iter().map(|setup| &setup.profile.transport).collect();
        places::check(config, &machines)?;
        Ok(setups)
    }

    /// Loads what the cell names, and sees whether its machine can hold the part's first table. Connects to
    /// nothing.
    fn load(config: &CellConfig, materials: &Materials) -> Result<Setup, SetupError> {
        let nominal = load_part(&config.part, materials)?;
        let profile = Profile::load(&config.profile)?;
        if !profile.transport.takes(&config.address) {
            return Err(SetupError::Address {
                cell: config.name.clone(),
                address: config.address.clone(),
                profile: profile.name,
                allowed: profile.transport.form(),
            });
        }
        let unit = match config.scan_unit {
            ScanUnit::M => Unit::Metre,
            ScanUnit::Mm => Unit::Millimetre,
            ScanUnit::Inch => Unit::Inch,
        };
        let settle_time = Duration::from_millis(config.settle_ms);
        let setup = Setup {
            identity: Identity {
                name: config.name.clone(),
                program: nominal.name.clone(),
                mode: config.mode,
                dwell: Dwell::default(),
            },
            address: config.address.clone(),
            folder: FolderSettings { settle_time, ..FolderSettings::new(&config.scan_folder) },
            warnings: warnings(&nominal.tolerance, &profile),
            chain: Chain::new(&config.name, nominal, unit, profile.limits.clone()),
            profile,
        };
        setup.check_first_piece()?;
        Ok(setup)
    }

    fn check_first_piece(&self) -> Result<(), SetupError> {
        let first = self.chain.decide(&[]).answer;
        let why = if first.verdict == Verdict::FirstPiece {
            let job = Job {
                program: self.identity.program.clone(),
                table: first.commanded,
                expected_active: None,
                operation: Operation::New,
                approved: true, // of a machine that is not asked
            };
            match prepare(&self.profile, &job) {
                Ok(_) => return Ok(()),
                Err(reasons) => reasons.into_iter().map(|r| r.text).collect::<Vec<_>>(),
            }
        } else {
            first.reasons.into_iter().map(|r| r.text).collect()
        };
        Err(SetupError::Unfit {
            cell: self.identity.name.clone(),
            part: self.identity.program.clone(),
            profile: self.profile.name.clone(),
            why: why.join("; "),
        })
    }
}

fn warnings(tolerance: &crate::tube::Tolerance, profile: &Profile) -> Vec<String> {
    let mut out = Vec::new();
    let (step, allowed) =
        (profile.limits.angle_resolution_rad.to_degrees(), tolerance.angle_rad.to_degrees());
    if step > allowed / 2.0 {
        out.push(format!(
            "the machine's steps of {step} degrees are too coarse for a tolerance of {allowed} degrees: expect parts \
             that no table can bring into tolerance"
        ));
    }
    let (step, allowed) = (profile.limits.length_resolution_mm, tolerance.length_mm);
    if step > allowed / 2.0 {
        out.push(format!("the machine's steps of {step} mm are too coarse for a tolerance of {allowed} mm"));
    }
    out
}
