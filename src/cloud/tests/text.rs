//! Text scans: dialects, faults with line and column.

use super::ply::header;
use super::*;

/// The same text with each line ended in another way; with `None` in all ways in turn.
fn with_endings(text: &str, ending: Option<&str>) -> Vec<u8> {
    let ways = ["\r", "\r\n", "\n", "\r"];
    let line = |(i, line): (usize, &str)| line.to_owned() + ending.unwrap_or(ways[i % ways.len()]);
    text.lines().enumerate().map(line).collect::<String>().into_bytes()
}

#[test]
fn lines_may_end_in_a_bare_carriage_return_in_every_text_format() {
    // Enough for several pieces, which are read side by side.
    let points: Vec<_> =
        (0..60_000).map(|i| Point3::new(f64::from(i % 300), f64::from(i / 300), 0.25)).collect();
    let rows = |separator: &str| text(&points, separator);
    let corner = |p: &Point3<f64>| format!("vertex {} {} {}\n", p.x, p.y, p.z);
    let corners: String = points.iter().map(corner).collect();
    // Each with the number of lines before its points, a blank one among them where the format allows it.
    let files = [
        ("s.xyz", rows(" "), 0),
        ("s.asc", format!("# scan\n\n{}", rows("  ")), 2),
        ("s.pts", format!("60000\n{}", rows(" ")), 1),
        ("s.csv", format!("x,y,z\n\n{}", rows(",")), 2),
        ("s.txt", rows("\t"), 0),
        ("s.ply", header("ascii", "60000") + &rows(" "), 7),
        ("s.stl", format!("solid s\n\n{corners}endsolid\n"), 2),
    ];
    for (name, file, before) in files {
        for ending in [Some("\n"), Some("\r"), Some("\r\n"), None] {
            let scan = accepted(name, &with_endings(&file, ending));
            assert_eq!(error_mm(&scan.cloud, &points), 0.0, "{name} {ending:?}");
            assert!(scan.notes.is_empty(), "{name} {ending:?}: {:?}", scan.notes);
            // The line is the one that an editor shows.
            for row in [0, 29_999, 59_999] {
                let mut lines: Vec<&str> = file.lines().collect();
                let bad = lines[before + row].replacen("0.25", "0.2x5", 1);
                lines[before + row] = &bad;
                let place = format!("{name}, line {},", before + row + 1);
                says(&refusal(name, &with_endings(&lines.join("\n"), ending)), &[&place, "\"0.2x5\""]);
            }
        }
    }
}

#[test]
fn text_in_all_its_dialects() {
    let points = sample();
    let rows = |s: &str| text(&points, s);
    let extra: String =
        points.iter().map(|p| format!("  {:e}\t{} {} -1020 255 12 7\r\n", p.x, p.y, p.z)).collect();
    let reordered: String = points.iter().map(|p| format!("9,{},{},{}\n", p.z, p.x, p.y)).collect();
    let cases = [
        ("a.xyz", rows(" ")),
        ("a.TXT", rows("\t")),
        ("a.csv", rows(",")),
        ("a.csv", rows("; ")),
        ("a.asc", format!("# comment\n// another\n\n{}", rows(" "))),
        ("a.pts", format!("400\n{extra}")),
        ("a.csv", format!("\u{feff}x,y,z\n{}", rows(","))),
        ("a.csv", format!("\"X [mm]\";\"Y [mm]\";\"Z [mm]\"\n{}", rows(";"))),
        ("a.csv", format!("Intensity,Z_mm,X_mm,Y_mm\n{reordered}")),
        ("a.asc", format!("left right up\n{}", rows("   "))),
    ];
    for (name, body) in cases {
        let scan = accepted(name, body.as_bytes());
        assert!(error_mm(&scan.cloud, &points) < 2e-5, "{}", &body[..40]);
        assert!(scan.notes.is_empty(), "{:?}", scan.notes);
    }
    let without_last_newline = rows(" ").trim_end().to_owned();
    assert_eq!(accepted("a.xyz", without_last_newline.as_bytes()).cloud.len(), 400);
}

#[test]
fn text_in_a_numbers_place_is_named_with_line_and_column() {
    let good = text(&sample(), " ");
    says(
        &refusal("s.xyz", format!("{good}1.0  2.0x 3\n").as_bytes()),
        &["s.xyz, line 401, column 6", "\"2.0x\"", "a number"],
    );
    // A first line with one wrong value is not a header.
    says(&refusal("s.xyz", format!("1.0 oops 3.0\n{good}").as_bytes()), &["line 1, column 5", "\"oops\""]);
    says(&refusal("s.csv", format!("{}1,,3\n", text(&sample(), ",")).as_bytes()), &["line 401, column 3"]);
    says(&refusal("s.xyz", format!("{good}1 2\n").as_bytes()), &["line 401, column 4", "x, y and z"]);
    says(&refusal("s.xyz", b"\x7fELF\x02\x01\x01\0\0\0\n\0\0"), &["line 2"]);
}

#[test]
fn a_decimal_comma_is_refused_and_never_read_as_two_columns() {
    let comma: String =
        sample().iter().map(|p| format!("{:.3};{:.3};{:.3}\n", p.x, p.y, p.z).replace('.', ",")).collect();
    says(&refusal("s.csv", comma.as_bytes()), &["line 1, column 1", "\"0,000\"", "decimal point"]);
    let spaced = comma.replace(';', " ");
    says(&refusal("s.txt", spaced.as_bytes()), &["line 1", "allowed is a number"]);
    // The separator may not change on the way either.
    let mixed = format!("{}1.5, 2.5, 3.5\n", text(&sample(), " "));
    says(&refusal("s.txt", mixed.as_bytes()), &["line 401", "\"1.5,\""]);
}

#[test]
fn announced_counts_of_pts_files() {
    let rows = text(&sample(), " ");
    says(&refusal("s.pts", format!("500\n{rows}").as_bytes()), &["500 points announced", "400 found"]);
    says(&refusal("s.pts", format!("{}\n{rows}", u64::MAX).as_bytes()), &["400 found"]);
    says(&refusal("s.pts", b"400\n"), &["400 points announced", "0 found"]);
    let scan = accepted("s.pts", format!("399\n{rows}").as_bytes());
    assert_eq!(scan.cloud.len(), 400);
    assert_eq!(scan.notes, ["399 points announced, all 400 found were read"]);
}
