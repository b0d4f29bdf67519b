//! Scan files as the programs of different makers write them. Shares no code with the readers in `cloud`.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use nalgebra::Point3;

/// A kind of scan file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScanFile {
    /// PLY as text, with a column of intensities.
    PlyAscii,
    /// Binary PLY.
    PlyBinary {
        /// Most significant byte first.
        big: bool,
        /// Coordinates of 8 bytes instead of 4.
        double: bool,
    },
    /// x y z.
    Xyz,
    /// Comment lines, then x y z.
    Asc,
    /// The number of points, then x y z intensity r g b.
    Pts,
    /// A line of names, then values between commas.
    Csv,
}

impl ScanFile {
    /// Every kind once.
    pub const ALL: [ScanFile; 9] = [
        ScanFile::PlyAscii,
        ScanFile::PlyBinary { big: false, double: false },
        ScanFile::PlyBinary { big: false, double: true },
        ScanFile::PlyBinary { big: true, double: false },
        ScanFile::PlyBinary { big: true, double: true },
        ScanFile::Xyz,
        ScanFile::Asc,
        ScanFile::Pts,
        ScanFile::Csv,
    ];

    /// The file's extension.
    pub fn extension(self) -> &'static str {
        match self {
            ScanFile::PlyAscii | ScanFile::PlyBinary { .. } => "ply",
            ScanFile::Xyz => "xyz",
            ScanFile::Asc => "asc",
            ScanFile::Pts => "pts",
            ScanFile::Csv => "csv",
        }
    }

    /// A short name, different for every kind.
    pub fn name(self) -> &'static str {
        match self {
            ScanFile::PlyAscii => "ply ascii",
            ScanFile::PlyBinary { big: false, double: false } => "ply little f32",
            ScanFile::PlyBinary { big: false, double: true } => "ply little f64",
            ScanFile::PlyBinary { big: true, double: false } => "ply big f32",
            ScanFile::PlyBinary { big: true, double: true } => "ply big f64",
            other => other.extension(),
        }
    }

    /// Writes points in millimetres. Text has four decimals, as is usual.
    pub fn write(self, path: &Path, points: &[Point3<f64>]) -> io::Result<()> {
        let mut out = BufWriter::new(File::create(path)?);
        let out = &mut out;
        match self {
            ScanFile::PlyAscii => {
                ply_header(out, "ascii", "float", "property uchar intensity\n", points.len())?;
                text(out, points, " ", " 127")?;
            }
            ScanFile::PlyBinary { big, double } => {
                let format = if big { "binary_big_endian" } else { "binary_little_endian" };
                ply_header(out, format, if double { "double" } else { "float" }, "", points.len())?;
                points.iter().flat_map(|p| p.iter()).try_for_each(|v| match (big, double) {
                    (false, false) => out.write_all(&(*v as f32).to_le_bytes()),
                    (false, true) => out.write_all(&v.to_le_bytes()),
                    (true, false) => out.write_all(&(*v as f32).to_be_bytes()),
                    (true, true) => out.write_all(&v.to_be_bytes()),
                })?;
            }
            ScanFile::Xyz => text(out, points, " ", "")?,
            ScanFile::Asc => {
                writeln!(out, "# scan of one tube\n# x y z in mm")?;
                text(out, points, "\t", "")?;
            }
            ScanFile::Pts => {
                writeln!(out, "{}", points.len())?;
                text(out, points, " ", " -1200 128 128 128")?;
            }
            ScanFile::Csv => {
                writeln!(out, "X,Y,Z,Quality")?;
                text(out, points, ",", ",0.9")?;
            }
        }
        out.flush()
    }
}

fn ply_header(out: &mut impl Write, format: &str, scalar: &str, more: &str, n: usize) -> io::Result<()> {
    write!(out, "ply\nformat {format} 1.0\ncomment one tube\nelement vertex {n}\n")?;
    for axis in ["x", "y", "z"] {
        writeln!(out, "property {scalar} {axis}")?;
    }
    writeln!(out, "{more}end_header")
}

fn text(out: &mut impl Write, points: &[Point3<f64>], between: &str, after: &str) -> io::Result<()> {
    points.iter().try_for_each(|p| writeln!(out, "{:.4}{between}{:.4}{between}{:.4}{after}", p.x, p.y, p.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{Unit, read_scan};

    #[test]
    fn every_kind_passes_the_door() {
        let folder = tempfile::tempdir().unwrap();
        let point = |i: usize| Point3::new(-120.0 + i as f64, 0.5 * (i % 7) as f64, 33.125 + (i % 3) as f64);
        let points: Vec<_> = (0..200).map(point).collect();
        let mut names = Vec::new();
        for kind in ScanFile::ALL {
            let path = folder.path().join(kind.name()).with_extension(kind.extension());
            kind.write(&path, &points).unwrap();
            let scan = read_scan(&path, Unit::Millimetre).unwrap();
            assert_eq!(scan.cloud.iter().collect::<Vec<_>>(), points, "{kind:?}");
            assert_eq!(scan.notes, Vec::<String>::new(), "{kind:?}");
            names.push(kind.name());
        }
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), ScanFile::ALL.len());
    }
}
