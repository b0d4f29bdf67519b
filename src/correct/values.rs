//! What each value of a table should be and may be: its best, what limits and machine leave, how far it may go for the others.

use super::plan;
use super::rounding::Choice;
use super::shape::Case;
use crate::tube::{CommandRow, CommandTable, wrap_angle};

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

    /// Its range for the whole tube's sake, in the machine's steps; within its tolerance where there is a step, or wherever a step
    /// is near.
    pub fn choice(&self, within_tolerance: bool) -> Choice {
        let aim = self.aim();
        let around = |room: f64| Choice {
            low: self.low.max(aim - room),
            high: self.high.min(aim + room),
            step: self.step,
        };
        let strict = around(self.tolerance.min(self.room.max(self.step)));
        let any = around(self.room.max(self.step));
        if within_tolerance && strict.has_any() { strict } else { any }
    }
}

impl Case<'_> {
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
            let total = plan::total_angle(nominal, limits, i);
            let range = self.range(i, nominal.lra.bends[i].angle_rad, |row| row.angle_rad, total);
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
            let total = (limits.total_rotation_rad, limits.total_rotation_rad);
            let range = self.range(i, wanted, |row| row.rotation_rad, total);
            let most = machine.max_rotation_rad;
            let range = within(range(limits.step_rotation_rad), (-most, most));
            let seen = i > 0 && self.newest.is_none_or(|n| plan::turn_seen(n, nominal, i).is_some());
            let range = if seen { range } else { (held, held) };
            value(best, range, held, tolerance.rotation_rad, tolerance.rotation_rad, step_rad)
        };
        let angles: Vec<Value> = (0..table.bends.len()).map(angle).collect();
        let aims: Vec<f64> = angles.iter().map(Value::aim).collect();
        let length = |i: usize| {
            let total = (limits.total_length_mm, limits.total_length_mm);
            let range = self.range(i, nominal.lra.bends[i].length_mm, |row| row.length_mm, total);
            let most = (plan::shortest_feed(machine, i), machine.max_length_mm);
            let range = within(range(plan::length_step(model, limits, i)), most);
            let best = model.lengths.command_for(i, &aims);
            let tolerance = tolerance.length_mm;
            value(best, range, table.bends[i].length_mm, tolerance, tolerance, machine.length_resolution_mm)
        };
        (0..table.bends.len()).flat_map(|i| [length(i), rotation(i), angles[i]]).collect()
    }

    /// From the wanted value by no more than `total` (under, over), from the one in force by no more than a step.
    fn range(
        &self,
        i: usize,
        wanted: f64,
        of: fn(&CommandRow) -> f64,
        (under, over): (f64, f64),
    ) -> impl Fn(f64) -> (f64, f64) {
        let current = self.newest.map(|newest| of(&newest.commanded.bends[i]));
        move |step| {
            let total = (wanted - under, wanted + over);
            current.map_or(total, |current| within(total, (current - step, current + step)))
        }
    }
}

fn within(a: (f64, f64), b: (f64, f64)) -> (f64, f64) {
    (a.0.max(b.0), a.1.min(b.1))
}
