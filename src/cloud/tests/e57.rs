//! E57: merged scans, units, files that lie or are cut.

use super::stl::stl;
use super::*;

use ::e57 as format;

/// A pose; points in metres, each with its state.
pub(super) type E57Scan = (Option<format::Transform>, Vec<([f64; 3], i64)>);

/// Scans of points in metres, with state (0 valid, 2 invalid), each with a pose.
pub(super) fn e57(scans: &[E57Scan], xml: impl Fn(String) -> String) -> Vec<u8> {
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

pub(super) fn metres(points: &[Point3<f64>]) -> Vec<([f64; 3], i64)> {
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
    says(&refusal("s.e57", &more), &["402 points announced", "400 found"]);
    // Values of no bits: a file of a kilobyte could claim any number of points.
    let nothing = e57(&good(), |xml| {
        let empty = |xml: String, axis: &str| {
            let double = format!("<cartesian{axis} type=\"Float\"");
            xml.replace(&double, &format!("<cartesian{axis} type=\"Integer\" minimum=\"0\" maximum=\"0\""))
        };
        ["X", "Y", "Z"].into_iter().fold(xml, empty).replace("maximum=\"2\"", "maximum=\"0\"")
    });
    says(&refusal("s.e57", &nothing), &["0 bits each", "at least 24"]);
    says(&refusal("s.e57", &e57(&[], |xml| xml)), &["no scan in it"]);
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
