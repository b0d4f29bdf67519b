//! Part files: the nominal tube with its die and tolerance (`config/parts/*.toml`).

use std::path::Path;

use serde::Deserialize;
use toml::Spanned;

use super::{ConfigError, Document, Materials};
use crate::tube::{Alignment, Bend, Lra, Nominal, Tolerance};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPart {
    name: Spanned<String>,
    tube: RawTube,
    die: RawDie,
    #[serde(default)]
    bend: Vec<RawBend>,
    end: RawEnd,
    tolerance: RawTolerance,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawTube {
    od_mm: Spanned<f64>,
    wall_mm: Spanned<f64>,
    material: Spanned<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawDie {
    clr_mm: Spanned<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawBend {
    length_mm: Spanned<f64>,
    rotation_deg: Spanned<f64>,
    angle_deg: Spanned<f64>,
    radius_mm: Option<Spanned<f64>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawEnd {
    length_mm: Spanned<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawTolerance {
    envelope_mm: Spanned<f64>,
    angle_deg: Spanned<f64>,
    rotation_deg: Spanned<f64>,
    length_mm: Spanned<f64>,
    alignment: Option<RawAlignment>,
}

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
enum RawAlignment {
    BestFit,
    AEnd,
    BEnd,
    Weighted,
    Fixture,
}

/// Reads a part file.
pub fn load_part(path: &Path, materials: &Materials) -> Result<Nominal, ConfigError> {
    parse_part(&Document::read(path)?, materials)
}

/// Validates a part text.
pub fn parse_part(doc: &Document, materials: &Materials) -> Result<Nominal, ConfigError> {
    let raw: RawPart = doc.parse()?;
    let name = raw.name.get_ref().clone();
    if name.is_empty() || name.len() > 64 || name.chars().any(char::is_control) {
        return Err(doc.value_error(
            raw.name.span(),
            "name",
            format!("{name:?}"),
            "1 to 64 printable characters",
        ));
    }
    let od_mm = doc.in_range(&raw.tube.od_mm, "tube.od_mm", 1.0..=1000.0)?;
    let wall_mm = doc.in_range(&raw.tube.wall_mm, "tube.wall_mm", 0.05..=od_mm / 2.0)?;
    let key = raw.tube.material.get_ref();
    let material = materials.get(key).cloned().ok_or_else(|| {
        let known = materials.keys().collect::<Vec<_>>().join(", ");
        doc.value_error(
            raw.tube.material.span(),
            "tube.material",
            format!("{key:?}"),
            format!("one of {known}"),
        )
    })?;
    // A die tighter than the tube's own radius would fold the inner wall through itself.
    let die_clr_mm = doc.in_range(&raw.die.clr_mm, "die.clr_mm", od_mm / 2.0..=100_000.0)?;
    let lra = parse_lra(doc, &raw, od_mm, die_clr_mm)?;
    Ok(Nominal {
        name,
        od_mm,
        wall_mm,
        material,
        die_clr_mm,
        lra,
        tolerance: parse_tolerance(doc, &raw.tolerance)?,
    })
}

fn parse_lra(doc: &Document, raw: &RawPart, od_mm: f64, die_clr_mm: f64) -> Result<Lra, ConfigError> {
    let mut lra = Lra::default();
    for (i, b) in raw.bend.iter().enumerate() {
        let key = |field: &str| format!("bend {} {field}", i + 1);
        let radius_mm = match &b.radius_mm {
            Some(radius) => doc.in_range(radius, &key("radius_mm"), od_mm / 2.0..=100_000.0)?,
            None => die_clr_mm,
        };
        lra.bends.push(Bend {
            length_mm: doc.in_range(&b.length_mm, &key("length_mm"), 0.0..=100_000.0)?,
            rotation_rad: doc.in_range(&b.rotation_deg, &key("rotation_deg"), -360.0..=360.0)?.to_radians(),
            angle_rad: doc.in_range(&b.angle_deg, &key("angle_deg"), 0.0..=359.0)?.to_radians(),
            radius_mm,
        });
    }
    lra.last_length_mm = doc.in_range(&raw.end.length_mm, "end.length_mm", 0.0..=100_000.0)?;
    Ok(lra)
}

fn parse_tolerance(doc: &Document, raw: &RawTolerance) -> Result<Tolerance, ConfigError> {
    let alignment = match raw.alignment {
        None | Some(RawAlignment::BestFit) => Alignment::BestFit,
        Some(RawAlignment::AEnd) => Alignment::AEnd,
        Some(RawAlignment::BEnd) => Alignment::BEnd,
        Some(RawAlignment::Weighted) => Alignment::Weighted,
        Some(RawAlignment::Fixture) => Alignment::Fixture,
    };
    Ok(Tolerance {
        envelope_mm: doc.in_range(&raw.envelope_mm, "tolerance.envelope_mm", 0.001..=1000.0)?,
        angle_rad: doc.in_range(&raw.angle_deg, "tolerance.angle_deg", 0.001..=90.0)?.to_radians(),
        rotation_rad: doc.in_range(&raw.rotation_deg, "tolerance.rotation_deg", 0.001..=180.0)?.to_radians(),
        length_mm: doc.in_range(&raw.length_mm, "tolerance.length_mm", 0.001..=1000.0)?,
        alignment,
    })
}
