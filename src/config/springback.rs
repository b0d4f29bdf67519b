//! Spring-back as others keep it, as CSV of two columns told apart by their header: a controller's pair, a shop's
//! overbend list, the bends of a test tube.
//!
//! Degrees in the file, radians in the type; every complaint names file, line and column.

use std::path::Path;

use super::tables::value_error;
use super::{ConfigError, Document};
use crate::tube::{SpringbackForm, SpringbackTable};

/// Header of each form.
const FORMS: [(SpringbackForm, [&str; 2]); 4] = [
    (SpringbackForm::Designed, ["designed_deg", "springback_deg"]),
    (SpringbackForm::Commanded, ["commanded_deg", "springback_deg"]),
    (SpringbackForm::Overbend, ["angle_deg", "overbend_deg"]),
    (SpringbackForm::Test, ["commanded_deg", "measured_deg"]),
];

/// A list that is longer is something else.
const MAX_ROWS: usize = 400;
/// No tube springs back by more.
const MOST_DEG: f64 = 60.0;

/// Reads a table of spring-back.
pub fn read_springback(path: &Path) -> Result<SpringbackTable, ConfigError> {
    parse_springback(&Document::read(path)?)
}

/// Validates its text.
pub fn parse_springback(doc: &Document) -> Result<SpringbackTable, ConfigError> {
    let text = doc.text().trim_start_matches('\u{feff}'); // spreadsheets put a byte order mark in front
    let lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    let mut lines = lines.filter(|(_, line)| !line.is_empty());
    let (header_line, header) = lines.next().unwrap_or((1, ""));
    let (form, columns) = form_of(doc, header_line, header)?;
    let mut rows_deg: Vec<[f64; 2]> = Vec::new();
    for (line, text) in lines {
        let row = row_of(doc, line, form, columns, text)?;
        let twice = rows_deg.iter().any(|r| r[0] == row[0]);
        if twice && form != SpringbackForm::Test {
            return Err(value_error(doc, line, columns[0], row[0], "an angle that no earlier row has"));
        }
        rows_deg.push(row);
    }
    if !(2..=MAX_ROWS).contains(&rows_deg.len()) {
        let allowed = format!("2 to {MAX_ROWS}");
        return Err(value_error(doc, header_line, "number of rows", rows_deg.len(), &allowed));
    }
    Ok(SpringbackTable { form, rows_rad: rows_deg.iter().map(|row| row.map(f64::to_radians)).collect() })
}

fn form_of(
    doc: &Document,
    line: usize,
    header: &str,
) -> Result<(SpringbackForm, [&'static str; 2]), ConfigError> {
    let found: Vec<&str> = header.split(',').map(str::trim).collect();
    FORMS.into_iter().find(|(_, columns)| found == *columns).ok_or_else(|| {
        let [designed, commanded, overbend, test] = FORMS.map(|(_, columns)| columns.join(","));
        let allowed = format!(
            "{designed} or {commanded} (a controller's pair), {overbend} (a shop's list) or {test} (a bent test)"
        );
        let shown: String = header.chars().take(60).collect();
        value_error(doc, line, "header", format!("{shown:?}"), &allowed)
    })
}

fn row_of(
    doc: &Document,
    line: usize,
    form: SpringbackForm,
    columns: [&'static str; 2],
    text: &str,
) -> Result<[f64; 2], ConfigError> {
    let cells: Vec<&str> = text.split(',').map(str::trim).collect();
    let &[angle, other] = cells.as_slice() else {
        let allowed = format!("2 ({}), with a point for decimals", columns.join(","));
        return Err(value_error(doc, line, "number of columns", cells.len(), &allowed));
    };
    let number = |column: usize, cell: &str, ok: &dyn Fn(f64) -> bool, allowed: &str| {
        let value = cell.parse::<f64>().ok().filter(|value| ok(*value));
        value.ok_or_else(|| value_error(doc, line, columns[column], format!("{cell:?}"), allowed))
    };
    let angle_deg = number(0, angle, &|a| a > 0.0 && a < 360.0, "a number above 0 and below 360")?;
    let other_deg = match form {
        SpringbackForm::Test => {
            let least = (angle_deg - MOST_DEG).max(0.0);
            let allowed = format!("a number above {least} up to {} of this row: {angle_deg}", columns[0]);
            number(1, other, &|m| m > least && m <= angle_deg, &allowed)?
        }
        SpringbackForm::Commanded => {
            let most = MOST_DEG.min(angle_deg);
            number(1, other, &|s| (0.0..most).contains(&s), &format!("a number from 0 to below {most}"))?
        }
        SpringbackForm::Designed | SpringbackForm::Overbend => {
            let most = MOST_DEG.min(360.0 - angle_deg);
            number(1, other, &|s| (0.0..most).contains(&s), &format!("a number from 0 to below {most}"))?
        }
    };
    Ok([angle_deg, other_deg])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<SpringbackTable, String> {
        parse_springback(&Document::new("s.csv", text)).map_err(|e| e.to_string())
    }

    #[test]
    fn the_header_tells_the_form_and_spreadsheet_habits_are_read() {
        let table = parse("\u{feff}angle_deg , overbend_deg\r\n\r\n30, 0.9\r\n90,2\r\n").unwrap();
        assert_eq!(table.form, SpringbackForm::Overbend);
        assert_eq!(table.rows_rad[1].map(|v| (v.to_degrees() * 1e9).round() / 1e9), [90.0, 2.0]);
        for (form, columns) in FORMS {
            let text = format!("{}\n20,1\n20.5,2\n", columns.join(","));
            assert_eq!(parse(&text.replace(",2\n", ",0.5\n")).map(|t| t.form), Ok(form));
        }
    }

    #[test]
    fn complaints_name_line_column_found_and_allowed() {
        let list = "angle_deg,overbend_deg\n30,0.9\n90,2\n";
        let case = |from: &str, to: &str| parse(&list.replacen(from, to, 1)).unwrap_err();
        assert_eq!(
            case("0.9", "x"),
            "s.csv, line 2: overbend_deg = \"x\", allowed is a number from 0 to below 60"
        );
        assert!(case("90,2", "90,2,1").contains("line 3: number of columns = 3, allowed is 2"));
        assert!(case("90,2", "30,2").contains("line 3: angle_deg = 30, allowed is an angle that no earlier"));
        assert!(case("90,2", "NaN,2").contains("line 3: angle_deg = \"NaN\""));
        assert!(case("90,2\n", "").contains("number of rows = 1, allowed is 2 to 400"));
        assert!(case("overbend", "bend").contains("line 1: header = \"angle_deg,bend_deg\""));
        assert!(parse("").unwrap_err().contains("line 1: header = \"\""));
        let swapped = "commanded_deg,measured_deg\n60,58.8\n108.1,110\n";
        assert!(parse(swapped).unwrap_err().contains("line 3: measured_deg = \"110\", allowed is a number"));
        let too_much = "commanded_deg,springback_deg\n20,20\n120,2\n";
        assert!(parse(too_much).unwrap_err().contains("line 2: springback_deg = \"20\""));
    }
}
