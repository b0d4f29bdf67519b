//! Local geometry of a cloud: jets, that is normals and the shape operator at a point.
//!
//! Between `cloud` and `reconstruct`: it looks at one neighbourhood at a time and knows nothing of tubes.

mod jet;

pub use jet::{Jet, MIN_NEIGHBOURS, fit_jet};
