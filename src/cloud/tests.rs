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
