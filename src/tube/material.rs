//! What a tube is made of, as far as bending cares.

/// A material with its elastic-plastic constants (hardening law sigma = K eps^n).
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// Key in the materials file, for instance `304`.
    pub key: String,
    /// Young's modulus.
    pub youngs_modulus_mpa: f64,
    /// Yield stress (0.2 %).
    pub yield_mpa: f64,
    /// Strength coefficient K.
    pub strength_coefficient_mpa: f64,
    /// Hardening exponent n.
    pub hardening_exponent: f64,
    /// Usual spring-back of a 90 degree bend at CLR = 2 D, elastic part and the fixed part together.
    pub usual_springback_rad: f64,
}
