//! Local geometry of a cloud: jets, that is normals and the shape operator at a point; and planar faces.
//!
//! Between `cloud` and `reconstruct`: it knows surfaces, and nothing of tubes.

mod jet;
mod planes;
mod robust;

pub use jet::{Jet, MIN_NEIGHBOURS, fit_jet};
pub use planes::{Face, find_planes};
pub use robust::{MEDIAN_TO_SIGMA, median};
