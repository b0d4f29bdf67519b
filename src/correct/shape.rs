//! The whole tube: where values cannot be what they should (a limit, a clamp, the machine's steps), the others make up for it.
//!
//! Each value has its best and a range: what the limits leave, and no farther from its best than its own tolerance (half of it
//! for an angle, whose other half is for what scatters). Wanted is the least sum of squares of all that is
//! accepted on: the check points after the part's alignment over the envelope, each value over its own tolerance.
//! Whatever the next tube scatters by in it anyway counts with the tolerance, so that nothing is moved for what nobody will see.

use nalgebra::{DMatrix, DVector};

use super::next_tube::NextTube;
use super::plan::{self, Limits};
use super::replay::{Model, Used};
use super::rounding::{Choice, Quadratic, choose, polish};
use crate::tube::{CommandTable, MachineLimits, Nominal, wrap_angle};

/// What is off by less than this share of its tolerance is not worth another table.
const WORTH: f64 = 0.1;

/// What a shape depends on.
#[derive(Debug, Clone, Copy)]
pub struct Case<'a> {
    /// What is believed.
    pub model: &'a Model,
    /// The part.
    pub nominal: &'a Nominal,
    /// The part that is corrected after; none for the first piece.
    pub newest: Option<&'a Used>,
    /// What a correction may do.
    pub limits: &'a Limits,
}

/// One value of the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Value {
    /// What it should be, in mm or radians.
    pub best: f64,
    /// What it may be.
    pub low: f64,
    /// What it may be.
    pub high: f64,
    /// Its tolerance.
    pub tolerance: f64,
    /// The machine's step.
    step: f64,
    /// How far it may go for the others' sake.
    room: f64,
}

impl Value {
    /// The best that it may be.
    pub fn aim(&self) -> f64 {
        self.best.max(self.low).min(self.high)
    }

    fn choice(&self) -> Choice {
        let (aim, room) = (self.aim(), self.room.max(self.step));
        Choice { low: self.low.max(aim - room), high: self.high.min(aim + room), step: self.step }
    }
}

/// The table that makes the best tube. The planned one itself where all is as good as it can be.
pub fn shaped(case: &Case, planned: CommandTable) -> CommandTable {
    if !plan::violations(&planned, case.nominal, case.limits).is_empty() {
        return planned; // held for a person, who is told the values
    }
    case.best(&planned).unwrap_or(planned)
}

impl Case<'_> {
    /// What the machine makes of each value for itself: the limits' best, rounded along the table as the gate does.
    pub fn each_for_itself(&self, table: &CommandTable) -> CommandTable {
        rounded(&self.aims(table), &self.limits.machine)
    }

    /// Each value the best that limits let it be; what is not to be changed is `table`'s.
    pub fn aims(&self, table: &CommandTable) -> CommandTable {
        with(table, self.values(table).iter().map(Value::aim))
    }

    /// The tube that the machine makes of a table.
    pub fn next_tube(&self, table: &CommandTable) -> Option<NextTube> {
        NextTube::new(self.model, self.nominal, &rounded(table, &self.limits.machine))
    }

    /// The tube of the limits' best values on a machine without steps.
    pub fn next_tube_unrounded(&self, table: &CommandTable) -> Option<NextTube> {
        NextTube::new(self.model, self.nominal, &self.aims(table))
    }

    /// Whether this is the shortest feed that the machine makes before a bend (from 0).
    pub fn is_shortest(&self, bend: usize, length_mm: f64) -> bool {
        length_mm == plan::shortest_feed(&self.limits.machine, bend)
    }

    /// Whether the machine's rounding of each value for itself is worth a thought, or a limit is.
    pub fn matters(&self, each: &NextTube) -> bool {
        each.share(self.nominal) > WORTH
    }

    fn best(&self, planned: &CommandTable) -> Option<CommandTable> {
        let values = self.values(planned);
        let aims = with(planned, values.iter().map(Value::aim));
        let each = rounded(&aims, &self.limits.machine);
        if !self.matters(&self.next_tube(&each)?) {
            return None;
        }
        let (cost, weights) = self.cost(&aims)?;
        let start: Vec<f64> = values.iter().map(Value::aim).collect();
        let choices: Vec<Choice> = values.iter().map(Value::choice).collect();
        let chosen = polish(&cost, &start, &choices, choose(&cost, &start, &choices));
        let mut table = with(planned, chosen.into_iter());
        let costs = |t: &CommandTable| self.next_tube(t).map(|tube| weights.cost(&tube, self.nominal));
        if costs(&each)? < costs(&table)? {
            table = each;
        }
        let Some(newest) = self.newest else { return Some(table) };
        let in_force = &newest.commanded;
        let gain =
            self.next_tube(in_force)?.share(self.nominal) - self.next_tube(&table)?.share(self.nominal);
        if gain < WORTH && self.is_other_rounding(&table, in_force) {
            return Some(in_force.clone());
        }
        Some(taken_from(in_force, &table))
    }

    /// The cost around a table, and how it is counted.
    pub fn cost(&self, aims: &CommandTable) -> Option<(Quadratic, Weights)> {
        let tube = NextTube::new(self.model, self.nominal, aims)?;
        let moves = tube.overlay.moves();
        let sigmas = tube.sigmas(self.model, aims);
        let weights = Weights::new(self, &sigmas, &tube.point_sigmas(&moves, &sigmas));
        let gains = DVector::from_vec(tube.gains(self.model, aims));
        let mut per_value = moves;
        per_value.column_iter_mut().zip(gains.iter()).for_each(|(mut column, gain)| column *= *gain);
        let mut weighted = per_value.clone();
        weighted.row_iter_mut().enumerate().for_each(|(r, mut row)| row *= weights.points[r / 3]);
        let off = DVector::from_iterator(weighted.nrows(), tube.overlay.off_mm.iter().flatten().copied());
        let own = gains.map_with_location(|k, _, gain| gain * weights.own[k]);
        let own_off = DVector::from_vec(tube.own_off(self.nominal));
        Some((
            Quadratic {
                curvature: per_value.tr_mul(&weighted) + DMatrix::from_diagonal(&own.component_mul(&gains)),
                slope: weighted.tr_mul(&off) + own.component_mul(&own_off),
            },
            weights,
        ))
    }

    /// Length, rotation and angle of every bend, as a table has them.
    pub fn values(&self, table: &CommandTable) -> Vec<Value> {
        let Case { model, nominal, limits, .. } = *self;
        let (tolerance, machine) = (&nominal.tolerance, &limits.machine);
        let step_rad = machine.angle_resolution_rad;
        let value = |best, range: (f64, f64), held: f64, tolerance, room, step| {
            // Ranges that exclude each other leave what was planned.
            let (low, high) = if range.0 <= range.1 { range } else { (held, held) };
            Value { best, low, high, tolerance, step, room }
        };
        let angle = |i: usize| {
            let range =
                self.range(i, nominal.lra.bends[i].angle_rad, |row| row.angle_rad, limits.total_angle_rad);
            let range = within(range(plan::angle_step(model, limits, i)), (0.0, machine.max_angle_rad));
            let best = model.springback.command_for(i, nominal.lra.bends[i].angle_rad);
            value(
                best,
                range,
                table.bends[i].angle_rad,
                tolerance.angle_rad,
                0.5 * tolerance.angle_rad,
                step_rad,
            )
        };
        let rotation = |i: usize| {
            let (wanted, held) = (nominal.lra.bends[i].rotation_rad, table.bends[i].rotation_rad);
            let best = model.rotations.command_for(i, wanted);
            let current = self.newest.map_or(best, |newest| newest.commanded.bends[i].rotation_rad);
            let best = current + wrap_angle(best - current);
            let wanted = best + wrap_angle(wanted - best);
            let range = self.range(i, wanted, |row| row.rotation_rad, limits.total_rotation_rad);
            let most = machine.max_rotation_rad;
            let range = within(range(limits.step_rotation_rad), (-most, most));
            let seen = i > 0 && self.newest.is_none_or(|n| plan::turn_seen(n, nominal, i).is_some());
            let range = if seen { range } else { (held, held) };
            value(best, range, held, tolerance.rotation_rad, tolerance.rotation_rad, step_rad)
        };
        let angles: Vec<Value> = (0..table.bends.len()).map(angle).collect();
        let aims: Vec<f64> = angles.iter().map(Value::aim).collect();
        let length = |i: usize| {
            let range =
                self.range(i, nominal.lra.bends[i].length_mm, |row| row.length_mm, limits.total_length_mm);
            let most = (plan::shortest_feed(machine, i), machine.max_length_mm);
            let range = within(range(plan::length_step(model, limits, i)), most);
            let best = model.lengths.command_for(i, &aims);
            let tolerance = tolerance.length_mm;
            value(best, range, table.bends[i].length_mm, tolerance, tolerance, machine.length_resolution_mm)
        };
        (0..table.bends.len()).flat_map(|i| [length(i), rotation(i), angles[i]]).collect()
    }

    /// From the wanted value by no more than `total`, from the one in force by no more than a step.
    fn range(
        &self,
        i: usize,
        wanted: f64,
        of: fn(&crate::tube::CommandRow) -> f64,
        total: f64,
    ) -> impl Fn(f64) -> (f64, f64) {
        let current = self.newest.map(|newest| of(&newest.commanded.bends[i]));
        move |step| {
            let total = (wanted - total, wanted + total);
            current.map_or(total, |current| within(total, (current - step, current + step)))
        }
    }

    /// Whether two tables differ by single steps of the machine only.
    fn is_other_rounding(&self, a: &CommandTable, b: &CommandTable) -> bool {
        let machine = &self.limits.machine;
        a.bends.iter().zip(&b.bends).all(|(a, b)| {
            let near = |a: f64, b: f64, step: f64| (a - b).abs() <= step * (1.0 + 1e-6);
            near(a.length_mm, b.length_mm, machine.length_resolution_mm)
                && near(a.rotation_rad, b.rotation_rad, machine.angle_resolution_rad)
                && near(a.angle_rad, b.angle_rad, machine.angle_resolution_rad)
        })
    }
}

/// How each deviation counts: one over tolerance and scatter squared.
#[derive(Debug, Clone)]
pub struct Weights {
    points: Vec<f64>,
    own: Vec<f64>,
}

impl Weights {
    fn new(case: &Case, sigmas: &[f64], point_sigmas: &[f64]) -> Weights {
        let weight = |tolerance: f64, sigma: f64| (tolerance.powi(2) + sigma.powi(2)).recip();
        let own = sigmas.iter().enumerate().map(|(k, s)| weight(own_tolerance(case, k), *s));
        let points = point_sigmas.iter().map(|s| weight(case.nominal.tolerance.envelope_mm, *s));
        Weights { points: points.collect(), own: own.collect() }
    }

    /// Of a tube: the sum of squares that is to be least.
    pub fn cost(&self, tube: &NextTube, nominal: &Nominal) -> f64 {
        let points = self.points.iter().zip(&tube.overlay.off_mm).map(|(w, off)| w * off.norm_squared());
        let own = self.own.iter().zip(tube.own_off(nominal)).map(|(w, off)| w * off.powi(2));
        points.chain(own).sum()
    }
}

/// Of a value in the order length, rotation, angle; one that the machine's steps cannot keep counts over a step.
fn own_tolerance(case: &Case, value: usize) -> f64 {
    let (t, machine) = (&case.nominal.tolerance, &case.limits.machine);
    let turn = machine.angle_resolution_rad;
    let tolerance = [t.length_mm, t.rotation_rad, t.angle_rad][value % 3];
    tolerance.max([machine.length_resolution_mm, turn, turn][value % 3])
}

fn within(a: (f64, f64), b: (f64, f64)) -> (f64, f64) {
    (a.0.max(b.0), a.1.min(b.1))
}

/// A table with these values.
fn with(table: &CommandTable, values: impl Iterator<Item = f64>) -> CommandTable {
    let mut out = table.clone();
    let places = out.bends.iter_mut().flat_map(|r| [&mut r.length_mm, &mut r.rotation_rad, &mut r.angle_rad]);
    places.zip(values).for_each(|(place, value)| *place = value);
    out
}

/// The same with values that differ by rounding alone as the table in force has them.
fn taken_from(in_force: &CommandTable, table: &CommandTable) -> CommandTable {
    let values = |t: &CommandTable| -> Vec<f64> {
        t.bends.iter().flat_map(|r| [r.length_mm, r.rotation_rad, r.angle_rad]).collect()
    };
    let pairs = values(table).into_iter().zip(values(in_force));
    with(table, pairs.map(|(new, old)| if (new - old).abs() < 1e-9 { old } else { new }))
}

/// In the machine's whole steps, each value for itself, what is left over of lengths and rotations carried on: as the gate does.
fn rounded(table: &CommandTable, machine: &MachineLimits) -> CommandTable {
    let (mut feed, mut turn) = (0.0, 0.0);
    let next = |value: f64, step: f64, left: &mut f64| {
        if step <= 0.0 {
            return value;
        }
        let wanted = value + *left;
        let whole = (wanted / step + 0.5).floor() * step;
        *left = wanted - whole;
        whole
    };
    let mut out = table.clone();
    for row in &mut out.bends {
        row.length_mm = next(row.length_mm, machine.length_resolution_mm, &mut feed);
        row.rotation_rad = next(row.rotation_rad, machine.angle_resolution_rad, &mut turn);
        row.angle_rad = next(row.angle_rad, machine.angle_resolution_rad, &mut 0.0);
    }
    out
}
