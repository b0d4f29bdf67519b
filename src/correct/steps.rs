//! Tables in the machine's whole steps, and tables that differ by them.

use crate::tube::{CommandTable, MachineLimits, WholeSteps};

/// A table with these values.
pub fn with(table: &CommandTable, values: impl Iterator<Item = f64>) -> CommandTable {
    let mut out = table.clone();
    let places = out.bends.iter_mut().flat_map(|r| [&mut r.length_mm, &mut r.rotation_rad, &mut r.angle_rad]);
    places.zip(values).for_each(|(place, value)| *place = value);
    out
}

/// The same with values that differ by rounding alone as the table in force has them.
pub fn taken_from(in_force: &CommandTable, table: &CommandTable) -> CommandTable {
    let values = |t: &CommandTable| -> Vec<f64> {
        t.bends.iter().flat_map(|r| [r.length_mm, r.rotation_rad, r.angle_rad]).collect()
    };
    let pairs = values(table).into_iter().zip(values(in_force));
    with(table, pairs.map(|(new, old)| if (new - old).abs() < 1e-9 { old } else { new }))
}

/// In the machine's whole steps, each value for itself, what is left over of lengths and rotations carried on: as the gate does.
pub fn rounded(table: &CommandTable, machine: &MachineLimits) -> CommandTable {
    let (mut feed, mut turn) = (WholeSteps::default(), WholeSteps::default());
    let next = |value: f64, step: f64, column: &mut WholeSteps| {
        if step > 0.0 { column.next(value / step).0 * step } else { value }
    };
    let mut out = table.clone();
    for row in &mut out.bends {
        row.length_mm = next(row.length_mm, machine.length_resolution_mm, &mut feed);
        row.rotation_rad = next(row.rotation_rad, machine.angle_resolution_rad, &mut turn);
        row.angle_rad = next(row.angle_rad, machine.angle_resolution_rad, &mut WholeSteps::default());
    }
    out
}

/// Whether two tables differ by single steps of the machine only.
pub fn is_other_rounding(a: &CommandTable, b: &CommandTable, machine: &MachineLimits) -> bool {
    a.bends.iter().zip(&b.bends).all(|(a, b)| {
        let near = |a: f64, b: f64, step: f64| (a - b).abs() <= step * (1.0 + 1e-6);
        near(a.length_mm, b.length_mm, machine.length_resolution_mm)
            && near(a.rotation_rad, b.rotation_rad, machine.angle_resolution_rad)
            && near(a.angle_rad, b.angle_rad, machine.angle_resolution_rad)
    })
}
