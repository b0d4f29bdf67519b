//! The materials file: constants per key. The shipped one is built in; `--materials` names another.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use toml::Spanned;

use super::{ConfigError, Document};
use crate::tube::Material;

const SHIPPED: &str = include_str!("../../config/materials.toml");

/// All known materials by key.
#[derive(Debug, Clone)]
pub struct Materials {
    by_key: BTreeMap<String, Material>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFile {
    version: Spanned<u32>,
    material: BTreeMap<String, RawMaterial>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawMaterial {
    youngs_modulus_mpa: Spanned<f64>,
    yield_mpa: Spanned<f64>,
    strength_coefficient_mpa: Spanned<f64>,
    hardening_exponent: Spanned<f64>,
    usual_springback_deg: Spanned<f64>,
}

impl Materials {
    /// The materials that come with the program.
    pub fn shipped() -> Result<Materials, ConfigError> {
        Materials::parse(&Document::new("config/materials.toml (built in)", SHIPPED))
    }

    /// Reads a materials file; without one, those that come with the program.
    pub fn load(path: Option<&Path>) -> Result<Materials, ConfigError> {
        path.map_or_else(Materials::shipped, |path| Materials::parse(&Document::read(path)?))
    }

    /// Validates a materials text.
    pub fn parse(doc: &Document) -> Result<Materials, ConfigError> {
        let raw: RawFile = doc.parse()?;
        if *raw.version.get_ref() != 1 {
            return Err(doc.value_error(raw.version.span(), "version", raw.version.get_ref(), "1"));
        }
        let mut by_key = BTreeMap::new();
        for (key, m) in raw.material {
            let name = |field: &str| format!("material.{key}.{field}");
            let get = |value: &Spanned<f64>, field: &str, range| doc.in_range(value, &name(field), range);
            let material = Material {
                youngs_modulus_mpa: get(&m.youngs_modulus_mpa, "youngs_modulus_mpa", 1e3..=1e6)?,
                yield_mpa: get(&m.yield_mpa, "yield_mpa", 1.0..=5e3)?,
                strength_coefficient_mpa: get(
                    &m.strength_coefficient_mpa,
                    "strength_coefficient_mpa",
                    1.0..=1e4,
                )?,
                hardening_exponent: get(&m.hardening_exponent, "hardening_exponent", 0.0..=1.0)?,
                usual_springback_rad: get(&m.usual_springback_deg, "usual_springback_deg", 0.0..=45.0)?
                    .to_radians(),
                key: key.clone(),
            };
            by_key.insert(key, material);
        }
        Ok(Materials { by_key })
    }

    /// Looks a key up.
    pub fn get(&self, key: &str) -> Option<&Material> {
        self.by_key.get(key)
    }

    /// All keys, in order.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.by_key.keys().map(String::as_str)
    }
}
