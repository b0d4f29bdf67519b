//! The simulated shop around a cell: a bender on a real socket, the tube in it, a scan arm that writes files, and
//! the operator's hands between them.

use std::path::{Path, PathBuf};

use tokio::net::TcpListener;

use super::TrialError;
use super::record::PartRecord;
use crate::bender::Profile;
use crate::cloud::write_ply;
use crate::sim::bender::MachineModel;
use crate::sim::bender_server::SimulatedBender;
use crate::sim::door::Door;
use crate::sim::forming::{FormedTube, Plant};
use crate::sim::frames::Framing;
use crate::sim::scan::{ScanSettings, TubeShape, scan};
use crate::tube::{CommandTable, Nominal};

/// What a shop that knows its tubes reckons with when it cuts them: arcs come out this much longer.
const USUAL_ELONGATION: f64 = 0.012;

/// Bender, material, arm and operator for one part.
pub struct Shop {
    bender: SimulatedBender,
    plant: Plant,
    nominal: Nominal,
    scan_folder: PathBuf,
    cut_length_mm: f64,
    /// Differs from scan to scan, so that no two are alike.
    scan_seed: u64,
    scans: usize,
}

impl Shop {
    /// Sets up a bender with the part's program loaded. Must be called inside a tokio runtime.
    pub async fn open(
        nominal: &Nominal,
        profile: Profile,
        scan_folder: &Path,
        seed: u64,
    ) -> Result<Shop, TrialError> {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await?;
        let bends = u16::try_from(nominal.lra.bends.len()).unwrap_or(u16::MAX);
        let model = MachineModel::new(profile, &nominal.name, bends);
        let arcs_mm: f64 = nominal.lra.bends.iter().map(|b| b.radius_mm * b.angle_rad).sum();
        let straights_mm = nominal.lra.developed_length_mm() - arcs_mm;
        Ok(Shop {
            bender: SimulatedBender::start(Door::Socket(Framing::Tcp, listener), model, None, |_| {})?,
            plant: Plant::new(nominal, seed),
            nominal: nominal.clone(),
            scan_folder: scan_folder.to_owned(),
            cut_length_mm: straights_mm + arcs_mm / (1.0 + USUAL_ELONGATION),
            scan_seed: seed.wrapping_mul(1_000_003),
            scans: 0,
        })
    }

    /// Where the bender listens.
    pub fn address(&self) -> String {
        self.bender.address().to_string()
    }

    /// The bender bends a tube with the table that it holds; None while it holds none.
    pub fn bend(&mut self) -> Option<FormedTube> {
        let table = self.bender.with(|machine| {
            machine.set_between_parts(false);
            machine.active_table()
        });
        let tube = table.map(|table| self.plant.bend(&table, self.cut_length_mm));
        self.bender.with(|machine| machine.set_between_parts(true));
        tube
    }

    /// The arm scans a tube and puts the file into the cell's folder by renaming, as good scan programs do.
    pub async fn scan(&mut self, tube: &FormedTube) -> Result<(), TrialError> {
        self.scans += 1;
        self.scan_seed = self.scan_seed.wrapping_add(1);
        let shape = TubeShape {
            ovality: tube.ovality.clone(),
            ..TubeShape::round(tube.lra.clone(), self.nominal.od_mm)
        };
        let (seed, folder) = (self.scan_seed, self.scan_folder.clone());
        let name = format!("scan-{:02}.ply", self.scans);
        let write = move || -> Result<(), TrialError> {
            let cloud = scan(&shape, &ScanSettings::default(), seed).cloud();
            let unfinished = folder.join(format!(".{name}"));
            write_ply(&unfinished, &cloud)?;
            Ok(std::fs::rename(unfinished, folder.join(name))?)
        };
        match tokio::task::spawn_blocking(write).await {
            Ok(result) => result,
            Err(join) => std::panic::resume_unwind(join.into_panic()),
        }
    }

    /// By how much the next tube would be cut too long (negative: too short); None when it is not worth the trouble.
    /// The tail takes up what the cut is off, and what the next table feeds and bends more or less than this one.
    pub fn too_long_mm(&self, part: &PartRecord) -> Option<f64> {
        let used_mm = |table: &CommandTable| -> f64 {
            let radii = self.nominal.lra.bends.iter().map(|b| b.radius_mm);
            table.bends.iter().zip(radii).map(|(row, radius)| row.length_mm + radius * row.angle_rad).sum()
        };
        let more_mm = part.next.as_ref().map_or(0.0, |next| used_mm(next) - used_mm(&part.commanded));
        let off_mm = part.inspection.last_length_mm.as_ref()?.deviation? - more_mm;
        (off_mm.abs() > self.nominal.tolerance.length_mm / 2.0).then_some(off_mm)
    }

    /// The next tube is cut this much longer (shorter when negative).
    pub fn cut_longer(&mut self, by_mm: f64) {
        self.cut_length_mm += by_mm;
    }
}
