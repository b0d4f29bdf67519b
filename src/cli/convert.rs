//! `benderd convert`: bending tables between LRA, XYZ and YBC.

use std::path::PathBuf;

use anyhow::Context;

use super::Outcome;
use crate::config::{Table, read_table, write_table};
use crate::tube::{ControlPolygon, Frame, Lra, TubeError, Ybc};

/// Arguments of `benderd convert`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The table to read (CSV; its header tells the form).
    input: PathBuf,
    /// The file to write.
    output: PathBuf,
    /// The form to write.
    #[arg(long, value_enum)]
    to: Form,
}

/// The three forms of one tube.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Form {
    /// Straight length, rotation, bend angle, radius.
    Lra,
    /// Ends and corners; starts at the origin, first straight along +x, first bend towards +y.
    Xyz,
    /// Machine axes: feed, plane, angle, radius.
    Ybc,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let table = read_table(&args.input)?;
    let converted = convert(&table, args.to).with_context(|| args.input.display().to_string())?;
    write_table(&args.output, &converted)?;
    Ok(Outcome::Done)
}

fn convert(table: &Table, to: Form) -> Result<Table, TubeError> {
    let lra = match table {
        Table::Lra(lra) => lra.clone(),
        Table::Xyz(polygon) => polygon.to_lra()?.0,
        Table::Ybc(ybc) => Lra::from(ybc),
    };
    lra.validate()?;
    Ok(match to {
        Form::Lra => Table::Lra(lra),
        Form::Ybc => Table::Ybc(Ybc::from(&lra)),
        Form::Xyz => Table::Xyz(ControlPolygon::from_lra(&in_the_plane(&lra), Frame::identity())?),
    })
}

/// The first bend's plane is the x-y plane, whatever the first row's rotation: XYZ has no place for it.
fn in_the_plane(lra: &Lra) -> Lra {
    let mut turned = lra.clone();
    let first = lra.bends.iter().position(|b| b.angle_rad > 0.0).unwrap_or(0);
    turned.bends.iter_mut().take(first + 1).for_each(|b| b.rotation_rad = 0.0);
    turned
}
