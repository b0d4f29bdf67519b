//! Tables as CSV: LRA, XYZ and YBC, told apart by their header. The way in for `push`, both ways for `convert`.
//!
//! Every complaint names file, line and column, what stands there and what is allowed. Degrees in the file,
//! radians in the types; what is written reads back to the same value within 1e-9 of its unit.

use std::fmt::Write as _;
use std::path::Path;

use nalgebra::Point3;

use super::{ConfigError, Document};
use crate::tube::deg::to_degrees_clean;
use crate::tube::{Bend, ControlPolygon, Corner, Lra, Ybc, YbcRow};

const LRA: [&str; 4] = ["length_mm", "rotation_deg", "angle_deg", "radius_mm"];
const XYZ: [&str; 4] = ["x_mm", "y_mm", "z_mm", "radius_mm"];
const YBC: [&str; 4] = ["y_mm", "b_deg", "c_deg", "radius_mm"];

/// No tube has more rows; a file that does is not a bending table.
const MAX_ROWS: usize = 1000;

/// One table in the form in which the file holds it.
#[derive(Debug, Clone, PartialEq)]
pub enum Table {
    /// Header `length_mm,rotation_deg,angle_deg,radius_mm`; the last row is the tail.
    Lra(Lra),
    /// Header `x_mm,y_mm,z_mm,radius_mm`; ends and corners.
    Xyz(ControlPolygon),
    /// Header `y_mm,b_deg,c_deg,radius_mm`; machine axes.
    Ybc(Ybc),
}

/// Reads a CSV table.
pub fn read_table(path: &Path) -> Result<Table, ConfigError> {
    parse_table(&Document::read(path)?)
}

/// Validates a CSV table's text.
pub fn parse_table(doc: &Document) -> Result<Table, ConfigError> {
    let text = doc.text().trim_start_matches('\u{feff}'); // spreadsheets put a byte order mark in front
    let mut lines =
        text.lines().enumerate().map(|(i, line)| (i + 1, line.trim())).filter(|(_, line)| !line.is_empty());
    let (header_line, header) = lines.next().unwrap_or((1, ""));
    let columns = columns_of(doc, header_line, header)?;
    let rows =
        lines.map(|(line, text)| Row::split(doc, line, columns, text)).collect::<Result<Vec<_>, _>>()?;
    if rows.len() > MAX_ROWS {
        return Err(value_error(doc, rows[MAX_ROWS].line, "row", rows.len(), "at most 1000 rows"));
    }
    match columns {
        LRA => Ok(Table::Lra(parse_lra(doc, header_line, &rows)?)),
        XYZ => Ok(Table::Xyz(parse_xyz(doc, header_line, &rows)?)),
        _ => Ok(Table::Ybc(parse_ybc(doc, header_line, &rows)?)),
    }
}

/// Writes a table as CSV, header first.
pub fn write_table(path: &Path, table: &Table) -> Result<(), ConfigError> {
    std::fs::write(path, format_table(table))
        .map_err(|cause| ConfigError::Write { file: path.display().to_string(), cause })
}

/// The CSV text of a table, header first, a line end after every row.
pub fn format_table(table: &Table) -> String {
    let mut out = String::new();
    let mut row = |cells: [String; 4]| {
        let _ = writeln!(out, "{}", cells.join(",")); // writing to a String cannot fail
    };
    match table {
        Table::Lra(lra) => {
            row(LRA.map(str::to_owned));
            for b in &lra.bends {
                row([mm(b.length_mm), degrees(b.rotation_rad), degrees(b.angle_rad), mm(b.radius_mm)]);
            }
            row([mm(lra.last_length_mm), degrees(0.0), degrees(0.0), String::new()]);
        }
        Table::Xyz(polygon) => {
            row(XYZ.map(str::to_owned));
            let last = polygon.corners.len().saturating_sub(1);
            for (i, c) in polygon.corners.iter().enumerate() {
                let radius = if i == 0 || i == last { String::new() } else { mm(c.radius_mm) };
                row([mm(c.point.x), mm(c.point.y), mm(c.point.z), radius]);
            }
        }
        Table::Ybc(ybc) => {
            row(YBC.map(str::to_owned));
            for r in &ybc.rows {
                let radius = if r.c_rad == 0.0 { String::new() } else { mm(r.radius_mm) };
                row([mm(r.y_mm), degrees(r.b_rad), degrees(r.c_rad), radius]);
            }
        }
    }
    out
}

/// One line cut at its commas.
struct Row<'a> {
    line: usize,
    columns: [&'static str; 4],
    cells: [&'a str; 4],
}

impl<'a> Row<'a> {
    fn split(
        doc: &Document,
        line: usize,
        columns: [&'static str; 4],
        text: &'a str,
    ) -> Result<Row<'a>, ConfigError> {
        let cells: Vec<&str> = text.split(',').map(str::trim).collect();
        match <[&str; 4]>::try_from(cells) {
            Ok(cells) => Ok(Row { line, columns, cells }),
            Err(cells) => {
                let allowed = format!("4 ({}), with a point for decimals", columns.join(","));
                Err(value_error(doc, line, "number of columns", cells.len(), &allowed))
            }
        }
    }

    fn number(&self, doc: &Document, column: usize, allowed: &Allowed) -> Result<f64, ConfigError> {
        let cell = self.cells[column];
        // Rounded before it is judged: a table that was read can be written and read again.
        match cell.parse::<f64>().map(rounded) {
            Ok(value) if (allowed.ok)(value) => Ok(value),
            _ => Err(value_error(doc, self.line, self.columns[column], format!("{cell:?}"), allowed.text)),
        }
    }

    /// An empty cell is 0, for a radius that nothing uses.
    fn unused(&self, doc: &Document, column: usize, allowed: &Allowed) -> Result<f64, ConfigError> {
        if self.cells[column].is_empty() { Ok(0.0) } else { self.number(doc, column, allowed) }
    }
}

/// A range and its words.
struct Allowed {
    ok: fn(f64) -> bool,
    text: &'static str,
}

const LENGTH: Allowed = Allowed { ok: |v| (0.0..=100_000.0).contains(&v), text: "a number from 0 to 100000" };
const ROTATION: Allowed = Allowed { ok: |v| v.abs() <= 3600.0, text: "a number from -3600 to 3600" };
const ANGLE: Allowed =
    Allowed { ok: |v| (0.0..360.0).contains(&v), text: "a number from 0 up to, not including, 360" };
const RADIUS: Allowed = Allowed { ok: |v| v > 0.0 && v <= 100_000.0, text: "a number above 0 up to 100000" };
const NO_RADIUS: Allowed =
    Allowed { ok: |v| (0.0..=100_000.0).contains(&v), text: "nothing (no bend here uses it)" };
const POSITION: Allowed = Allowed { ok: |v| v.abs() <= 1e6, text: "a number from -1000000 to 1000000" };
const TAIL: Allowed =
    Allowed { ok: |v| v == 0.0, text: "0: the last row is the straight after the last bend" };

fn columns_of(doc: &Document, line: usize, header: &str) -> Result<[&'static str; 4], ConfigError> {
    let found: Vec<&str> = header.split(',').map(str::trim).collect();
    [LRA, XYZ, YBC].into_iter().find(|c| found == *c).ok_or_else(|| {
        let allowed =
            format!("{} (LRA) or {} (XYZ) or {} (YBC)", LRA.join(","), XYZ.join(","), YBC.join(","));
        let shown: String = header.chars().take(60).collect();
        value_error(doc, line, "header", format!("{shown:?}"), &allowed)
    })
}

fn parse_lra(doc: &Document, header_line: usize, rows: &[Row]) -> Result<Lra, ConfigError> {
    let Some((tail, rows)) = rows.split_last() else {
        return Err(value_error(doc, header_line, "rows", "none", "at least the tail's row"));
    };
    let bends = rows.iter().map(|row| row_of_bend(doc, row)).collect::<Result<_, _>>()?;
    let last_length_mm = tail.number(doc, 0, &LENGTH)?;
    tail.number(doc, 1, &TAIL)?;
    tail.number(doc, 2, &TAIL)?;
    tail.unused(doc, 3, &NO_RADIUS)?;
    Ok(Lra { bends, last_length_mm })
}

fn parse_ybc(doc: &Document, header_line: usize, rows: &[Row]) -> Result<Ybc, ConfigError> {
    if rows.is_empty() {
        return Err(value_error(doc, header_line, "rows", "none", "at least one row"));
    }
    let row = |row| {
        let b = row_of_bend(doc, row)?;
        Ok(YbcRow { y_mm: b.length_mm, b_rad: b.rotation_rad, c_rad: b.angle_rad, radius_mm: b.radius_mm })
    };
    Ok(Ybc { rows: rows.iter().map(row).collect::<Result<_, _>>()? })
}

/// Feed, turn, angle, radius: the same four columns in LRA and YBC. A row of angle 0 needs no radius.
fn row_of_bend(doc: &Document, row: &Row) -> Result<Bend, ConfigError> {
    let length_mm = row.number(doc, 0, &LENGTH)?;
    let rotation_rad = row.number(doc, 1, &ROTATION)?.to_radians();
    let angle_deg = row.number(doc, 2, &ANGLE)?;
    let radius_mm =
        if angle_deg == 0.0 { row.unused(doc, 3, &NO_RADIUS)? } else { row.number(doc, 3, &RADIUS)? };
    Ok(Bend { length_mm, rotation_rad, angle_rad: angle_deg.to_radians(), radius_mm })
}

fn parse_xyz(doc: &Document, header_line: usize, rows: &[Row]) -> Result<ControlPolygon, ConfigError> {
    if rows.len() < 2 {
        return Err(value_error(doc, header_line, "rows", rows.len(), "at least 2 points (the tube's ends)"));
    }
    let corner = |(i, row): (usize, &Row)| {
        let at = |column| row.number(doc, column, &POSITION);
        let end = i == 0 || i == rows.len() - 1;
        let radius_mm = if end { row.unused(doc, 3, &NO_RADIUS)? } else { row.number(doc, 3, &RADIUS)? };
        Ok(Corner { point: Point3::new(at(0)?, at(1)?, at(2)?), radius_mm })
    };
    Ok(ControlPolygon { corners: rows.iter().enumerate().map(corner).collect::<Result<_, _>>()? })
}

pub(super) fn value_error(
    doc: &Document,
    line: usize,
    key: &str,
    found: impl std::fmt::Display,
    allowed: &str,
) -> ConfigError {
    ConfigError::Value {
        file: doc.file().to_owned(),
        line,
        key: key.to_owned(),
        found: found.to_string(),
        allowed: allowed.to_owned(),
    }
}

/// To 1e-9, as values are written: 99.99999999999999 stays 100 in a file.
fn rounded(value: f64) -> f64 {
    (value * 1e9).round() / 1e9
}

/// Never "-0".
fn mm(value: f64) -> String {
    (rounded(value) + 0.0).to_string()
}

fn degrees(rad: f64) -> String {
    (to_degrees_clean(rad) + 0.0).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Table, String> {
        parse_table(&Document::new("t.csv", text)).map_err(|e| e.to_string())
    }

    const LRA_TEXT: &str =
        "length_mm,rotation_deg,angle_deg,radius_mm\n120,0,92.1,50.8\n150.25,-60.5,45,50.8\n100,0,0,\n";

    #[test]
    fn each_form_reads_and_writes_the_same_text() {
        let xyz = "x_mm,y_mm,z_mm,radius_mm\n0,0,0,\n200,0,0,50.8\n200,-300.125,0,\n";
        let ybc = "y_mm,b_deg,c_deg,radius_mm\n85,90,90,40\n754,90,0,\n614,48,12.5,40\n";
        for text in [LRA_TEXT, xyz, ybc] {
            let table = parse(text).unwrap();
            assert_eq!(format_table(&table), text);
        }
        let Table::Lra(lra) = parse(LRA_TEXT).unwrap() else { panic!("not an LRA table") };
        assert_eq!((lra.bends.len(), lra.last_length_mm), (2, 100.0));
        assert!((lra.bends[1].rotation_rad.to_degrees() + 60.5).abs() < 1e-12);
    }

    #[test]
    fn spreadsheet_habits_are_read() {
        let text =
            format!("\u{feff}{}\r\n\r\n", LRA_TEXT.trim_end().replace('\n', "\r\n").replace(',', " , "));
        assert_eq!(parse(&text).unwrap(), parse(LRA_TEXT).unwrap());
    }

    #[test]
    fn complaints_name_line_column_found_and_allowed() {
        let case = |from: &str, to: &str| parse(&LRA_TEXT.replace(from, to)).unwrap_err();
        assert_eq!(
            case("-60.5", "north"),
            "t.csv, line 3: rotation_deg = \"north\", allowed is a number from -3600 to 3600"
        );
        assert_eq!(
            case(",45,", ",400,"),
            "t.csv, line 3: angle_deg = \"400\", allowed is a number from 0 up to, not including, 360"
        );
        assert!(case("120,", "NaN,").contains("line 2: length_mm = \"NaN\""));
        assert!(case("120,", "-0.001,").contains("line 2: length_mm"));
        assert!(case("92.1,50.8", "92.1,").contains("line 2: radius_mm = \"\""));
        assert!(case("120,0,", "120,5,0,").contains("line 2: number of columns = 5, allowed is 4"));
        assert!(case("100,0,0,", "100,0,30,50").contains("line 4: angle_deg = \"30\", allowed is 0"));
        assert!(case("length_mm", "len").contains("line 1: header = \"len,rotation_deg"));
        assert!(parse("").unwrap_err().contains("line 1: header = \"\""));
        assert!(parse("length_mm,rotation_deg,angle_deg,radius_mm\n").unwrap_err().contains("rows = none"));
        assert!(parse("x_mm,y_mm,z_mm,radius_mm\n1,2,3,\n").unwrap_err().contains("at least 2 points"));
        assert!(parse("x_mm,y_mm,z_mm,radius_mm\n0,0,0,\n1,0,0,\n1,1,0,\n").unwrap_err().contains("line 3"));
    }

    #[test]
    fn what_rounds_to_a_forbidden_value_is_refused_at_once() {
        let case = |from: &str, to: &str| parse(&LRA_TEXT.replacen(from, to, 1));
        assert!(case("92.1,", "359.9999999999,").unwrap_err().contains("angle_deg = \"359.9999999999\""));
        assert!(case("92.1,50.8", "92.1,1e-10").unwrap_err().contains("radius_mm = \"1e-10\""));
        let table = case("92.1,", "359.999999999,").unwrap();
        assert_eq!(parse(&format_table(&table)).unwrap(), table);
    }

    #[test]
    fn a_thousand_rows_and_one_more() {
        let table = |rows: usize| format!("y_mm,b_deg,c_deg,radius_mm\n{}", "1,0,1,50\n".repeat(rows));
        assert!(parse(&table(1000)).is_ok());
        assert!(parse(&table(1001)).unwrap_err().contains("at most 1000 rows"));
    }
}
