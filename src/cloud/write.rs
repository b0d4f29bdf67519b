//! Writing clouds to files, in millimetres: for the simulators and for taking a scan elsewhere.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::{CloudError, PointCloud};

/// Writes a cloud in the format that the extension names: .ply, or text as .xyz, .asc or .txt.
pub fn write_scan(path: &Path, cloud: &PointCloud) -> Result<(), CloudError> {
    match path.extension().map(|e| e.to_string_lossy().to_lowercase()).as_deref() {
        Some("ply") => write_ply(path, cloud),
        Some("xyz" | "asc" | "txt") => write_xyz(path, cloud),
        _ => Err(CloudError::Format {
            file: path.display().to_string(),
            found: "only .ply, .xyz, .asc and .txt are written".to_owned(),
        }),
    }
}

/// Writes a binary little-endian PLY with coordinates as double, so that none is rounded, and normals where
/// there are some.
pub fn write_ply(path: &Path, cloud: &PointCloud) -> Result<(), CloudError> {
    write(path, |out| {
        write!(
            out,
            "ply\nformat binary_little_endian 1.0\ncomment millimetres\nelement vertex {}\n",
            cloud.len()
        )?;
        out.write_all(b"property double x\nproperty double y\nproperty double z\n")?;
        if cloud.normals.is_some() {
            out.write_all(b"property float nx\nproperty float ny\nproperty float nz\n")?;
        }
        out.write_all(b"end_header\n")?;
        for (i, p) in cloud.iter().enumerate() {
            p.iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
            if let Some(normals) = &cloud.normals {
                normals[i].iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
            }
        }
        Ok(())
    })
}

/// Writes a text file, a point per line to the nanometre.
pub fn write_xyz(path: &Path, cloud: &PointCloud) -> Result<(), CloudError> {
    write(path, |out| cloud.iter().try_for_each(|p| writeln!(out, "{:.6} {:.6} {:.6}", p.x, p.y, p.z)))
}

fn write(path: &Path, body: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> Result<(), CloudError> {
    let written = File::create(path).and_then(|file| {
        let mut out = BufWriter::new(file);
        body(&mut out)?;
        out.flush()
    });
    written.map_err(|reason| CloudError::Write { file: path.display().to_string(), reason })
}
