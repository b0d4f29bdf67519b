//! From belief to table: dead band, step limit, total limit, the machine's range.

use super::estimate;
use super::replay::{Model, Used};
use super::shape::{Case, shaped};
use super::verdict::{Code, Reason};
use crate::inspect::{Known, rotation};
use crate::tube::{CommandTable, MachineLimits, Nominal, wrap_angle};

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// A table is not moved for less than this share of a tolerance. The field's quarter, or 1.5 sigma of the scan, keeps who corrects every
/// value by its own error from chasing noise; here the belief has weighed that already, and holding it back cost 1 to 5 points.
const DEAD_BAND: f64 = 0.1;

/// What a correction may do.
#[derive(Debug, Clone, PartialEq)]
pub struct Limits {
    /// Range of the machine.
    pub machine: MachineLimits,
    /// Most that one part may change an angle, or three sigmas of what was expected if that is more.
    pub step_angle_rad: f64,
    /// The same for a feed.
    pub step_length_mm: f64,
    /// The same for a rotation.
    pub step_rotation_rad: f64,
    /// Farthest that an angle may go from the nominal, and over it by what the material usually springs back besides.
    pub total_angle_rad: f64,
    /// The same for a feed.
    pub total_length_mm: f64,
    /// The same for a rotation.
    pub total_rotation_rad: f64,
}

impl Default for Limits {
    /// No machine known: 2 degrees and 5 mm per part, 15 degrees and 20 mm in all, rotations 2 and 5 degrees.
    fn default() -> Limits {
        Limits {
            machine: MachineLimits::unlimited(),
            step_angle_rad: 2.0 * DEGREE,
            step_length_mm: 5.0,
            step_rotation_rad: 2.0 * DEGREE,
            total_angle_rad: 15.0 * DEGREE,
            total_length_mm: 20.0,
            total_rotation_rad: 5.0 * DEGREE,
        }
    }
}

/// One value's change: what stands in the table, what is wanted, and by how much it may move.
struct Change {
    current: f64,
    wanted: f64,
    dead_band: f64,
    step: f64,
}

impl Change {
    /// The new value; None within the dead band.
    fn apply(&self) -> Option<f64> {
        let change = self.wanted - self.current;
        (change.abs() > self.dead_band).then(|| self.current + change.clamp(-self.step, self.step))
    }

    /// Said when the step limit cut the change; `unit` and its size in the value's own.
    fn cut(&self, i: usize, what: &str, unit: &str, size: f64) -> Option<Reason> {
        let change = self.wanted - self.current;
        let text = || {
            format!("{what} {}: change of {:+.2} cut to {:.2} {unit}", i + 1, change / size, self.step / size)
        };
        (change.abs() > self.step).then(|| Reason::at(Code::StepLimit, i, text()))
    }
}

/// The table to bend with before anything was measured.
pub fn first(model: &Model, nominal: &Nominal) -> CommandTable {
    let mut table = CommandTable::from_lra(&nominal.lra);
    for (i, row) in table.bends.iter_mut().enumerate() {
        row.angle_rad = model.springback.command_for(i, row.angle_rad);
        row.rotation_rad = model.rotations.command_for(i, row.rotation_rad);
    }
    let angles: Vec<f64> = table.bends.iter().map(|r| r.angle_rad).collect();
    for (i, row) in table.bends.iter_mut().enumerate() {
        row.length_mm = model.lengths.command_for(i, &angles);
    }
    table
}

/// The next table after `newest`, and what changes and why. The table in force itself when nothing does.
pub fn next(model: &Model, nominal: &Nominal, newest: &Used, limits: &Limits) -> (CommandTable, Vec<Reason>) {
    let begin = |settled| Plan {
        model,
        nominal,
        newest,
        limits,
        settled,
        table: newest.commanded.clone(),
        reasons: Vec::new(),
    };
    // Noise is not chased; but once something has to be moved, the best is made of everything.
    let mut plan = begin(true).planned();
    if plan.table != newest.commanded {
        plan = begin(false).planned();
        plan.table = shaped(&Case { model, nominal, newest: Some(newest), limits }, plan.table);
    }
    let mut reasons = plan.changes();
    reasons.extend(plan.reasons);
    for (i, off_mm) in model.lengths.slips() {
        let text = format!(
            "feed {}: {off_mm:+.2} mm off what was expected: mostly slip of a worn clamp; not chased unless it stays",
            i + 1
        );
        reasons.push(Reason::at(Code::Slip, i, text));
    }
    (plan.table, reasons)
}

/// Most that one part may change an angle.
pub(super) fn angle_step(model: &Model, limits: &Limits, i: usize) -> f64 {
    limits.step_angle_rad.max(3.0 * model.springback.surprise_sigma_rad(i))
}

/// The same for a feed.
pub(super) fn length_step(model: &Model, limits: &Limits, i: usize) -> f64 {
    limits.step_length_mm.max(3.0 * model.lengths.surprise_sigma_mm(i))
}

/// How far an angle may be under and over the nominal. Titanium springs back by what would be a gross error in steel.
pub(super) fn total_angle(nominal: &Nominal, limits: &Limits, i: usize) -> (f64, f64) {
    (limits.total_angle_rad, limits.total_angle_rad + estimate::usual_at(nominal, i))
}

/// A turn that the scan shows well enough to correct it.
pub(super) fn turn_seen(newest: &Used, nominal: &Nominal, i: usize) -> Option<Known> {
    rotation(&newest.measured, i).filter(|r| r.sigma <= nominal.tolerance.rotation_rad / 2.0)
}

struct Plan<'a> {
    model: &'a Model,
    nominal: &'a Nominal,
    newest: &'a Used,
    limits: &'a Limits,
    /// Changes within their dead bands are not made.
    settled: bool,
    table: CommandTable,
    reasons: Vec<Reason>,
}

impl Plan<'_> {
    fn planned(mut self) -> Self {
        let bends = self.nominal.lra.bends.len();
        (0..bends).for_each(|i| self.angle(i));
        (0..bends).for_each(|i| self.rotation(i));
        self.lengths();
        self
    }

    /// What is too small to be changed: noise while all is settled, else what the machine cannot make.
    fn dead_band(&self, tolerance: f64, resolution: f64) -> f64 {
        if self.settled { DEAD_BAND * tolerance } else { 0.5 * resolution }
    }

    fn angle(&mut self, i: usize) {
        let change = Change {
            current: self.table.bends[i].angle_rad,
            wanted: self.model.springback.command_for(i, self.nominal.lra.bends[i].angle_rad),
            dead_band: self
                .dead_band(self.nominal.tolerance.angle_rad, self.limits.machine.angle_resolution_rad),
            step: angle_step(self.model, self.limits, i),
        };
        let Some(value) = change.apply() else { return };
        self.table.bends[i].angle_rad = value;
        self.reasons.extend(change.cut(i, "angle", "degrees", DEGREE));
    }

    fn rotation(&mut self, i: usize) {
        if turn_seen(self.newest, self.nominal, i).is_none() {
            return;
        }
        let wanted = self.nominal.lra.bends[i].rotation_rad;
        let current = self.table.bends[i].rotation_rad;
        let change = Change {
            current,
            wanted: current + wrap_angle(self.model.rotations.command_for(i, wanted) - current),
            dead_band: self
                .dead_band(self.nominal.tolerance.rotation_rad, self.limits.machine.angle_resolution_rad),
            step: self.limits.step_rotation_rad,
        };
        let Some(value) = change.apply() else { return };
        self.table.bends[i].rotation_rad = value;
        self.reasons.extend(change.cut(i, "rotation", "degrees", DEGREE));
    }

    fn lengths(&mut self) {
        let angles: Vec<f64> = self.table.bends.iter().map(|r| r.angle_rad).collect();
        for i in 0..angles.len() {
            let change = Change {
                current: self.table.bends[i].length_mm,
                wanted: self.model.lengths.command_for(i, &angles),
                dead_band: self
                    .dead_band(self.nominal.tolerance.length_mm, self.limits.machine.length_resolution_mm),
                step: length_step(self.model, self.limits, i),
            };
            let Some(value) = change.apply() else { continue };
            let shortest = shortest_feed(&self.limits.machine, i);
            let held = value.max(shortest);
            if value < shortest {
                let text = format!("feed {}: {value:.2} mm wanted, {shortest:.2} is the shortest", i + 1);
                self.reasons.push(Reason::at(Code::Clamped, i, text));
            }
            if held == change.current {
                continue;
            }
            self.table.bends[i].length_mm = held;
            self.reasons.extend(change.cut(i, "feed", "mm", 1.0));
        }
    }

    /// What changes in the end.
    fn changes(&self) -> Vec<Reason> {
        let deg = f64::to_degrees;
        let both = || self.table.bends.iter().zip(&self.newest.commanded.bends).enumerate();
        let wanted = &self.nominal.lra.bends;
        let changed = |what, i: usize, found: Option<f64>, wanted: f64, new: f64, old: f64| {
            let found = found.map_or(String::new(), |found| {
                format!("measured {:.2} instead of {:.2} degrees: ", deg(found), deg(wanted))
            });
            format!("{what} {}: {found}command {:.2}, was {:.2}", i + 1, deg(new), deg(old))
        };
        let angles =
            both().filter(|(_, (new, old))| new.angle_rad != old.angle_rad).map(|(i, (new, old))| {
                let found = Some(self.newest.measured.bends[i].angle_rad);
                let text = changed("angle", i, found, wanted[i].angle_rad, new.angle_rad, old.angle_rad);
                Reason::at(Code::Angle, i, text)
            });
        let turns = both().filter(|(_, (new, old))| new.rotation_rad != old.rotation_rad);
        let turns = turns.map(|(i, (new, old))| {
            let wanted = wanted[i].rotation_rad;
            let found = turn_seen(self.newest, self.nominal, i);
            let found = found.map(|found| wanted + wrap_angle(found.value - wanted));
            let text = changed("rotation", i, found, wanted, new.rotation_rad, old.rotation_rad);
            Reason::at(Code::Rotation, i, text)
        });
        let feeds = both().filter(|(_, (new, old))| new.length_mm != old.length_mm).map(|(i, (new, old))| {
            let text = format!("feed {}: {:.2} mm, was {:.2}", i + 1, new.length_mm, old.length_mm);
            Reason::at(Code::Length, i, text)
        });
        angles.chain(turns).chain(feeds).collect()
    }
}

pub(super) fn shortest_feed(machine: &MachineLimits, i: usize) -> f64 {
    if i == 0 { machine.min_first_length_mm } else { machine.min_between_mm }
}

/// Feeds that the machine cannot make so short are held at its shortest; for the first piece.
pub fn clamp(table: &mut CommandTable, limits: &Limits) {
    for (i, row) in table.bends.iter_mut().enumerate() {
        row.length_mm = row.length_mm.max(shortest_feed(&limits.machine, i));
    }
}

/// What in a table goes too far from the nominal or leaves the machine's range.
pub fn violations(table: &CommandTable, nominal: &Nominal, limits: &Limits) -> Vec<Reason> {
    let mut out = Vec::new();
    let machine = &limits.machine;
    if table.bends.len() > machine.max_bends {
        let text = format!("{} bends, the machine holds {}", table.bends.len(), machine.max_bends);
        out.push(Reason::new(Code::MachineLimit, text));
    }
    let deg = f64::to_degrees;
    for (i, (row, wanted)) in table.bends.iter().zip(&nominal.lra.bends).enumerate() {
        let turn = wrap_angle(row.rotation_rad - wanted.rotation_rad);
        let (under, over) = total_angle(nominal, limits, i);
        let off = row.angle_rad - wanted.angle_rad;
        let total = [
            ("angle", deg(off), deg(if off < 0.0 { under } else { over }), "degrees"),
            ("rotation", deg(turn), deg(limits.total_rotation_rad), "degrees"),
            ("feed", row.length_mm - wanted.length_mm, limits.total_length_mm, "mm"),
        ];
        for (what, off, most, unit) in total.into_iter().filter(|(_, off, most, _)| off.abs() > *most) {
            let text = format!(
                "{what} {} would go {off:+.2} {unit} from the nominal, allowed is {most:.2}: check die, material, set-up",
                i + 1
            );
            out.push(Reason::at(Code::TotalLimit, i, text));
        }
        let range = [
            ("angle", deg(row.angle_rad), deg(machine.max_angle_rad), "degrees"),
            ("rotation", deg(row.rotation_rad).abs(), deg(machine.max_rotation_rad), "degrees"),
            ("feed", row.length_mm, machine.max_length_mm, "mm"),
        ];
        for (what, value, most, unit) in range.into_iter().filter(|(_, value, most, _)| value > most) {
            let text = format!("{what} {} would be {value:.2} {unit}, the machine goes to {most:.2}", i + 1);
            out.push(Reason::at(Code::MachineLimit, i, text));
        }
    }
    out
}
