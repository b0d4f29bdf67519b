//! Serde adapters between radians inside and degrees at the edge, used as `#[serde(with = "deg")]`.
//!
//! Degrees are rounded to 1e-9 on the way out: 92.1 stays 92.1 in a file, and a round trip moves an
//! angle by far less than any machine resolves.

use serde::{Deserialize, Deserializer, Serializer};

/// Degrees rounded to 1e-9, for writing.
pub fn to_degrees_clean(rad: f64) -> f64 {
    (rad.to_degrees() * 1e9).round() / 1e9
}

/// Writes radians as degrees.
pub fn serialize<S: Serializer>(rad: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(to_degrees_clean(*rad))
}

/// Reads degrees into radians.
pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(f64::deserialize(deserializer)?.to_radians())
}

/// The same for values that may be unknown (`null`).
pub mod option {
    use super::*;

    /// Writes radians as degrees, or null.
    pub fn serialize<S: Serializer>(rad: &Option<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        match rad {
            Some(rad) => serializer.serialize_some(&to_degrees_clean(*rad)),
            None => serializer.serialize_none(),
        }
    }

    /// Reads degrees or null into radians.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
        Ok(Option::<f64>::deserialize(deserializer)?.map(f64::to_radians))
    }
}
