//! The door as its users see it: every variant of every format read alike, every bad file refused with the reason.

use std::path::{Path, PathBuf};

use nalgebra::Point3;
use proptest::prelude::*;

use super::*;

/// 400 points over some 300 mm, no two alike.
fn sample() -> Vec<Point3<f64>> {
    (0..400)
        .map(|i| {
            let t = f64::from(i) * 0.75;
            Point3::new(t, 10.0 * (t * 0.3).sin() - 500.0, 10.0 * (t * 0.3).cos())
        })
        .collect()
}

fn refusal(name: &str, bytes: &[u8]) -> String {
    parse_scan(Path::new(name), bytes, Unit::Millimetre).expect_err("should be refused").to_string()
}

fn accepted(name: &str, bytes: &[u8]) -> Scan {
    parse_scan(Path::new(name), bytes, Unit::Millimetre).unwrap()
}

fn text(points: &[Point3<f64>], separator: &str) -> String {
    points.iter().map(|p| format!("{}{separator}{}{separator}{}\n", p.x, p.y, p.z)).collect()
}

/// Largest distance between the cloud's points and the given ones.
fn error_mm(cloud: &PointCloud, points: &[Point3<f64>]) -> f64 {
    assert_eq!(cloud.len(), points.len());
    cloud.iter().zip(points).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
}

/// The parts of a refusal that its reader needs.
fn says(refusal: &str, parts: &[&str]) {
    for part in parts {
        assert!(refusal.contains(part), "{part:?} is missing in: {refusal}");
    }
}

// ---- text -------------------------------------------------------------------------------------------------

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

// ---- the checks that hold for every format ----------------------------------------------------------------

#[test]
fn unknown_kinds_and_empty_files() {
    says(&refusal("s.xyz", b""), &["s.xyz", "empty"]);
    says(&refusal("s.igs", b"1 2 3\n"), &[".igs", ".ply", ".xyz .asc .pts .csv .txt"]);
    says(&refusal("scan", b"1 2 3\n"), &["no extension"]);
    says(&refusal("s.ply", b"1 2 3\n"), &["does not begin"]);
    says(&refusal("s.xyz", b"# only a comment\n"), &["0 found"]);
    let missing = read_scan(Path::new("/nonexistent/s.ply"), Unit::Metre).unwrap_err().to_string();
    says(&missing, &["/nonexistent/s.ply", "cannot be read"]);
    let folder = read_scan(&std::env::temp_dir(), Unit::Metre).unwrap_err().to_string();
    says(&folder, &["cannot be read"]);
}

#[test]
fn at_least_a_hundred_points() {
    let points = sample();
    let wide = |n: usize| text(&points[400 - n..], " ");
    says(&refusal("s.xyz", wide(50).as_bytes()), &["50 points", "at least 100"]);
    says(&refusal("s.xyz", wide(99).as_bytes()), &["99 points"]);
    assert_eq!(accepted("s.xyz", wide(100).as_bytes()).cloud.len(), 100);
    // Copies do not count.
    says(&refusal("s.xyz", wide(99).repeat(3).as_bytes()), &["99 points"]);
}

#[test]
fn duplicates_are_removed_and_counted() {
    let points = sample();
    let mut rows = text(&points, " ");
    rows.push_str(&text(&points[..312], " "));
    rows.push_str("-0.0 1 2\n0.0 1 2\n");
    let scan = accepted("s.xyz", rows.as_bytes());
    assert_eq!(scan.notes, ["313 duplicate points removed"]);
    assert!(error_mm(&scan.cloud.select(&(0..400).collect::<Vec<_>>()), &points) < 2e-5);
    assert_eq!(scan.cloud.len(), 401);
}

#[test]
fn coordinates_that_are_none() {
    let rows = text(&sample(), " ");
    for bad in ["nan 0 0", "0 inf 0", "0 0 -infinity", "0 1e999 0"] {
        says(
            &refusal("s.xyz", format!("{rows}{bad}\n{bad}\n").as_bytes()),
            &["2 of 402 points", "the first is point 400"],
        );
    }
    says(&refusal("s.xyz", format!("{rows}0 -3e9 0\n").as_bytes()), &["1 points", "point 400", "3e9"]);
}

#[test]
fn the_wrong_unit_is_refused_with_the_right_one() {
    let scaled = |by: f64| text(&sample().iter().map(|p| p * by).collect::<Vec<_>>(), " ");
    let read = |by: f64, unit| parse_scan(Path::new("s.xyz"), scaled(by).as_bytes(), unit);
    says(&read(1e-3, Unit::Millimetre).unwrap_err().to_string(), &["extent is 0.301 mm", "--unit m"]);
    says(&read(1.0, Unit::Metre).unwrap_err().to_string(), &["--unit mm"]);
    says(&read(1.0 / 25.4, Unit::Millimetre).unwrap_err().to_string(), &["would be 300.6 mm: --unit inch"]);
    says(&read(1e-6, Unit::Millimetre).unwrap_err().to_string(), &["is this the scan of a tube?"]);
    for (by, unit) in [(1e-3, Unit::Metre), (1.0 / 25.4, Unit::Inch)] {
        assert!(error_mm(&read(by, unit).unwrap().cloud, &sample()) < 2e-5);
    }
}

#[test]
fn the_hash_is_that_of_the_file() {
    let rows = text(&sample(), " ");
    let expected = {
        use sha2::Digest;
        format!("{:x?}", sha2::Sha256::digest(rows.as_bytes()).as_slice())
    };
    let got: Vec<u8> = accepted("s.xyz", rows.as_bytes())
        .sha256
        .as_bytes()
        .chunks(2)
        .map(|c| u8::from_str_radix(std::str::from_utf8(c).unwrap(), 16).unwrap())
        .collect();
    assert_eq!(format!("{got:x?}"), expected);
}

#[test]
fn the_order_in_the_file_does_not_move_a_point() {
    let points = sample();
    let turned: Vec<_> = points.iter().rev().copied().collect();
    let bits = |points: &[Point3<f64>]| {
        let cloud = accepted("s.xyz", text(points, " ").as_bytes()).cloud;
        let mut all: Vec<[u64; 3]> = cloud.iter().map(|p| p.coords.map(f64::to_bits).into()).collect();
        all.sort();
        all
    };
    assert_eq!(bits(&points), bits(&turned));
}

// ---- PLY --------------------------------------------------------------------------------------------------

/// How one PLY file is written.
#[derive(Debug, Clone)]
struct Variant {
    /// "ascii", "binary_little_endian" or "binary_big_endian".
    format: &'static str,
    /// Types of x, y and z.
    types: [&'static str; 3],
    /// Properties of the vertex in order: indices into x y z nx ny nz, 6 an extra uchar, 7 a list.
    order: Vec<usize>,
    /// Whether elements stand before and after the vertices.
    others: bool,
    /// Line ending of the header.
    ending: &'static str,
}

const NAMES: [&str; 8] = ["x", "y", "z", "nx", "ny", "nz", "red", "indices"];

impl Variant {
    fn kind(&self, property: usize) -> &'static str {
        match property {
            0..=2 => self.types[property],
            3..=5 => "float",
            6 => "uchar",
            _ => "list uchar short",
        }
    }

    fn put(&self, out: &mut Vec<u8>, kind: &str, value: f64) {
        let bytes = match kind {
            "char" => vec![value as i8 as u8],
            "uchar" => vec![value as u8],
            "short" => (value as i16).to_le_bytes().to_vec(),
            "ushort" => (value as u16).to_le_bytes().to_vec(),
            "int" => (value as i32).to_le_bytes().to_vec(),
            "uint" => (value as u32).to_le_bytes().to_vec(),
            "float" => (value as f32).to_le_bytes().to_vec(),
            _ => value.to_le_bytes().to_vec(),
        };
        match self.format {
            "ascii" => out.extend(format!("{value} ").bytes()),
            "binary_big_endian" => out.extend(bytes.iter().rev()),
            _ => out.extend(bytes),
        }
    }

    fn put_list(&self, out: &mut Vec<u8>, items: &[f64]) {
        self.put(out, "uchar", items.len() as f64);
        items.iter().for_each(|v| self.put(out, "short", *v));
    }

    fn end_line(&self, out: &mut Vec<u8>) {
        if self.format == "ascii" {
            out.extend(b"\n");
        }
    }

    fn file(&self, points: &[Point3<f64>]) -> Vec<u8> {
        let mut header = vec!["ply".to_owned(), format!("format {} 1.0", self.format)];
        header.push("comment made by a test".to_owned());
        let other = |name: &str| format!("element {name} 2\nproperty float a\nproperty list uchar short b");
        let other = |name: &str| other(name).replace('\n', self.ending);
        header.extend(self.others.then(|| other("camera")));
        header.push(format!("element vertex {}", points.len()));
        header.extend(self.order.iter().map(|&p| format!("property {} {}", self.kind(p), NAMES[p])));
        header.extend(self.others.then(|| other("face")));
        header.push("end_header".to_owned() + self.ending);
        let mut out = header.join(self.ending).into_bytes();
        let put_other = |out: &mut Vec<u8>| {
            for i in 0..2 {
                self.put(out, "float", 7.5);
                self.put_list(out, &[1.0, 2.0, -3.0][..3 - i]);
                self.end_line(out);
            }
        };
        if self.others {
            put_other(&mut out);
        }
        for (i, p) in points.iter().enumerate() {
            for &property in &self.order {
                match property {
                    0..=2 => self.put(&mut out, self.types[property], p[property]),
                    3..=5 => self.put(&mut out, "float", normal(i)[property - 3]),
                    6 => self.put(&mut out, "uchar", 200.0),
                    _ => self.put_list(&mut out, &[4.0; 3][..i % 4]),
                }
            }
            self.end_line(&mut out);
        }
        if self.others {
            put_other(&mut out);
        }
        out
    }
}

fn normal(i: usize) -> [f64; 3] {
    let t = i as f64 * 0.1;
    [t.sin() as f32 as f64, t.cos() as f32 as f64, 0.0]
}

fn variants() -> impl Strategy<Value = Variant> {
    let format = prop::sample::select(vec!["ascii", "binary_little_endian", "binary_big_endian"]);
    let scalar =
        || prop::sample::select(vec!["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]);
    let order = prop::sample::subsequence(vec![3, 4, 5, 6, 7], 0..=5).prop_flat_map(|extra| {
        let all: Vec<usize> = [0, 1, 2].into_iter().chain(extra).collect();
        Just(all).prop_shuffle()
    });
    let ending = prop::sample::select(vec!["\n", "\r\n"]);
    (format, scalar(), scalar(), scalar(), order, any::<bool>(), ending).prop_map(
        |(format, x, y, z, order, others, ending)| Variant {
            format,
            types: [x, y, z],
            order,
            others,
            ending,
        },
    )
}

/// Whole coordinates that every scalar type can hold, no two alike.
fn lattice() -> Vec<Point3<f64>> {
    (0..250).map(|i| Point3::new((i % 100) as f64, (i / 100) as f64 * 7.0, (i % 90) as f64)).collect()
}

proptest! {
    #[test]
    fn every_variant_of_ply_reads_alike(variant in variants()) {
        let points = lattice();
        let scan = accepted("s.ply", &variant.file(&points));
        prop_assert_eq!(error_mm(&scan.cloud, &points), 0.0);
        prop_assert!(scan.notes.is_empty(), "{:?}", scan.notes);
        let all_normals = [3, 4, 5].iter().all(|n| variant.order.contains(n));
        for i in [0, 17, 249] {
            prop_assert_eq!(scan.cloud.normal(i).is_some(), all_normals);
            let error = scan.cloud.normal(i).map_or(0.0, |n| (n - nalgebra::Vector3::from(normal(i))).norm());
            prop_assert!(error < 1e-6, "{}", error);
        }
    }

    #[test]
    fn what_is_written_is_read_again(
        at in (-1e6..1e6f64, -1e6..1e6f64, -1e6..1e6f64),
        coords in prop::collection::vec((-900.0..900.0f64, -900.0..900.0f64, -50.0..50.0f64), 120..300),
        with_normals: bool,
    ) {
        let points: Vec<_> =
            coords.iter().map(|c| Point3::new(at.0 + c.0, at.1 + c.1, at.2 + c.2)).collect();
        let mut cloud = PointCloud::from_points(&points);
        if with_normals {
            cloud = cloud.with_normals(vec![[0.0, 0.6, 0.8]; points.len()]).unwrap();
        }
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.ply", "a.xyz"] {
            let path = folder.path().join(name);
            write_scan(&path, &cloud).unwrap();
            let scan = read_scan(&path, Unit::Millimetre).unwrap();
            prop_assert!(error_mm(&scan.cloud, &points) < 5e-4);
            let normal = (with_normals && name == "a.ply").then(|| [0.0, 0.6f32, 0.8f32].map(f64::from).into());
            prop_assert_eq!(scan.cloud.normal(5), normal);
        }
    }

    #[test]
    fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..600), kind in 0usize..4) {
        let mut file = ["", "ply\n", "ply\nformat binary_little_endian 1.0\n", ""][kind].as_bytes().to_vec();
        file.extend(bytes);
        let _ = parse_scan(Path::new(["s.xyz", "s.ply", "s.ply", "s.csv"][kind]), &file, Unit::Millimetre);
    }

    #[test]
    fn no_mutilation_of_a_good_file_panics(
        variant in variants(),
        cut in 0.0..1.0f64,
        spots in prop::collection::vec((0.0..1.0f64, any::<u8>()), 0..8),
        in_header: bool,
    ) {
        let mut file = variant.file(&lattice());
        let region = if in_header { 300 } else { file.len() };
        for (at, byte) in spots {
            let at = (at * region as f64) as usize;
            file[at] = byte;
        }
        let _ = parse_scan(Path::new("s.ply"), &file, Unit::Millimetre);
        file.truncate((cut * file.len() as f64) as usize);
        let _ = parse_scan(Path::new("s.ply"), &file, Unit::Millimetre);
    }

    #[test]
    fn a_truncated_ply_is_never_taken_for_a_whole_one(variant in variants(), cut in 1usize..200) {
        // Cut within the vertices (the last rows), so less than announced is there.
        let variant = Variant { others: false, ..variant };
        let mut file = variant.file(&lattice());
        // In ascii a lost line end or a lost last digit cannot be noticed: cut a whole row or more.
        let cut = if variant.format == "ascii" { cut + 60 } else { cut };
        file.truncate(file.len() - cut);
        prop_assert!(parse_scan(Path::new("s.ply"), &file, Unit::Millimetre).is_err());
    }
}

#[test]
fn normals_without_direction_are_passed_over_and_others_made_unit() {
    let with = |normal: &str| {
        let rows: String = sample().iter().map(|p| format!("{} {} {} {normal}\n", p.x, p.y, p.z)).collect();
        let names = "property float nx\nproperty float ny\nproperty float nz\nend_header\n";
        accepted("s.ply", (header("ascii", "400").replace("end_header\n", names) + &rows).as_bytes())
    };
    assert_eq!(with("0 0 -3").cloud.normal(7), Some([0.0, 0.0, -1.0].into()));
    for bad in ["0 0 0", "nan 0 1", "inf 0 0"] {
        let scan = with(bad);
        assert_eq!(scan.cloud.normal(7), None);
        assert_eq!(scan.notes, ["normals passed over: 400 have no direction"]);
    }
}

/// A header for `count` float vertices.
fn header(format: &str, count: &str) -> String {
    format!(
        "ply\nformat {format} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
}

fn floats(points: &[Point3<f64>]) -> Vec<u8> {
    points.iter().flat_map(|p| [p.x, p.y, p.z]).flat_map(|v| (v as f32).to_le_bytes()).collect()
}

#[test]
fn a_ply_that_lacks_vertices_names_both_numbers() {
    let mut file = header("binary_little_endian", "400").into_bytes();
    file.extend(floats(&sample()[..300]));
    file.extend([0; 11]);
    says(&refusal("s.ply", &file), &["400 vertices announced", "300 found"]);
    let ascii = header("ascii", "400") + &text(&sample()[..300], " ");
    says(&refusal("s.ply", ascii.as_bytes()), &["400 vertices announced", "300 found"]);
}

#[test]
fn a_lying_count_allocates_nothing() {
    for count in ["18446744073709551615", "4611686018427387904", "1537228672809129302"] {
        for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
            let mut file = header(format, count).into_bytes();
            file.extend(if format == "ascii" {
                text(&sample(), " ").into_bytes()
            } else {
                floats(&sample())
            });
            says(&refusal("s.ply", &file), &[count, "400 found"]);
        }
    }
    // Too small a count loses points: at least it is said.
    let mut file = header("binary_little_endian", "390").into_bytes();
    file.extend(floats(&sample()));
    assert_eq!(accepted("s.ply", &file).notes, ["120 bytes after the last vertex passed over"]);
    let ascii = header("ascii", "390") + &text(&sample(), " ");
    assert_eq!(accepted("s.ply", ascii.as_bytes()).notes, ["10 lines after the last vertex passed over"]);
    // A list of four thousand million items, and an element of endless nothing.
    let list = "ply\nformat binary_little_endian 1.0\nelement junk 9\nproperty list uint double a\n\
                element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    let mut file = list.as_bytes().to_vec();
    file.extend([0xff; 64]);
    says(&refusal("s.ply", &file), &["9 elements \"junk\" announced", "0 found"]);
    let mut file = header("binary_little_endian", "400")
        .replace("element vertex", "element nothing 18446744073709551615\nelement vertex")
        .into_bytes();
    file.extend(floats(&sample()));
    assert_eq!(accepted("s.ply", &file).cloud.len(), 400);
    let mut file = list.replace("uint", "int").into_bytes();
    file.extend([0xff; 64]);
    says(&refusal("s.ply", &file), &["byte 157", "a list of -1 items"]);
}

#[test]
fn faults_in_ascii_vertices_are_placed() {
    let rows = text(&sample()[..399], " ");
    for (bad, parts) in [
        ("1 2 abc", ["line 407, column 5", "\"abc\""]),
        ("1 2", ["line 407, column 4", "a value for \"z\""]),
        ("1 2 3 4", ["line 407, column 7", "no more values"]),
    ] {
        says(&refusal("s.ply", (header("ascii", "400") + &rows + bad + "\n").as_bytes()), &parts);
    }
}

#[test]
fn faults_in_headers_are_placed() {
    let good = header("ascii", "400");
    for (from, to, parts) in [
        ("ascii", "binary_middle_endian", ["line 2", "binary_little_endian"]),
        ("ascii 1.0", "ascii 2.0", ["line 2", "allowed is format"]),
        ("vertex 400", "vertex -4", ["line 3", "element NAME COUNT"]),
        ("float y", "half y", ["line 5", "a type out of"]),
        ("float y", "list uchar float y", ["line 7", "the properties x, y and z"]),
        ("float y", "list float float y", ["line 5", "integer"]),
        ("float y", "float x", ["line 5", "once"]),
        ("float y", "float", ["line 5", "property TYPE NAME"]),
        ("element vertex 400\n", "", ["line 3", "an element before"]),
        ("vertex 400", "point 400", ["line 7", "exactly one"]),
        ("format ascii 1.0\n", "", ["line 6", "format ascii 1.0"]),
        ("end_header\n", "", ["line 7", "end_header"]),
        ("end_header", "end", ["line 7", "end_header"]),
    ] {
        assert!(good.contains(from));
        says(&refusal("s.ply", good.replacen(from, to, 1).as_bytes()), &parts);
    }
}

// ---- a real scan ------------------------------------------------------------------------------------------

/// Data that is not part of the project; None (said aloud) where it is absent.
fn real_scan() -> Option<PathBuf> {
    let folder = std::env::var_os("BENDERD_DATA").unwrap_or_else(|| "../shared".into());
    let path = PathBuf::from(folder).join("real/coil_scan00.ply");
    if !path.exists() {
        eprintln!("skipped: {} is not there", path.display());
        return None;
    }
    Some(path)
}

#[test]
fn a_real_scan_in_metres() {
    let Some(path) = real_scan() else { return };
    says(&read_scan(&path, Unit::Millimetre).unwrap_err().to_string(), &["--unit m"]);
    let scan = read_scan(&path, Unit::Metre).unwrap();
    assert_eq!(scan.cloud.len() + notes_removed(&scan.notes), 99_519);
    let (min, max) = scan.cloud.bounds().unwrap();
    assert!((max - min).norm() > 300.0 && (max - min).norm() < 3000.0);
}

fn notes_removed(notes: &[String]) -> usize {
    notes.iter().filter_map(|n| n.strip_suffix(" duplicate points removed")?.parse::<usize>().ok()).sum()
}

// ---- streams ----------------------------------------------------------------------------------------------

/// Gives its bytes in dribs, as a pipe does, and says nothing of their number.
struct Drips<'a>(&'a [u8], usize);

impl std::io::Read for Drips<'_> {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        let n = out.len().min(self.1).min(self.0.len());
        out[..n].copy_from_slice(&self.0[..n]);
        self.0 = &self.0[n..];
        Ok(n)
    }
}

/// More points than the head of a file holds, so that blocks follow.
fn long() -> Vec<u8> {
    let points: Vec<_> =
        (0..200_000).map(|i| Point3::new(f64::from(i % 1000), f64::from(i / 1000), 0.5)).collect();
    let mut file = header("binary_little_endian", "200000").into_bytes();
    file.extend(floats(&points));
    file
}

#[test]
fn blocks_of_any_size_and_pipes_read_alike() {
    let file = long();
    let whole = accepted("s.ply", &file);
    assert_eq!((whole.cloud.len(), whole.notes.len()), (200_000, 0));
    for (block, drip, size) in
        [(1000, 64, 0), (4096, 4096, 0), (65_537, 1000, 7), (1 << 20, 1 << 16, u64::MAX / 4)]
    {
        let source = stream::Source::new("s.ply", Drips(&file, drip), size, 1 << 30);
        let scan = door::scan(Path::new("s.ply"), source, block, Unit::Millimetre).unwrap();
        assert!(scan == whole, "blocks of {block}, {drip} bytes at a time");
    }
}

#[test]
fn a_stream_that_ends_early_or_grows_or_never_ends() {
    let file = long();
    let read = |bytes: &[u8], size: u64, most: u64| {
        let source = stream::Source::new("s.ply", bytes, size, most);
        door::scan(Path::new("s.ply"), source, 1 << 16, Unit::Millimetre)
    };
    let all = file.len() as u64;
    // Truncated between the look at its size and the reading, within a record.
    let short = read(&file[..file.len() - 25], all, 1 << 30).unwrap_err().to_string();
    says(&short, &["200000 vertices announced", "199997 found"]);
    let mut grown = file.clone();
    grown.extend([7; 300_000]);
    let scan = read(&grown, all, 1 << 30).unwrap();
    assert_eq!(scan.notes, ["300000 bytes after the last vertex passed over"]);
    assert_eq!(scan.cloud, accepted("s.ply", &file).cloud);
    says(&read(&grown, all, all).unwrap_err().to_string(), &["at most"]);
    says(&read(&file, 0, 1000).unwrap_err().to_string(), &["at most 1000 are read"]);
    assert!(read(&file, all, all).is_ok());
}

#[test]
fn long_texts_keep_order_and_line_numbers() {
    let points: Vec<_> =
        (0..60_000).map(|i| Point3::new(f64::from(i % 300), f64::from(i / 300), 0.25)).collect();
    let rows = text(&points, " ").replace("\n7 ", "\n\n# seven\n7 ");
    let scan = accepted("s.xyz", rows.as_bytes());
    assert_eq!(error_mm(&scan.cloud, &points), 0.0);
    // Two faults: the first is named, wherever the pieces are cut.
    for line in [1, 20_000, 59_999] {
        let mut lines: Vec<&str> = rows.lines().collect();
        lines[line] = "1 2 x3";
        lines[60_001] = "1 2 x3";
        let bad = lines.join("\n");
        says(&refusal("s.xyz", bad.as_bytes()), &[&format!("line {}, column 5", line + 1)]);
    }
    let ply = header("ascii", "60000") + &text(&points, " ");
    assert_eq!(error_mm(&accepted("s.ply", ply.as_bytes()).cloud, &points), 0.0);
    let bad = ply.replacen("\n150 150 ", "\n150 1s0 ", 1);
    says(&refusal("s.ply", bad.as_bytes()), &["line 45158, column 5"]);
}

#[test]
fn more_than_the_head_without_end_of_header() {
    let mut file = b"ply\ncomment ".to_vec();
    file.extend(vec![b'a'; 3 << 20]);
    says(&refusal("s.ply", &file), &["end_header"]);
}

// ---- written and read -------------------------------------------------------------------------------------

#[test]
fn every_format_that_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = PointCloud::from_points(&sample());
    let read = |name: &str| read_scan(&folder.path().join(name), Unit::Millimetre).unwrap();
    for name in ["a.ply", "a.e57", "a.stl", "a.xyz", "a.asc", "a.txt", "a.pts", "a.csv"] {
        write_scan(&folder.path().join(name), &cloud).unwrap();
        let scan = read(name);
        assert!(error_mm(&scan.cloud, &sample()) < 5e-5, "{name}");
        assert!(scan.notes.is_empty(), "{name}: {:?}", scan.notes);
    }
    let normals = cloud.clone().with_normals(vec![[0.0, 0.6, 0.8]; 400]).unwrap();
    for form in PlyForm::ALL {
        write_ply_as(&folder.path().join("a.ply"), &normals, form).unwrap();
        let scan = read("a.ply");
        assert!(error_mm(&scan.cloud, &sample()) < 5e-5, "{form:?}");
        assert!((scan.cloud.normal(3).unwrap().norm() - 1.0).abs() < 1e-6 && scan.notes.is_empty());
    }
    let refused = write_scan(Path::new("a.step"), &cloud).unwrap_err().to_string();
    says(&refused, &["only .ply", ".csv are written"]);
}

// ---- STL --------------------------------------------------------------------------------------------------

fn stl(points: &[Point3<f64>]) -> Vec<u8> {
    let mut out = vec![b's'; 80];
    out[..5].copy_from_slice(b"solid");
    out.extend((points.len() as u32 / 3).to_le_bytes());
    for facet in points.chunks_exact(3) {
        out.extend([0; 12]);
        out.extend(floats(facet));
        out.extend([0; 2]);
    }
    out
}

#[test]
fn corners_of_facets_come_once() {
    let points = &sample()[..399];
    let strip: Vec<_> = points.windows(3).flatten().copied().collect();
    let scan = accepted("s.stl", &stl(&strip));
    assert!(error_mm(&scan.cloud, points) < 5e-5 && scan.notes.is_empty());
    let corner = |p: &Point3<f64>| format!("  Vertex {} {} {}\n", p.x, p.y, p.z);
    let facet = |f: &[Point3<f64>]| {
        let corners: String = f.iter().map(corner).collect();
        format!("facet normal 0 0 1\n outer loop\n{corners} endloop\nendfacet\n")
    };
    let ascii = format!("solid a tube\n{}endsolid\n", strip.chunks(3).map(facet).collect::<String>());
    assert!(error_mm(&accepted("s.STL", ascii.as_bytes()).cloud, points) < 5e-5);
    says(
        &refusal("s.stl", ascii.replacen("0.75 ", "0.7x ", 1).as_bytes()),
        &["line 5, column 10", "a number"],
    );
    says(
        &refusal("s.stl", ascii.replacen("outer", "inner", 1).as_bytes()),
        &["line 3", "\"inner\"", "vertex"],
    );
    says(&refusal("s.stl", ascii.replace("endsolid", "").as_bytes()), &["endsolid", "before the file ends"]);
}

#[test]
fn an_stl_that_lies_or_is_cut() {
    let mut file = stl(&sample()[..399]);
    file[..5].copy_from_slice(b"STL: ");
    says(&refusal("s.stl", &file[..file.len() - 1]), &["133 facets announced", "132 found"]);
    says(&refusal("s.stl", &file[..60]), &["byte 60", "84 bytes"]);
    file.extend([0; 9]);
    assert_eq!(accepted("s.stl", &file).notes, ["9 bytes after the last facet passed over"]);
    file[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    says(&refusal("s.stl", &file), &["4294967295 facets announced", "133 found"]);
    let mut nan = stl(&sample()[..399]);
    nan[96..100].copy_from_slice(&f32::NAN.to_le_bytes());
    says(&refusal("s.stl", &nan), &["1 of 399 points"]);
}

// ---- E57 --------------------------------------------------------------------------------------------------

use ::e57 as format;

/// A pose; points in metres, each with its state.
type E57Scan = (Option<format::Transform>, Vec<([f64; 3], i64)>);

/// Scans of points in metres, with state (0 valid, 2 invalid), each with a pose.
fn e57(scans: &[E57Scan], xml: fn(String) -> String) -> Vec<u8> {
    use format::{E57Writer, Record, RecordDataType, RecordName, RecordValue};
    let mut out = std::io::Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut out, "test").unwrap();
    for (pose, points) in scans {
        let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
        let mut prototype: Vec<Record> = axes
            .map(|name| Record { name, data_type: RecordDataType::Double { min: None, max: None } })
            .into();
        let state = RecordDataType::Integer { min: 0, max: 2 };
        prototype.push(Record { name: RecordName::CartesianInvalidState, data_type: state });
        let mut scan = writer.add_pointcloud("scan", prototype).unwrap();
        scan.set_transform(pose.clone());
        for (p, state) in points {
            let mut values: Vec<_> = p.map(RecordValue::Double).into();
            values.push(RecordValue::Integer(*state));
            scan.add_point(values).unwrap();
        }
        scan.finalize().unwrap();
    }
    writer.finalize_customized_xml(|text| Ok(xml(text))).unwrap();
    drop(writer);
    out.into_inner()
}

fn metres(points: &[Point3<f64>]) -> Vec<([f64; 3], i64)> {
    points.iter().map(|p| ((p / 1000.0).coords.into(), 0)).collect()
}

#[test]
fn scans_of_an_e57_are_merged_by_their_poses() {
    let points = sample();
    let half = std::f64::consts::FRAC_1_SQRT_2;
    // A quarter turn about z, then 1 m along x: the second half is stored where the scanner saw it.
    let pose = format::Transform {
        rotation: format::Quaternion { w: half, x: 0.0, y: 0.0, z: half },
        translation: format::Translation { x: 1.0, y: 0.0, z: 0.0 },
    };
    let seen = points[200..].iter().map(|p| ([p.y / 1e3, -(p.x / 1e3 - 1.0), p.z / 1e3], 0)).collect();
    let mut first = metres(&points[..200]);
    first.insert(50, ([0.0; 3], 2));
    let scan = accepted("s.e57", &e57(&[(None, first), (Some(pose), seen)], |xml| xml));
    assert!(error_mm(&scan.cloud, &points) < 1e-3);
    assert_eq!(scan.notes, ["2 scans merged by their poses", "1 points marked as invalid skipped"]);
}

#[test]
fn an_e57_in_millimetres_is_taken_with_a_note() {
    let file = e57(&[(None, sample().iter().map(|p| (p.coords.into(), 0)).collect())], |xml| xml);
    let scan = accepted("s.e57", &file);
    assert!(error_mm(&scan.cloud, &sample()) < 5e-5);
    assert_eq!(scan.notes, ["read as mm, though the format prescribes m"]);
}

#[test]
fn an_e57_that_lies_or_is_cut_or_is_none() {
    let good = || vec![(None, metres(&sample()))];
    let file = e57(&good(), |xml| xml);
    for cut in [10, 60, 1024, file.len() - 1024, file.len() - 1] {
        says(&refusal("s.e57", &file[..cut]), &["s.e57", "not a sound E57 file"]);
    }
    says(&refusal("s.e57", b"ply\r"), &["end_header"]);
    says(&refusal("s.e57", b"PK"), &["does not begin"]);
    let mut flipped = file.clone();
    flipped[2000] ^= 1;
    says(&refusal("s.e57", &flipped), &["checksum"]);
    let many = e57(&good(), |xml| xml.replace("recordCount=\"400\"", "recordCount=\"4000000000\""));
    says(&refusal("s.e57", &many), &["4000000000 points announced"]);
    let more = e57(&good(), |xml| xml.replace("recordCount=\"400\"", "recordCount=\"402\""));
    says(&refusal("s.e57", &more), &["s.e57"]);
    // Values of no bits: a file of a kilobyte could claim any number of points.
    let nothing = e57(&good(), |xml| {
        let empty = |xml: String, axis: &str| {
            let double = format!("<cartesian{axis} type=\"Float\"");
            xml.replace(&double, &format!("<cartesian{axis} type=\"Integer\" minimum=\"0\" maximum=\"0\""))
        };
        ["X", "Y", "Z"].into_iter().fold(xml, empty).replace("maximum=\"2\"", "maximum=\"0\"")
    });
    says(&refusal("s.e57", &nothing), &["no point that differs"]);
    says(&refusal("s.e57", &e57(&[], |xml| xml)), &["0 points"]);
    let nan = e57(&[(None, vec![([f64::NAN, 0.0, 0.0], 0); 200])], |xml| xml);
    says(&refusal("s.e57", &nan), &["200 of 200 points"]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn no_mutilation_of_an_e57_or_stl_panics(
        spots in prop::collection::vec((0.0..1.0f64, any::<u8>()), 1..4),
        cut in 0.0..1.0f64,
    ) {
        for (name, mut file) in [
            ("s.e57", e57(&[(None, metres(&sample()))], |xml| xml)),
            ("s.stl", stl(&sample())),
        ] {
            for (at, byte) in &spots {
                let at = (at * file.len() as f64) as usize;
                file[at] = *byte;
            }
            let _ = parse_scan(Path::new(name), &file, Unit::Millimetre);
            file.truncate((cut * file.len() as f64) as usize);
            let _ = parse_scan(Path::new(name), &file, Unit::Millimetre);
        }
    }
}
