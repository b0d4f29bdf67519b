//! Writing clouds to files, in millimetres (E57: metres): for the simulators and for taking a scan elsewhere.

use std::fs::{File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use e57::{E57Writer, Record, RecordDataType, RecordName, RecordValue};

use super::{CloudError, PointCloud};

/// Writes a cloud in the format that the extension names: .ply, .e57, .stl, or text as .xyz, .asc, .txt, .pts or
/// .csv.
pub fn write_scan(path: &Path, cloud: &PointCloud) -> Result<(), CloudError> {
    match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
        Some("ply") => write_ply(path, cloud),
        Some("e57") => write_e57(path, std::slice::from_ref(cloud)),
        Some("stl") => write_stl(path, cloud),
        Some("xyz" | "asc" | "txt") => write_xyz(path, cloud),
        Some("pts") => write_text(path, &format!("{}\n", cloud.len()), ' ', cloud),
        Some("csv") => write_text(path, "x_mm,y_mm,z_mm\n", ',', cloud),
        _ => Err(CloudError::Format {
            file: path.display().to_string(),
            found: "only .ply, .e57, .stl, .xyz, .asc, .txt, .pts and .csv are written".to_owned(),
        }),
    }
}

/// How a PLY is written: encoding and type of the coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlyForm {
    /// Text, coordinates with all their digits.
    Ascii,
    /// Binary little-endian, single precision.
    FloatLittle,
    /// Binary big-endian, single precision.
    FloatBig,
    /// Binary little-endian, double precision: nothing is rounded.
    DoubleLittle,
    /// Binary big-endian, double precision.
    DoubleBig,
}

impl PlyForm {
    /// All of them.
    pub const ALL: [PlyForm; 5] =
        [PlyForm::Ascii, PlyForm::FloatLittle, PlyForm::FloatBig, PlyForm::DoubleLittle, PlyForm::DoubleBig];

    /// Encoding and scalar type by the header's words.
    fn words(self) -> (&'static str, &'static str) {
        match self {
            PlyForm::Ascii => ("ascii", "double"),
            PlyForm::FloatLittle => ("binary_little_endian", "float"),
            PlyForm::FloatBig => ("binary_big_endian", "float"),
            PlyForm::DoubleLittle => ("binary_little_endian", "double"),
            PlyForm::DoubleBig => ("binary_big_endian", "double"),
        }
    }

    fn coordinate(self, out: &mut impl Write, v: f64) -> io::Result<()> {
        match self {
            PlyForm::Ascii => write!(out, "{v} "),
            PlyForm::FloatLittle => out.write_all(&(v as f32).to_le_bytes()),
            PlyForm::FloatBig => out.write_all(&(v as f32).to_be_bytes()),
            PlyForm::DoubleLittle => out.write_all(&v.to_le_bytes()),
            PlyForm::DoubleBig => out.write_all(&v.to_be_bytes()),
        }
    }

    fn normal(self, out: &mut impl Write, v: f32) -> io::Result<()> {
        match self {
            PlyForm::Ascii => write!(out, "{v} "),
            PlyForm::FloatLittle | PlyForm::DoubleLittle => out.write_all(&v.to_le_bytes()),
            PlyForm::FloatBig | PlyForm::DoubleBig => out.write_all(&v.to_be_bytes()),
        }
    }
}

/// Writes a PLY in which no coordinate is rounded ([`PlyForm::DoubleLittle`]), with normals where there are some.
pub fn write_ply(path: &Path, cloud: &PointCloud) -> Result<(), CloudError> {
    write_ply_as(path, cloud, PlyForm::DoubleLittle)
}

/// Writes a PLY of the given form, with normals where there are some.
pub fn write_ply_as(path: &Path, cloud: &PointCloud, form: PlyForm) -> Result<(), CloudError> {
    let (encoding, scalar) = form.words();
    write(path, |out| {
        write!(out, "ply\nformat {encoding} 1.0\ncomment millimetres\nelement vertex {}\n", cloud.len())?;
        ["x", "y", "z"].iter().try_for_each(|axis| writeln!(out, "property {scalar} {axis}"))?;
        if cloud.normals.is_some() {
            out.write_all(b"property float nx\nproperty float ny\nproperty float nz\n")?;
        }
        out.write_all(b"end_header\n")?;
        for (i, p) in cloud.iter().enumerate() {
            p.iter().try_for_each(|&v| form.coordinate(out, v))?;
            if let Some(normals) = &cloud.normals {
                normals[i].iter().try_for_each(|&v| form.normal(out, v))?;
            }
            if form == PlyForm::Ascii {
                out.write_all(b"\n")?;
            }
        }
        Ok(())
    })
}

/// Writes a binary little-endian PLY with a colour per point (`red`, `green`, `blue`) and its deviation from a surface
/// (`deviation_mm`), as viewers show them. Points without a colour or deviation, where these are fewer, are left out.
pub fn write_coloured_ply(
    path: &Path,
    cloud: &PointCloud,
    colours: &[[u8; 3]],
    deviations_mm: &[f64],
) -> Result<(), CloudError> {
    let points = cloud.len().min(colours.len()).min(deviations_mm.len());
    write(path, |out| {
        write!(out, "ply\nformat binary_little_endian 1.0\ncomment millimetres\nelement vertex {points}\n")?;
        ["x", "y", "z"].iter().try_for_each(|axis| writeln!(out, "property double {axis}"))?;
        ["red", "green", "blue"].iter().try_for_each(|name| writeln!(out, "property uchar {name}"))?;
        out.write_all(b"property float deviation_mm\nend_header\n")?;
        for ((p, colour), deviation) in cloud.iter().zip(colours).zip(deviations_mm) {
            p.iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
            out.write_all(colour)?;
            out.write_all(&(*deviation as f32).to_le_bytes())?;
        }
        Ok(())
    })
}

/// Writes a text file, a point per line to the nanometre.
pub fn write_xyz(path: &Path, cloud: &PointCloud) -> Result<(), CloudError> {
    write_text(path, "", ' ', cloud)
}

fn write_text(path: &Path, head: &str, between: char, cloud: &PointCloud) -> Result<(), CloudError> {
    write(path, |out| {
        out.write_all(head.as_bytes())?;
        cloud.iter().try_for_each(|p| writeln!(out, "{:.6}{between}{:.6}{between}{:.6}", p.x, p.y, p.z))
    })
}

/// Writes a binary STL whose facets' corners are the points, three to a facet (the last is repeated to fill it):
/// points for a reader, no surface.
pub fn write_stl(path: &Path, cloud: &PointCloud) -> Result<(), CloudError> {
    let facets = u32::try_from(cloud.len().div_ceil(3)).unwrap_or(u32::MAX);
    write(path, |out| {
        out.write_all(&[b' '; 80])?;
        out.write_all(&facets.to_le_bytes())?;
        for facet in 0..facets as usize {
            out.write_all(&[0; 12])?;
            for corner in 3 * facet..3 * facet + 3 {
                let p = cloud.point(corner.min(cloud.len() - 1));
                p.iter().try_for_each(|&v| out.write_all(&(v as f32).to_le_bytes()))?;
            }
            out.write_all(&[0; 2])?;
        }
        Ok(())
    })
}

/// Writes an E57 with one scan per cloud, in metres as it prescribes, in double precision.
pub fn write_e57(path: &Path, clouds: &[PointCloud]) -> Result<(), CloudError> {
    let failed = |reason| CloudError::Write { file: path.display().to_string(), reason };
    let unwritten = |e: e57::Error| failed(io::Error::other(e.to_string()));
    let file = OpenOptions::new().read(true).write(true).create(true).truncate(true).open(path);
    let mut out = E57Writer::new(file.map_err(failed)?, "benderd").map_err(unwritten)?;
    for (number, cloud) in clouds.iter().enumerate() {
        let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
        let record = |name| Record { name, data_type: RecordDataType::Double { min: None, max: None } };
        let mut scan =
            out.add_pointcloud(&format!("benderd-{number}"), axes.map(record).into()).map_err(unwritten)?;
        for p in cloud.iter() {
            let metres = p.iter().map(|v| RecordValue::Double(v / 1000.0)).collect();
            scan.add_point(metres).map_err(unwritten)?;
        }
        scan.finalize().map_err(unwritten)?;
    }
    out.finalize().map_err(unwritten)
}

fn write(path: &Path, body: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> Result<(), CloudError> {
    let written = File::create(path).and_then(|file| {
        let mut out = BufWriter::new(file);
        body(&mut out)?;
        out.flush()
    });
    written.map_err(|reason| CloudError::Write { file: path.display().to_string(), reason })
}
